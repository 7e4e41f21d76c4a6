"""Packet times of a whole file: vectorised wherever nothing happens, step by step through GpsClock where something
does."""

from collections.abc import Callable, Sequence

import numpy as np
from st_core.leap_seconds import GPS_EPOCH_UNIX, at_all_gps

from .gps_time import DUPLICATE, HALF_MINUTE_MS, LARGEST_STEP_NS, MINUTE_MS, NEW, SAME, GpsClock


def packet_times(
    ms: np.ndarray,
    minutes: np.ndarray,
    index: np.ndarray,
    hints: Sequence[tuple[int, int]],
    equal: Callable[[int, int], bool],
) -> tuple[np.ndarray, np.ndarray, int]:
    """GPS time [ms] (-1 unknown) and order of each timed packet, and the number of time jumps.

    ms, minutes: of each timed packet, minutes -1 where it has no channel 0. index: its packet number. hints: (packet
    number, minute) of status-only packets. equal(i, j): whether the bytes of timed packets i and j are the same.
    """
    count = len(ms)
    times = np.full(count, -1, np.int64)
    order = np.full(count, NEW, np.int8)
    clock = GpsClock()
    events = _Events(ms, minutes)
    waiting = list(hints)
    k = 0
    while k < count:
        while waiting and waiting[0][0] < index[k]:
            clock.hint(int(waiting.pop(0)[1]))
        time, order[k] = clock.step(int(ms[k]), None if minutes[k] < 0 else int(minutes[k]))
        times[k] = -1 if time is None else time
        k += 1
        minute = clock.minute
        if minute is None or not clock.settled:
            continue
        end = events.next(k, minute)
        if end > k:
            run = slice(k, end)
            times[run] = (minute + events.turns[run] - events.turns[k - 1]) * MINUTE_MS + ms[run]
            order[run][events.ahead[run] == 0] = SAME
            clock.jumps += int((events.ahead[run] * 1_000_000 > LARGEST_STEP_NS).sum())
            clock.minute, clock.milliseconds = int(times[end - 1] // MINUTE_MS), int(ms[end - 1])
            k = end
            # Hints inside the run came while the minute was known and meant nothing.
            waiting = [hint for hint in waiting if hint[0] > index[k - 1]]
    for i in np.flatnonzero(order == SAME).tolist():
        if equal(i, i - 1):
            order[i] = DUPLICATE
    return times, order, clock.jumps


class _Events:
    """Where the plain rule "count on, add a minute when ms wraps" stops to hold."""

    def __init__(self, ms: np.ndarray, minutes: np.ndarray):
        self.ahead = np.diff(ms, prepend=ms[:1]) % MINUTE_MS
        wrapped = np.diff(ms, prepend=ms[:1]) < 0
        self.turns = np.cumsum(wrapped & (self.ahead < HALF_MINUTE_MS))
        self._late = np.flatnonzero(self.ahead >= HALF_MINUTE_MS)
        self._sent = np.flatnonzero(minutes >= 0)
        # A sent minute agrees with the count as long as minute - turns stays the same.
        self._base = minutes[self._sent] - self.turns[self._sent]
        self._changes = np.flatnonzero(np.diff(self._base)) + 1
        self._count = len(ms)

    def next(self, k: int, minute: int) -> int:
        """First packet from k on that is late or whose sent minute differs, given the minute of packet k - 1; else
        the end."""
        end = self._at(self._late, int(np.searchsorted(self._late, k)))
        j = int(np.searchsorted(self._sent, k))
        if j == len(self._sent):
            return end
        if self._base[j] != minute - self.turns[k - 1]:
            return min(end, int(self._sent[j]))
        change = np.searchsorted(self._changes, j, side="right")
        return min(end, int(self._sent[self._changes[change]]) if change < len(self._changes) else end)

    def _at(self, positions: np.ndarray, i: int) -> int:
        return int(positions[i]) if i < len(positions) else self._count


def utc_times(gps_ns: np.ndarray, unknown: int, where: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """UTC since 1970 [ns]: with the unit's offset from the packet on that carries one (where, offsets [s]), else by
    the table."""
    known = gps_ns != unknown
    seconds = np.where(known, gps_ns // 1_000_000_000, 0)
    offset = -at_all_gps(seconds)
    if len(where):
        newest = np.searchsorted(where, np.arange(len(gps_ns)), side="right") - 1
        offset = np.where(newest >= 0, offsets[np.maximum(newest, 0)], offset)
    return np.where(known, gps_ns + (GPS_EPOCH_UNIX + offset) * 1_000_000_000, unknown)
