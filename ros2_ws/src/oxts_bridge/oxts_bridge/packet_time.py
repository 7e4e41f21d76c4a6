"""GPS and UTC time of NCOM packets in integers, from the milliseconds of the minute and an occasional minute number.

GpsClock steps through a stream packet by packet; packet_times does a whole file in columns.

GPS time counts from 1980-01-06T00:00:00 without leap seconds: gps = minutes * 60 s + ms.  UTC = gps - leap seconds.
Source: ncom.md section 5. Checked by: test_packet_time.py, tests/golden/test_ncom_vectors.py.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np
from st_core.leap_seconds import GPS_EPOCH_UNIX, at_all_gps, at_gps

MINUTE_MS = 60_000
WEEK_MS = 604_800_000

# Valid GPS minutes: the manual defines smaller numbers as "unknown"; ROS stamps end in 2038.
FIRST_MINUTE, LAST_MINUTE = 1_000, 30_525_000

NEW, SAME, LATE, DUPLICATE = 0, 1, 2, 3  # DUPLICATE: same time and same bytes as the packet before
# A packet up to this far behind is late, any other is ahead: milliseconds of the minute resolve no more.
HALF_MINUTE_MS = 30_000
# More consecutive late packets, each later than the one before, mean that the clock was set back, not reordering.
LATE_RUN = 10
# Longest pause on the receive clock across which minutes are counted on [ns].
LONGEST_GAP_NS = 30_000_000_000
# Within this time of a minute change, a channel 0 that differs by one minute must be confirmed by the next [ms].
CONFIRMATION_MS = 1_000
# A step of the packet time that exceeds the pause on the receive clock by more than this is a jump [ns].
LARGEST_STEP_NS = 1_000_000_000
# Shorter runs of packets are faster one by one than in columns.
SHORTEST_RUN = 16


def unix_nanoseconds(gps_nanoseconds: int, utc_offset: int | None = None) -> int:
    """UTC [ns since 1970] from GPS time [ns since 1980-01-06].

    utc_offset: UTC - GPS as sent by the unit [s], negative; None: leap-second table.
    """
    if utc_offset is None:
        utc_offset = -at_gps(gps_nanoseconds // 1_000_000_000)
    return gps_nanoseconds + (GPS_EPOCH_UNIX + utc_offset) * 1_000_000_000


def host_minute(received_ns: int, milliseconds: int) -> int:
    """The GPS minute that puts a packet's milliseconds nearest to a host time [ns since 1970].

    Correct if the host's clock is within half a minute of GPS time.
    """
    gps_ms = received_ns // 1_000_000 - GPS_EPOCH_UNIX * 1000
    gps_ms += at_gps(gps_ms // 1000) * 1000
    return round((gps_ms - milliseconds) / MINUTE_MS)


class GpsClock:
    """GPS time of each packet with valid milliseconds (bytes 1-2: navigation status 2, 3, 4).

    minute: of the newest packet, None until known. jumps: number of steps back, or forward by more than 1 s beyond the
    pause on the receive clock. step() never raises.
    """

    def __init__(self) -> None:
        self.minute: int | None = None
        self.milliseconds: int | None = None
        self.jumps = 0
        self._received_ns: int | None = None
        self._unconfirmed: int | None = None
        self._late_count = 0
        self._late_ms = 0
        self._late_minute: int | None = None

    @property
    def settled(self) -> bool:
        """Whether the minute is known and neither a minute change nor a run of late packets awaits confirmation."""
        return self.minute is not None and self._unconfirmed is None and self._late_count == 0

    def hint(self, minute: int) -> None:
        """Set the minute from a status-only packet (its milliseconds are not valid) if none is known yet."""
        if self.minute is None:
            self.minute = minute

    def step(self, ms: int, minute: int | None = None, received_ns: int | None = None) -> tuple[int | None, int]:
        """GPS time [ms] of one packet, None while no minute is known, and NEW, SAME or LATE relative to the newest.

        ms: milliseconds of the packet. minute: of its channel 0, None without one. received_ns: host time of receipt,
        None in a file.
        """
        last = self.milliseconds
        if last is None:
            self.milliseconds = ms
            self.minute = self.minute if minute is None else minute
            self._received_ns = received_ns
            return self._time(), NEW
        pause = 0
        if received_ns is not None:
            pause = received_ns - (received_ns if self._received_ns is None else self._received_ns)
            if pause > LONGEST_GAP_NS:
                return self._restart(ms, minute, received_ns), NEW
            self._received_ns = received_ns
        ahead = (ms - last) % MINUTE_MS
        if ahead >= HALF_MINUTE_MS and not self._is_ahead(ms, minute):
            return self._late_packet(ms, minute, ahead, received_ns)
        self._late_count = 0
        self.milliseconds = ms
        jumped = ahead >= HALF_MINUTE_MS
        if jumped:
            self.minute, self._unconfirmed = minute, None
        else:
            if self.minute is not None and ms < last:
                self.minute += 1
            if minute is not None:
                jumped = self._compare_minute(ms, minute)
            jumped = jumped or ahead * 1_000_000 - pause > LARGEST_STEP_NS
        self.jumps += jumped
        return self._time(), NEW if ahead else SAME

    def _time(self) -> int | None:
        if self.minute is None or self.milliseconds is None:
            return None
        return self.minute * MINUTE_MS + self.milliseconds

    def _compare_minute(self, ms: int, minute: int) -> bool:
        """Reconcile the counted minute with the sent one, which has precedence; True if the time jumped."""
        if self.minute is None or minute == self.minute:
            self.minute, self._unconfirmed = minute, None
            return False
        difference = minute - self.minute
        near_new_minute = ms < CONFIRMATION_MS or ms >= MINUTE_MS - CONFIRMATION_MS
        if near_new_minute and abs(difference) == 1 and self._unconfirmed != difference:
            self._unconfirmed = difference
            return False
        self.minute, self._unconfirmed = minute, None
        return True

    def _is_ahead(self, ms: int, minute: int | None) -> bool:
        """Whether a packet that looks late by its milliseconds is ahead by its minute."""
        now = self._time()
        return minute is not None and now is not None and minute * MINUTE_MS + ms > now

    def _late_packet(self, ms: int, minute: int | None, ahead: int, received_ns: int | None) -> tuple[int | None, int]:
        follows = self._late_count and (ms - self._late_ms) % MINUTE_MS < HALF_MINUTE_MS
        if follows:
            self._late_count += 1
            if self._late_minute is not None and ms < self._late_ms:
                self._late_minute += 1
        else:
            self._late_count, self._late_minute = 1, None
        self._late_ms = ms
        if minute is not None:
            self._late_minute = minute
        if self._late_count > LATE_RUN:
            self.jumps += 1
            return self._restart(ms, self._late_minute, received_ns), NEW
        if minute is not None:
            return minute * MINUTE_MS + ms, LATE
        now = self._time()
        # The packet may belong to the previous minute. A clock that was set back is recognised after LATE_RUN packets.
        return (None if now is None else now - (MINUTE_MS - ahead)), LATE

    def _restart(self, ms: int, minute: int | None, received_ns: int | None) -> int | None:
        self.milliseconds, self.minute = ms, minute
        self._received_ns, self._unconfirmed, self._late_count = received_ns, None, 0
        return self._time()


def packet_times(
    ms: np.ndarray,
    minutes: np.ndarray,
    index: np.ndarray,
    hints: Sequence[tuple[int, int]],
    equal: Callable[[int, int], bool],
) -> tuple[np.ndarray, np.ndarray, int]:
    """GPS time [ms] (-1 unknown) and order of each timed packet of a file, and the number of time jumps.

    GpsClock steps through late packets and minute changes until it has settled; the long runs in between are computed
    in columns.

    ms, minutes: of each timed packet, minutes -1 where it has no channel 0. index: its packet number. hints: (packet
    number, minute) of status-only packets. equal(i, j): whether the bytes of timed packets i and j are the same.
    """
    step = np.diff(ms, prepend=ms[:1])
    ahead = step % MINUTE_MS
    late, sent = ahead >= HALF_MINUTE_MS, np.flatnonzero(minutes >= 0)
    rollovers = np.cumsum((step < 0) & ~late)
    base = minutes[sent] - rollovers[sent]  # constant while the sent minutes agree with the count
    events = np.union1d(np.flatnonzero(late), sent[1:][np.diff(base) != 0])
    times, order = np.full(len(ms), -1, np.int64), np.where(ahead > 0, NEW, SAME).astype(np.int8)
    counted, steps = rollovers * MINUTE_MS + ms, np.cumsum(ahead * 1_000_000 > LARGEST_STEP_NS)
    waiting, clock, k = list(hints), GpsClock(), 0
    numbers, all_ms, all_minutes = index.data, ms.data, minutes.data  # memoryviews: cheap to read one by one
    next_event, next_sent = [*events.tolist(), len(ms)], [*sent.tolist(), len(ms)]
    while k < len(ms):
        while waiting and waiting[0][0] < numbers[k]:
            clock.hint(waiting.pop(0)[1])
        time, order[k] = clock.step(all_ms[k], None if all_minutes[k] < 0 else all_minutes[k])
        times[k] = -1 if time is None else time
        k += 1
        end = next_event[bisect_left(next_event, k)] if k < len(ms) else k
        if end - k < SHORTEST_RUN or clock.minute is None or not clock.settled:
            continue
        first_minute = clock.minute - int(rollovers[k - 1])
        j = bisect_left(next_sent, k)
        if j < len(base) and base[j] != first_minute:
            end = min(end, next_sent[j])
        times[k:end] = counted[k:end] + first_minute * MINUTE_MS
        clock.jumps += int(steps[end - 1] - steps[k - 1])
        clock.minute, clock.milliseconds = divmod(int(times[end - 1]), MINUTE_MS)
        k = end
    for i in np.flatnonzero(order == SAME).tolist():
        if equal(i, i - 1):
            order[i] = DUPLICATE
    return times, order, clock.jumps


def utc_times(gps_ns: np.ndarray, unknown: int, where: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """UTC [ns since 1970] of each packet; `unknown` marks packets without a time.

    where, offsets: packets that carry a UTC offset, and its value [s], which applies from there onwards; before the
    first, the leap-second table is used.
    """
    known = gps_ns != unknown
    seconds = np.where(known, gps_ns // 1_000_000_000, 0)
    offset = -at_all_gps(seconds)
    if len(where):
        newest = np.searchsorted(where, np.arange(len(gps_ns)), side="right") - 1
        offset = np.where(newest >= 0, offsets[np.maximum(newest, 0)], offset)
    return np.where(known, gps_ns + (GPS_EPOCH_UNIX + offset) * 1_000_000_000, unknown)
