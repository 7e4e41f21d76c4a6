"""Event inputs and outputs: one event per change of the unit's counter, however often the unit repeats it."""

from dataclasses import dataclass

from .channels import TRIGGER_CHANNELS, trigger_nanoseconds
from .stream import Received


@dataclass(frozen=True, slots=True)
class Event:
    """channel: which input or output and edge.  gps_ns: instant [ns since 1980-01-06].  count: of the unit, wraps
    after 255.

    complete: the packet holds the pose at that instant (false: only the repeat in a regular packet was seen).
    """

    channel: int
    gps_ns: int
    count: int
    complete: bool


class EventLog:
    """Turns packets into events. A count first seen in a regular packet is an old event and only sets the baseline."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, int]] = {}

    def event(self, received: Received) -> Event | None:
        """The event this packet tells for the first time, if any."""
        packet = received.packet
        channel = packet.channel
        if channel not in TRIGGER_CHANNELS or not received.rule.status:
            return None
        time = trigger_nanoseconds(packet.batch_s)
        if time is None:
            return None
        count = packet.batch_s[7]
        before = self._last.get(channel)
        self._last[channel] = (count, time)
        complete = received.kind == "trigger"
        if before is None:
            return Event(channel, time, count, complete) if complete else None
        if count == before[0] or (not complete and time <= before[1]):
            return None
        return Event(channel, time, count, complete)
