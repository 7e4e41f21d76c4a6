"""The minute of packets by the host's clock, for a live stream whose channel 0 never comes."""

from .gps_time import GpsClock, host_minute
from .stream import Received

# A stream without channel 0 for this long gets its minute from the host's clock [ns].
PATIENCE_NS = 2_000_000_000


class HostMinute:
    """Publishing waits for channel 0, every 10th packet; where it never comes the host's clock has to do."""

    def __init__(self) -> None:
        self._untimed_since: int | None = None

    def look(self, received: Received, received_ns: int, clock: GpsClock) -> bool:
        """Take a packet of the series and the time the host got it; True where the clock was given its minute."""
        if not received.rule.time or received.gps_ns is not None:
            self._untimed_since = None
            return False
        if self._untimed_since is None:
            self._untimed_since = received_ns
        if received_ns - self._untimed_since <= PATIENCE_NS:
            return False
        clock.hint(host_minute(received_ns, received.packet.milliseconds))
        return True
