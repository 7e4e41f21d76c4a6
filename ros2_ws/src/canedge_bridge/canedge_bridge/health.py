"""Builds the diagnostic checks of the CAN bridge."""

import time
from collections.abc import Callable
from typing import Any

from st_ros.diagnostics import ERROR, OK, WARN, Check
from st_ros.polling import MAX_BACKLOG

from .decode import Decoder
from .receiver import BusState, ReceiverStatus

_LEVELS = {BusState.OK: OK, BusState.SILENT: WARN, BusState.ERROR_PASSIVE: WARN, BusState.BUS_OFF: ERROR,
           BusState.DOWN: ERROR, BusState.GONE: ERROR}
_START_UP_TIME = 2.0  # time after the start before a missing signal is an error [s]
_RATE_INTERVAL = 0.5  # minimum time between two updates of the frame rates [s]


class Health:
    """Checks the bus, age of signals, bad frames and implausible signals, from counts of decoder and receiver."""

    def __init__(self, bus_name: str, decoder: Decoder, receiver_status: Callable[[], ReceiverStatus],
                 now_ns: Callable[[], int]):
        """now_ns: reads the clock that stamps the frames [ns since 1970]."""
        self._bus_name, self._decoder, self._receiver_status = bus_name, decoder, receiver_status
        self._now_ns = now_ns
        self._started_at = self._rates_updated_at = time.monotonic()
        self._previous_bad = 0
        self._previous_counts: dict[str, int] = {}  # good frames by message name; "": all frames on the bus
        self._rates: dict[str, float] = {}  # increase of these counts [frames/s]

    def checks(self) -> list[Check]:
        plausibility = Check("plausibility", OK, "no signal is persistently implausible")
        if implausible := self._decoder.plausibility_faults():
            plausibility = Check("plausibility", ERROR, "; ".join(
                [*implausible, "messages with these signals are not published"]))
        return [self._check_bus(), self._check_signals(), self._check_frames(), plausibility]

    def _check_bus(self) -> Check:
        status = self._receiver_status()
        now = time.monotonic()
        # The checks also run at every change of the bus state; a rate over a few milliseconds would be meaningless.
        if (elapsed := now - self._rates_updated_at) > _RATE_INTERVAL:
            good = {name: self._decoder.statistics(name).good for name in self._decoder.table.messages}
            counts, previous = {"": status.frames, **good}, self._previous_counts
            self._rates = {name: (count - previous.get(name, 0)) / elapsed for name, count in counts.items()}
            self._rates_updated_at, self._previous_counts = now, counts
        values = {
            "state": status.state, "rate [frames/s]": self._rates.get("", 0.0), "frames": status.frames,
            "error frames": status.error_frames, "last error frame": status.last_error,
            "times opened": status.open_count, "failures": status.failures,
            "frames not processed": status.callback_errors,
            "receive delay median [ms]": 1e3 * status.delay, "receive delay maximum [ms]": 1e3 * status.delay_maximum,
        }
        text = f"{self._bus_name} {status.state}" + (f": {status.reason}" if status.reason else "")
        if status.state is BusState.OK and status.delay > MAX_BACKLOG:
            return Check("bus", WARN, f"{text}: frames are processed {status.delay:.1f} s after their stamps, optional "
                         "messages are omitted; the computer is busy, or the adapter's clock differs", values)
        return Check("bus", _LEVELS[status.state], text, values)

    def _check_signals(self) -> Check:
        now_ns = self._now_ns()
        values: dict[str, Any] = {}
        missing: list[str] = []
        stale: list[str] = []
        for message in self._decoder.table.messages.values():
            last_seen_ns = self._decoder.statistics(message.name).last_seen_ns
            age = None if last_seen_ns is None else (now_ns - last_seen_ns) * 1e-9
            for signal in message.signals:
                values[f"{signal.name} ({message.name}) age [s]"] = "no good frame yet" if age is None else age
            fault = "no good frame yet" if age is None else f"newest good frame is {age:.1f} s old"
            text = f"{', '.join(s.name for s in message.signals)} ({message.name}): {fault}"
            if message.is_needed and (age is None or age > message.timeout):
                missing.append(text)
            elif age is not None and age > message.timeout:
                stale.append(text)
        if missing and time.monotonic() - self._started_at > _START_UP_TIME:
            return Check("signals", ERROR, "; ".join(missing), values)
        if stale:
            return Check("signals", WARN, "; ".join(stale), values)
        text = "waiting for the first good frames" if missing else "required signals are up to date"
        return Check("signals", OK, text, values)

    def _check_frames(self) -> Check:
        values: dict[str, Any] = {}
        bad = 0
        for name, message in self._decoder.table.messages.items():
            counts = self._decoder.statistics(name)
            values[f"{name} good"] = counts.good
            values[f"{name} rate, expected [frames/s]"] = f"{self._rates.get(name, 0.0):.1f}, {1 / message.period:g}"
            for fault in ("lost", "wrong_counter", "wrong_checksum", "wrong_length", "not_finite", "implausible",
                          "dropped"):
                if count := getattr(counts, fault):
                    values[f"{name} {fault.replace('_', ' ')}"] = count
            bad += counts.bad
        values["unknown identifiers"] = self._decoder.skipped["unknown"]
        values["remote frames"] = self._decoder.skipped["remote"]
        new_bad, self._previous_bad = bad - self._previous_bad, bad
        if new_bad:
            return Check("frames", WARN, f"{new_bad} bad frames since the last report, {bad} since start", values)
        return Check("frames", OK, f"no bad frame since the last report, {bad} since start", values)
