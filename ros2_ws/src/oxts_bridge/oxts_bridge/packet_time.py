"""Computes GPS and UTC times of NCOM packets in integers; each has the milliseconds of its minute, some the minute.

GPS time counts from 1980-01-06T00:00:00 without leap seconds: gps = minutes * 60 s + ms.  UTC = gps - leap seconds.
Source: NCOM manual 260702. Checked by: test_packet_time.py, tests/golden/test_ncom_vectors.py.
"""

from st_core.leap_seconds import GPS_EPOCH_UNIX, leap_seconds_at_gps

MINUTE_MS = 60_000
WEEK_MS = 604_800_000

# Valid GPS minutes: the manual defines smaller numbers as "unknown"; ROS stamps end in 2038.
FIRST_MINUTE, LAST_MINUTE = 1_000, 30_525_000

# Order of a packet relative to the newest one. SAME: equal time; DUPLICATE: equal bytes too.
NEW, SAME, LATE, DUPLICATE = 0, 1, 2, 3
# Milliseconds of the minute are ambiguous: a packet that would be ahead by this time or more is taken as late instead.
HALF_MINUTE_MS = 30_000
# After more than this many consecutive late packets in ascending order, the clock is taken to have been set back.
MAX_LATE_RUN = 10
LONGEST_GAP_NS = 30_000_000_000  # longest pause on the receive clock across which the minute count is continued
# Within this time of a minute change [ms], a channel 0 that differs by one minute must be confirmed by the next one.
CONFIRMATION_MS = 1_000
# A step of the packet time that exceeds the pause on the receive clock by more than this is a jump [ns].
LARGEST_STEP_NS = 1_000_000_000


def to_unix_nanoseconds(gps_nanoseconds: int, utc_offset: int | None = None) -> int:
    """UTC [ns since 1970] from GPS time [ns since 1980-01-06].

    utc_offset: UTC - GPS as sent by the unit [s], negative; None: leap-second table.
    """
    if utc_offset is None:
        utc_offset = -leap_seconds_at_gps(gps_nanoseconds // 1_000_000_000)
    return gps_nanoseconds + (GPS_EPOCH_UNIX + utc_offset) * 1_000_000_000


def compute_host_minute(received_ns: int, milliseconds: int) -> int:
    """The GPS minute in which a packet with these milliseconds is nearest to a host time [ns since 1970].

    Correct if the host's clock is within half a minute of UTC.
    """
    gps_ms = received_ns // 1_000_000 - GPS_EPOCH_UNIX * 1000
    gps_ms += leap_seconds_at_gps(gps_ms // 1000) * 1000
    return round((gps_ms - milliseconds) / MINUTE_MS)


class GpsClock:
    """Tracks the GPS time of packets that all have milliseconds of the minute, and some the minute (channel 0).

    The clock counts a minute whenever the milliseconds wrap; a sent minute has precedence over the count.
    minute, milliseconds: time of the newest packet, None until known. jumps: number of steps back, forward by more than
    1 s beyond the pause on the receive clock (0 in a file), or to a sent minute that differs from the count.
    """

    def __init__(self) -> None:
        self.minute: int | None = None
        self.milliseconds: int | None = None
        self.jumps = 0
        self._received_ns: int | None = None
        self._unconfirmed: int | None = None  # difference of the last sent minute from the count
        self._late_count = 0  # length of the current run of late packets
        self._late_ms = 0  # time of its newest packet
        self._late_minute: int | None = None

    @property
    def is_settled(self) -> bool:
        """Whether the time is known and neither a minute change nor a run of late packets awaits confirmation."""
        return self._compute_time() is not None and self._unconfirmed is None and self._late_count == 0

    def hint(self, minute: int) -> None:
        """Set the minute, from a status-only packet (no milliseconds) or the host's clock, if none is known yet."""
        if self.minute is None:
            self.minute = minute

    def step(self, ms: int, minute: int | None = None, received_ns: int | None = None) -> tuple[int | None, int]:
        """(GPS time [ms] of the next packet, None while no minute is known; its order NEW, SAME or LATE).

        ms: milliseconds of the minute. minute: sent in channel 0, None if the packet has none. received_ns: host time
        of receipt, None for packets from a file.
        """
        pause = 0
        if received_ns is not None:
            pause = received_ns - (received_ns if self._received_ns is None else self._received_ns)
            self._received_ns = received_ns
        if self.milliseconds is None:
            return self._restart(ms, self.minute if minute is None else minute), NEW
        if pause > LONGEST_GAP_NS:
            return self._restart(ms, minute), NEW
        ahead = (ms - self.milliseconds) % MINUTE_MS
        if ahead >= HALF_MINUTE_MS:
            return self._step_back(ms, minute, MINUTE_MS - ahead)
        jumped = ahead * 1_000_000 - pause > LARGEST_STEP_NS
        if self.minute is not None and ms < self.milliseconds:
            self.minute += 1
        self.milliseconds, self._late_count = ms, 0
        if minute is not None and minute != self.minute:
            jumped |= self._correct_minute(ms, minute)
        elif minute is not None:
            self._unconfirmed = None
        self.jumps += jumped
        return self._compute_time(), NEW if ahead else SAME

    def _compute_time(self) -> int | None:
        """GPS time of the newest packet [ms]."""
        if self.minute is None or self.milliseconds is None:
            return None
        return self.minute * MINUTE_MS + self.milliseconds

    def _correct_minute(self, ms: int, minute: int) -> bool:
        """Replace the counted minute by a different one that was sent; returns whether the time jumps."""
        difference = None if self.minute is None else minute - self.minute
        is_near_change = ms < CONFIRMATION_MS or ms >= MINUTE_MS - CONFIRMATION_MS
        if is_near_change and difference in (-1, 1) and self._unconfirmed != difference:
            self._unconfirmed = difference
            return False
        self.minute, self._unconfirmed = minute, None
        return difference is not None

    def _step_back(self, ms: int, minute: int | None, behind: int) -> tuple[int | None, int]:
        """(GPS time [ms], order) of a packet that seems late by `behind` [ms]; NEW if the clock was set instead."""
        now = self._compute_time()
        if minute is not None and now is not None and minute * MINUTE_MS + ms > now:  # a later minute was sent
            self.jumps += 1
            return self._restart(ms, minute), NEW
        if self._late_count and (ms - self._late_ms) % MINUTE_MS < HALF_MINUTE_MS:
            self._late_count += 1
            if self._late_minute is not None and ms < self._late_ms:
                self._late_minute += 1
        else:
            self._late_count, self._late_minute = 1, None
        self._late_ms = ms
        if minute is not None:
            self._late_minute = minute
        if self._late_count > MAX_LATE_RUN:
            self.jumps += 1
            return self._restart(ms, self._late_minute), NEW
        if minute is not None:
            return minute * MINUTE_MS + ms, LATE
        return None if now is None else now - behind, LATE

    def _restart(self, ms: int, minute: int | None) -> int | None:
        self.milliseconds, self.minute = ms, minute
        self._unconfirmed, self._late_count = None, 0
        return self._compute_time()
