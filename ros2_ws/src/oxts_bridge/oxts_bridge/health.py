"""Builds the diagnostic checks of the OxTS bridge."""

import time
from collections.abc import Callable
from typing import Any

from st_ros.diagnostics import ERROR, OK, WARN, Check
from st_ros.polling import MAX_BACKLOG

from .motion import UNIT, Accuracy, Origin, compute_variances
from .ncom import BLOCKED, EXPIRED, LOCKED, LOCKING, STATUS_RULES, describe_mode, rank_mode
from .sources import SourceStatus
from .status import StatusTracker
from .stream import NcomParser, StreamStatistics

# Largest median difference of packet times from the host's clock without a warning [s]. The host stamps CAN frames, so
# this is also the time error of the steering. The delay of the unit and the network is much smaller.
MAX_CLOCK_OFFSET = 0.05
# A larger difference [s] is not due to a delay, but to a wrong GPS week or to packets of a recording.
MAX_DELAY = 60.0
_DAY = 86_400.0  # s
_NEVER = float("-inf")


class Health:
    """Builds diagnostic checks from the counts of the parser, the status and the source.

    is_live: packets come from a unit, so their times can be compared with the host's clock. is_ellipsoidal: the unit
    sends ellipsoidal altitude. silence_after: time without packets after which an error is reported [s].

    The node updates the public attributes. navigation_status: newest defined status of a packet that is not a trigger.
    last_packet_at: time of receipt on the monotonic clock [s]. failures: number of packets that could not be
    published. incomplete_packets: number of packets with a fix, but with an invalid position, velocity, angle or rate.
    backlog: longest time from receipt to processing since the last report [s].
    """

    def __init__(self, parser: NcomParser, status: StatusTracker, origin: Origin, statistics: StreamStatistics,
                 source: Callable[[], SourceStatus | None], is_live: bool, is_ellipsoidal: bool,
                 silence_after: float):
        self.navigation_status: int | None = None
        self.last_packet_at = _NEVER
        self.failures = self.incomplete_packets = 0
        self.backlog = 0.0
        self._best_mode: int | None = None
        self._parser, self._status, self._origin, self._statistics = parser, status, origin, statistics
        self._source, self._silence_after = source, silence_after
        self._is_live, self._is_ellipsoidal = is_live, is_ellipsoidal
        self._previous_faults: dict[str, int] = {}
        self._previous_ignored = 0

    def checks(self) -> list[Check]:
        """The checks for /diagnostics; some count the faults since the previous call."""
        source = self._source()
        if source is None:
            return [Check("source", OK, "not active")]
        return [self._check_source(source), self._check_stream(source), self._check_solution(),
                self._check_completeness(), self._check_time()]

    def _check_source(self, source: SourceStatus) -> Check:
        values: dict[str, Any] = {"packets": source.datagrams, "progress %": 100.0 * source.progress,
                                  "loops": source.loops}
        if self._is_live:
            values = {"datagrams": source.datagrams, **({"sender": source.sender} if source.sender else {}),
                      **{f"ignored from {address}": count for address, count in source.ignored_datagrams.items()}}
        if self.failures:
            return Check("source", ERROR, f"{self.failures} packets could not be published, see the log", values)
        if source.problem:
            return Check("source", ERROR, source.problem, values)
        if source.is_done:
            return Check("source", OK, f"{source.name}: replay finished", values)
        ignored = source.competing_datagrams - self._previous_ignored
        self._previous_ignored = source.competing_datagrams
        if ignored > 0:
            others = [name for name in source.ignored_datagrams if name != source.sender]
            text = (f"datagrams ignored since the last report: {ignored}; senders ignored so far: {', '.join(others)}; "
                    "let only one program send from the address of the unit, and set sender_filter to it")
            return Check("source", WARN, f"{source.name} from {source.sender}: {text}", values)
        if source.ignored_datagrams and not source.sender:
            return Check("source", WARN, f"{source.name}: receives only from ignored senders "
                         f"({', '.join(source.ignored_datagrams)}); check sender_filter", values)
        level, text = (WARN, ": another program has this port open; broadcasts reach both, datagrams to this computer "
                             "only one: give each its own port") if source.is_shared else (OK, "")
        name = source.name + (f" from {source.sender}" if source.sender else "")
        return Check("source", level, name + text, values)

    def _check_stream(self, source: SourceStatus) -> Check:
        (rate, longest), counters = self._statistics.summarise_steps(), self._parser.counters
        age = time.monotonic() - self.last_packet_at
        backlog, self.backlog = self.backlog, 0.0
        faults = {
            "checksum errors": counters.checksum_errors, "skipped bytes": counters.skipped_bytes,
            "late": counters.late, "gaps": self._statistics.gaps,
            "impossible positions": counters.impossible_positions, "impossible times": counters.impossible_times,
            "packets without a complete solution": self.incomplete_packets,
        }
        increments = {name: count - self._previous_faults.get(name, 0) for name, count in faults.items()}
        self._previous_faults = faults
        values = {
            "rate [Hz]": rate, "longest step [s]": longest, "packets": counters.packets, **faults,
            "inner checksum warnings": counters.inner_checksum_warnings, "duplicates": counters.duplicates,
            "triggers": counters.triggers, "reserved navigation status": counters.unknown_statuses,
            "unknown channels": counters.unknown_channels, "age [s]": age, "backlog [s]": backlog,
        }
        if source.is_done:
            return Check("stream", OK, "replay finished", values)
        if self.last_packet_at == _NEVER:
            return Check("stream", ERROR, f"no NCOM packet yet ({source.name}, datagrams: {source.datagrams}); check "
                         "the address and port to which the unit sends, and the cable", values)
        if age > self._silence_after:
            advice = ": check the unit, the cable, and that no other program uses the port"
            return Check("stream", ERROR if self._is_live else WARN,
                         f"no packet for {age:.1f} s" + (advice if self._is_live else " in the recording"), values)
        problems = [f"{count} {'late packets' if name == 'late' else name}" for name, count in increments.items()
                    if count > 0]
        problems = [", ".join(problems) + " since the last report"] if problems else []
        if backlog > MAX_BACKLOG:
            problems.append(f"packets are processed {backlog:.1f} s after their receipt, because the computer is busy; "
                            "derived topics are omitted meanwhile")
        if problems:
            return Check("stream", WARN, "; ".join(problems), values)
        return Check("stream", OK, f"{rate:.0f} packets/s", values)

    def _check_solution(self) -> Check:
        if self.navigation_status is None:
            return Check("solution", WARN, "no navigation status yet")
        get, accuracy = self._status.get, Accuracy.from_status(self._status)
        east, north, _ = accuracy.position
        values = {
            "position mode": describe_mode(get("GpsPosMode")), "velocity mode": describe_mode(get("GpsVelMode")),
            "orientation mode": describe_mode(get("GpsAttMode")), "satellites": get("GpsNumObs"),
            "position accuracy east [m]": east, "position accuracy north [m]": north,
            "heading accuracy [rad]": accuracy.attitude[2], "PTP status": get("PtpStatus"),
            "NTRIP status": get("NtripStatus"), "IMU temperature [degC]": get("ImuTemperature"),
        }
        values = {key: value for key, value in values.items() if value not in (None, "")}
        text = STATUS_RULES[self.navigation_status].text
        if self.navigation_status == LOCKED:
            mode = get("GpsPosMode")
            self._best_mode = max(self._best_mode, mode, key=rank_mode)
            if rank_mode(mode) < rank_mode(self._best_mode):
                change = f"position mode fell from {describe_mode(self._best_mode)} to {describe_mode(mode)}"
                return Check("solution", WARN, f"{text}: {change}", values)
            return Check("solution", OK, text, values)
        if self.navigation_status in (EXPIRED, BLOCKED):
            return Check("solution", ERROR, text, values)
        reason = "catching up with real time" if self.navigation_status == LOCKING else "no fix"
        return Check("solution", WARN, f"{text}: {reason}", values)

    def _check_completeness(self) -> Check:
        """Report missing information and its effect on the topics."""
        status = self._status
        degraded, missing = [], []
        if self._parser.clock.minute is None:
            degraded.append("absolute time (channel 0): topics stamped by the unit are not published")
        elif self._parser.minute_from_host:
            degraded.append("absolute time (channel 0): minute taken from the host's clock")
        if status.get("Undulation") is None and not self._is_ellipsoidal:
            degraded.append("geoid undulation (channel 48): altitude of ins/nav_sat_fix is NaN")
        if None in map(compute_variances, Accuracy.from_status(status)):
            degraded.append("accuracies (channels 3, 4, 5): covariances unknown")
        if self._origin.frame is None:
            pending = "the unit's local frame" if self._origin.source == UNIT else "the first fix"
            degraded.append(f"map origin: ins/odometry and tf wait for {pending}")
        elif self._origin.chosen_source != self._origin.source:
            degraded.append("the unit's local frame (channels 66, 67): map origin is the first fix")
        if self._parser.utc_offset is None:
            missing.append("UTC offset (leap-second table used)")
        if status.get("SerialNumber") is None and status.get("SerialNumber24") is None:
            missing.append("serial number")
        values = {"also missing": ", ".join(missing) or "nothing", "channels seen": len(status.raw),
                  "map origin": self._origin.chosen_source or "none"}
        if degraded:
            return Check("completeness", WARN, "missing: " + "; ".join(degraded), values)
        return Check("completeness", OK, "complete", values)

    def _check_time(self) -> Check:
        offset = self._parser.utc_offset
        values: dict[str, Any] = {"time jumps": self._parser.clock.jumps,
                                  "UTC offset [s]": "leap-second table" if offset is None else offset}
        differences = self._statistics.summarise_clock_offset() if self._is_live else None
        if differences is None:
            return Check("time", OK, "no UTC yet" if self._is_live else "not compared with the host's clock", values)
        median, percentile_1, newest = differences
        values |= {"stamp minus host, median [s]": median, "stamp minus host, 1st percentile [s]": percentile_1}
        if abs(newest) > MAX_DELAY:
            difference = f"{newest / _DAY:+.1f} days" if abs(newest) > _DAY else f"{newest:+.0f} s"
            text = f"packet times differ from the host's clock by {difference}: check both clocks; is it a recording?"
            return Check("time", ERROR, text, values)
        if abs(median) > MAX_CLOCK_OFFSET:
            text = f"packet times differ from the host's clock by {median:+.3f} s: check both clocks"
            return Check("time", WARN, text, values)
        return Check("time", OK, f"packet times differ from the host's clock by {median * 1e3:+.1f} ms", values)
