"""Consistency of the newest measurements, judged by `st_core.checks`, for /diagnostics."""

import math
import time
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from st_core.alignment import MeasurementHistory
from st_core.checks import Finding, check
from st_core.log import INS_SIGNALS, DriveLog
from st_core.timeseries import NANOSECOND, TimeSeries
from st_core.vehicle import VehicleParameters

MINUTE = 60.0  # s, age of the oldest measurement used
RECENT = 30.0  # s that are judged while the car moves all the time: a fault is reported and cleared within that time
ENOUGH, MOVING = 20.0, 1.0  # s of driving above so many m/s, required for a verdict
LONGEST_STEP = 0.25  # s between samples; gaps do not count as driving
SAMPLE_NS = 20_000_000  # one sample of so much time is used
PERIOD = 10.0  # s of measurement from one check to the next
SHARE = 0.018  # of a core: where a check costs more than PERIOD allows, it comes less often
# On one bend heading and measuring point look alike: only a whole drive separates them. Gaps are reported where they
# arise, implausible samples by the bridges: half a minute in which a unit changes would seem full of them.
NOT_LIVE = frozenset(("heading_misaligned", "measuring_point", "time_gaps", "sample_spikes", "sentinel_values",
                      "out_of_range", "channel_wraps", "channel_jumps"))


@dataclass(frozen=True)
class Verdict:
    """severity: "", "note", "warning" or "error", that of the gravest finding. values: finding -> value ± half."""

    severity: str
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


class Consistency:
    """Judges a history periodically: the newest 30 s, or as much of the last minute as contains 20 s of driving, and
    nothing before a jump of the position, which is reported where it is detected.

    A fault is reported when two successive checks find it, since one check of half a minute may be wrong, and cleared
    by the first check without it.
    `verdict` is the newest; seconds: processor time that all checks took together. share: of a core they may take.
    """

    def __init__(self, vehicle: VehicleParameters, share: float = SHARE):
        self._vehicle, self._share = vehicle, share
        self.verdict = _waiting(0.0)
        self.seconds = 0.0
        self._found: frozenset[str] = frozenset()  # faults of the last check
        self._judged_ns: int | None = None
        self._at = self._not_before = -math.inf

    def poll(self, history: MeasurementHistory, now: float) -> bool:
        """Judge if it is time to; returns whether it was. now: of a steady clock [s].

        Never raises for what was measured: a check that fails is a warning of its own.
        """
        newest = history.ins.newest
        if newest is None or now < self._not_before:
            return False
        if self._judged_ns is not None and 0 <= newest - self._judged_ns < PERIOD / NANOSECOND:
            if now - self._at > MINUTE:
                self.verdict = _waiting(0.0)
            return False
        self._judged_ns, self._at = newest, now
        try:
            self._judge(recent(history), now)
        except Exception as error:  # whatever it is, predictions are scored on
            self.verdict = Verdict("warning", f"could not be judged: {type(error).__name__}: {error}")
        return True

    def _judge(self, log: DriveLog | float, now: float) -> None:
        before, self._found = self._found, frozenset()
        if isinstance(log, float):
            self.verdict = _waiting(log)
            return
        begin = time.thread_time()
        findings = [one for one in check(log, self._vehicle).findings if one.name not in NOT_LIVE]
        self._found = frozenset(one.name for one in findings if one.severity != "note")
        self.verdict = _verdict(findings, before, log.duration)
        took = time.thread_time() - begin
        self.seconds += took
        self._not_before = now + took / self._share


def recent(history: MeasurementHistory) -> DriveLog | float:
    """What is to be judged, thinned out; where that is too little, the seconds of driving in the last minute, or since
    the position jumped."""
    newest = history.ins.newest or 0
    oldest = max(newest - round(MINUTE / NANOSECOND), *history.ins.breaks, 0)
    times, rows = _since(history.ins, oldest)
    step = np.minimum(np.diff(times, append=newest) * NANOSECOND, LONGEST_STEP)
    driven = np.cumsum((step * (np.abs(rows[:, INS_SIGNALS.index("velocity_x")]) > MOVING))[::-1])[::-1]
    if not len(driven) or driven[0] < ENOUGH:
        return float(driven[0]) if len(driven) else 0.0
    start = min(newest - round(RECENT / NANOSECOND), int(times[np.flatnonzero(driven >= ENOUGH)[-1]]))
    start = max(start, oldest)
    times, rows = _since(history.ins, start)
    columns = dict(zip(INS_SIGNALS, rows.T, strict=False))
    steering_times, angles = _since(history.steering, start)
    return DriveLog("live", times, **columns | {"yaw": np.unwrap(columns["yaw"])},
                    steering_time_ns=steering_times, road_wheel_angle=angles[:, 0])


def _since(series: TimeSeries, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(times, rows) from an instant on, the first of each SAMPLE_NS."""
    first = int(np.searchsorted(series.times, start_ns))
    times = series.times[first:]
    kept = np.flatnonzero(np.diff(times // SAMPLE_NS, prepend=-1))
    return times[kept], series.rows[first:][kept]


def _waiting(driven: float) -> Verdict:
    return Verdict("", f"not judged: {driven:.0f} s of driving in the last minute or since the position jumped, "
                   f"{ENOUGH:g} s above {MOVING:g} m/s required")


def _verdict(findings: Sequence[Finding], before: Set[str], seconds: float) -> Verdict:
    """findings: the gravest first. before: names of what was wrong at the check before."""
    values = {one.name: _value(one) for one in findings}
    wrong = [one for one in findings if one.severity != "note"]
    if confirmed := [one for one in wrong if one.name in before]:
        severity = confirmed[0].severity
        return Verdict(severity.value, "; ".join(one.text for one in confirmed if one.severity is severity), values)
    new = f", to be confirmed: {', '.join(one.name for one in wrong)}" if wrong else ""
    return Verdict("note" if findings else "", f"signals agree in the newest {seconds:.0f} s{new}", values)


def _value(finding: Finding) -> str:
    if finding.value is None:
        return finding.severity.value
    spread = "" if finding.interval is None else f" ± {0.5 * (finding.interval[1] - finding.interval[0]):.2g}"
    return f"{finding.value:.4g}{spread}" + (f" {finding.unit}" if finding.unit not in ("1", "-") else "")
