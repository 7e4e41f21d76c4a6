"""Packet time: milliseconds of the minute plus an occasional minute number become one clock, in integers.

GPS time counts from 1980-01-06T00:00:00 without leap seconds: gps = minutes * 60 s + ms.  UTC = gps - leap seconds.
Source: ncom.md section 5. Checked by: test_gps_time.py, tests/golden/test_ncom_vectors.py.
"""

from st_core.leap_seconds import GPS_EPOCH_UNIX, at_gps

MINUTE_MS = 60_000
WEEK_MS = 604_800_000

# Minutes an NCOM stream can mean: below, the manual says "unknown"; above 2038, no ROS stamp can carry it.
FIRST_MINUTE, LAST_MINUTE = 1_000, 30_525_000

NEW, SAME, LATE, DUPLICATE = 0, 1, 2, 3  # a duplicate is the same to the last byte
# Packets at most this far behind are late, others are ahead: half a minute each way is all that ms alone can tell.
HALF_MINUTE_MS = 30_000
# So many late packets in a row, each after the one before: not reordering but a clock that was set back.
LATE_RUN = 10
# Longest silence on the receive clock over which the minute is still counted on.
LONGEST_GAP_NS = 30_000_000_000
# Within this of a minute's turn a channel 0 that is one minute off has to be confirmed by the next.
DOUBT_MS = 1_000
# A step of the packet time beyond the silence on the receive clock that counts as a jump.
LARGEST_STEP_NS = 1_000_000_000


UTC_CHANNEL = 16


def sent_utc_offset(byte: int) -> int | None:
    """UTC - GPS time [s] by the last byte of UTC_CHANNEL; None where it says that is not known, and above 0: UTC has
    never been ahead of GPS time."""
    offset = (byte - 256 if byte > 127 else byte) >> 1
    return offset if byte & 1 and offset <= 0 else None


def unix_nanoseconds(gps_nanoseconds: int, utc_offset: int | None = None) -> int:
    """UTC as nanoseconds since 1970 from GPS time [ns]; utc_offset: UTC - GPS as the unit sends it (negative) [s],
    else table."""
    if utc_offset is None:
        utc_offset = -at_gps(gps_nanoseconds // 1_000_000_000)
    return gps_nanoseconds + (GPS_EPOCH_UNIX + utc_offset) * 1_000_000_000


def host_minute(received_ns: int, milliseconds: int) -> int:
    """The GPS minute that puts a packet's milliseconds nearest to a host time [ns since 1970]; right if that clock is
    within half a minute."""
    gps_ms = received_ns // 1_000_000 - GPS_EPOCH_UNIX * 1000
    gps_ms += at_gps(gps_ms // 1000) * 1000
    return round((gps_ms - milliseconds) / MINUTE_MS)


class GpsClock:
    """Time of each packet of a series that carries bytes 1-2 (navigation status 2, 3, 4).

    minute: of the newest packet, None until known. jumps: times it went back or more than a second ahead other than
    by the packets' own milliseconds. step() never raises.
    """

    def __init__(self) -> None:
        self.minute: int | None = None
        self.milliseconds: int | None = None
        self.jumps = 0
        self._received_ns: int | None = None
        self._doubted: int | None = None
        self._run = 0
        self._run_ms = 0
        self._run_minute: int | None = None

    @property
    def settled(self) -> bool:
        """Whether the minute is known and nothing odd is being watched: from here on counting is enough."""
        return self.minute is not None and self._doubted is None and self._run == 0

    def hint(self, minute: int) -> None:
        """The minute of a status-only packet (its milliseconds say nothing): taken where none is known yet."""
        if self.minute is None:
            self.minute = minute

    def step(self, ms: int, minute: int | None = None, received_ns: int | None = None) -> tuple[int | None, int]:
        """Take one packet: its ms, its channel 0 minute if it has one, host receive time if there is one.

        Returns (GPS time [ms] or None while no minute is known, NEW | SAME | LATE relative to the newest packet).
        """
        last = self.milliseconds
        if last is None:
            self.milliseconds = ms
            self.minute = self.minute if minute is None else minute
            self._received_ns = received_ns
            return self._time(), NEW
        silence = 0
        if received_ns is not None:
            silence = received_ns - (received_ns if self._received_ns is None else self._received_ns)
            if silence > LONGEST_GAP_NS:
                return self._restart(ms, minute, received_ns), NEW
            self._received_ns = received_ns
        ahead = (ms - last) % MINUTE_MS
        if ahead >= HALF_MINUTE_MS and not self._is_ahead(ms, minute):
            return self._late(ms, minute, ahead, received_ns)
        self._run = 0
        self.milliseconds = ms
        jumped = ahead >= HALF_MINUTE_MS
        if jumped:
            self.minute, self._doubted = minute, None
        else:
            if self.minute is not None and ms < last:
                self.minute += 1
            if minute is not None:
                jumped = self._channel_0(ms, minute)
            jumped = jumped or ahead * 1_000_000 - silence > LARGEST_STEP_NS
        self.jumps += jumped
        return self._time(), NEW if ahead else SAME

    def _time(self) -> int | None:
        if self.minute is None or self.milliseconds is None:
            return None
        return self.minute * MINUTE_MS + self.milliseconds

    def _channel_0(self, ms: int, minute: int) -> bool:
        """Compare the counted minute with the sent one, which wins; True if that moved the time."""
        if self.minute is None or minute == self.minute:
            self.minute, self._doubted = minute, None
            return False
        difference = minute - self.minute
        near_turn = ms < DOUBT_MS or ms >= MINUTE_MS - DOUBT_MS
        if near_turn and abs(difference) == 1 and self._doubted != difference:
            self._doubted = difference
            return False
        self.minute, self._doubted = minute, None
        return True

    def _is_ahead(self, ms: int, minute: int | None) -> bool:
        """Whether a packet that looks old by its ms alone says by its minute that it is not."""
        now = self._time()
        return minute is not None and now is not None and minute * MINUTE_MS + ms > now

    def _late(self, ms: int, minute: int | None, ahead: int, received_ns: int | None) -> tuple[int | None, int]:
        follows = self._run and (ms - self._run_ms) % MINUTE_MS < HALF_MINUTE_MS
        if follows:
            self._run += 1
            if self._run_minute is not None and ms < self._run_ms:
                self._run_minute += 1
        else:
            self._run, self._run_minute = 1, None
        self._run_ms = ms
        if minute is not None:
            self._run_minute = minute
        if self._run > LATE_RUN:
            self.jumps += 1
            return self._restart(ms, self._run_minute, received_ns), NEW
        if minute is not None:
            return minute * MINUTE_MS + ms, LATE
        now = self._time()
        # A late packet may belong to a minute before; a series whose clock was set back is not known to be late yet.
        return (None if now is None else now - (MINUTE_MS - ahead)), LATE

    def _restart(self, ms: int, minute: int | None, received_ns: int | None) -> int | None:
        self.milliseconds, self.minute = ms, minute
        self._received_ns, self._doubted, self._run = received_ns, None, 0
        return self._time()
