"""Runs `st_core.checks` on the newest measurements, for /diagnostics of the evaluator."""

import math
import time
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from st_core.checks import Finding, check
from st_core.log import INS_SIGNALS, DriveLog
from st_core.measurement_history import MeasurementHistory
from st_core.timeseries import NANOSECOND, TimeSeries
from st_core.vehicle import VehicleParameters

HISTORY_SPAN = 60.0  # s, maximum age of the measurements used, and of a verdict if no new measurement arrives
WINDOW = 30.0  # s of measurements that are checked; more if these contain too little driving
MIN_DRIVING, MIN_SPEED = 20.0, 1.0  # a verdict requires this duration [s] of driving above this speed [m/s]
MAX_STEP = 0.25  # s; a longer interval between samples counts as this much driving
SAMPLE_PERIOD_NS = 20_000_000  # 20 ms: only the first sample of each such period is used
CHECK_PERIOD = 10.0  # s of measurements between checks
MAX_CPU_FRACTION = 0.018  # of a core, for all checks since the first poll; if exceeded, the next check is delayed
# Findings not reported live: a single bend does not distinguish a heading error from a wrong INS lever arm. Gaps and
# implausible samples are reported by the bridges; here they would persist for WINDOW.
NOT_REPORTED_LIVE = ("heading_misaligned", "measuring_point", "time_gaps", "sample_spikes", "sentinel_values",
                     "out_of_range", "channel_wraps", "channel_jumps")


@dataclass(frozen=True)
class Verdict:
    """Result of a check. severity: of the worst confirmed fault or a failed check; else "note", "" without findings."""

    severity: str
    message: str
    values: Mapping[str, str] = field(default_factory=dict)  # finding -> value with unit, or its severity


class ConsistencyMonitor:
    """Periodically checks the last 30 s of a history, extended up to 60 s to include 20 s of driving.

    Measurements before a position jump are not used. A check of so little data may be wrong, so a fault is reported
    only if two successive checks find it; the first check without the fault clears it.

    max_cpu_fraction: limit of the processor time of all checks since the first poll, as a fraction of a core. verdict:
    result of the newest check. cpu_time: processor time of all checks [s].
    """

    def __init__(self, vehicle: VehicleParameters, max_cpu_fraction: float = MAX_CPU_FRACTION):
        self._vehicle, self._max_cpu_fraction = vehicle, max_cpu_fraction
        self.verdict = _make_pending_verdict(0.0)
        self.cpu_time = 0.0
        self._faults: frozenset[str] = frozenset()  # found by the last check
        self._checked_ns: int | None = None
        self._first_poll: float | None = None
        self._checked_at = self._not_before = -math.inf

    def poll(self, history: MeasurementHistory, now: float) -> bool:
        """Run the checks if they are due; returns whether they were due. now: time of a monotonic clock [s]. An
        exception in a check is not raised; it becomes a verdict of severity "warning"."""
        newest_ns = history.ins.newest
        if self._first_poll is None:
            self._first_poll = now
        if newest_ns is None or now < self._not_before:
            return False
        if self._checked_ns is not None and 0 <= newest_ns - self._checked_ns < CHECK_PERIOD / NANOSECOND:
            if now - self._checked_at > HISTORY_SPAN:
                self.verdict = _make_pending_verdict(0.0)
            return False
        self._checked_ns, self._checked_at = newest_ns, now
        try:
            self._check(*select_recent(history), self._first_poll)
        except Exception as error:  # a failed check must not stop the scoring of predictions
            self.verdict = Verdict("warning", f"check failed: {type(error).__name__}: {error}")
        return True

    def _check(self, log: DriveLog | None, driving_time: float, first_poll: float) -> None:
        """Update `verdict`. log, driving_time: from `select_recent`. first_poll: time of the first poll [s]."""
        previous_faults, self._faults = self._faults, frozenset()
        if log is None:
            self.verdict = _make_pending_verdict(driving_time)
            return
        cpu_start = time.thread_time()
        try:
            findings = [f for f in check(log, self._vehicle).findings if f.name not in NOT_REPORTED_LIVE]
        finally:
            self.cpu_time += time.thread_time() - cpu_start
            self._not_before = first_poll + self.cpu_time / self._max_cpu_fraction
        self._faults = frozenset(finding.name for finding in findings if finding.severity != "note")
        self.verdict = _make_verdict(findings, previous_faults, log.duration)


def select_recent(history: MeasurementHistory) -> tuple[DriveLog | None, float]:
    """(downsampled measurements to check, None if they contain too little driving; duration of driving [s])."""
    newest_ns = history.ins.newest or 0
    oldest_ns = max(newest_ns - round(HISTORY_SPAN / NANOSECOND), *history.ins.breaks, 0)
    times, rows = _downsample(history.ins, oldest_ns)
    step = np.minimum(np.diff(times, append=newest_ns) * NANOSECOND, MAX_STEP)
    # Duration of driving from each sample to the newest sample [s].
    remaining = np.cumsum((step * (np.abs(rows[:, INS_SIGNALS.index("velocity_x")]) > MIN_SPEED))[::-1])[::-1]
    driving_time = float(remaining[0]) if len(remaining) else 0.0
    if driving_time < MIN_DRIVING:
        return None, driving_time
    start_ns = min(newest_ns - round(WINDOW / NANOSECOND), int(times[np.flatnonzero(remaining >= MIN_DRIVING)[-1]]))
    start_ns = max(start_ns, oldest_ns)
    times, rows = _downsample(history.ins, start_ns)
    columns = dict(zip(INS_SIGNALS, rows.T, strict=False))
    steering_times, angles = _downsample(history.steering, start_ns)
    log = DriveLog("live", times, **columns | {"yaw": np.unwrap(columns["yaw"])},
                   steering_time_ns=steering_times, road_wheel_angle=angles[:, 0])
    return log, driving_time


def _downsample(series: TimeSeries, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(times, rows) of the first sample in each SAMPLE_PERIOD_NS from `start_ns` on."""
    first = int(np.searchsorted(series.times, start_ns))
    times = series.times[first:]
    selected = np.flatnonzero(np.diff(times // SAMPLE_PERIOD_NS, prepend=-1))
    return times[selected], series.rows[first:][selected]


def _make_pending_verdict(driving_time: float) -> Verdict:
    return Verdict("", f"not checked: only {driving_time:.0f} s above {MIN_SPEED:g} m/s in the last minute or since a "
                   f"position jump; {MIN_DRIVING:g} s required")


def _make_verdict(findings: Sequence[Finding], previous_faults: Set[str], duration: float) -> Verdict:
    """Verdict on findings, worst first. previous_faults: fault names of the last check. duration: of the data [s]."""
    values = {}
    for finding in findings:
        interval = finding.interval
        half_width = "" if interval is None else f" ± {0.5 * (interval[1] - interval[0]):.2g}"
        unit = "" if finding.unit in ("1", "-") else f" {finding.unit}"
        values[finding.name] = (
            finding.severity.value if finding.value is None else f"{finding.value:.4g}{half_width}{unit}")
    faults = [finding for finding in findings if finding.severity != "note"]
    if confirmed := [fault for fault in faults if fault.name in previous_faults]:
        severity = confirmed[0].severity
        text = "; ".join(fault.text for fault in confirmed if fault.severity is severity)
        return Verdict(severity.value, text, values)
    names = ", ".join(fault.name for fault in faults)
    text = f"no fault found in the last {duration:.0f} s" if not faults else (
        f"no confirmed fault in the last {duration:.0f} s; awaiting confirmation by the next check: {names}")
    return Verdict("note" if findings else "", text, values)
