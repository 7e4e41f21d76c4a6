"""Odometry made again from recorded packets: to the last bit what the live node published of them.

Packet by packet through the node's own parser, origin and axes, hence about 20 us a packet.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from .attitude import Quaternion, Vector
from .gps_time import NEW, SAME
from .host_minute import HostMinute
from .motion import motion_of
from .origin import Origin
from .status import StatusTracker
from .stream import NcomParser


class Posed(NamedTuple):
    """One odometry message. stamp_ns: UTC since 1970. position: ENU from the origin [m]. velocity, rate: FLU."""

    stamp_ns: int
    position: Vector
    orientation: Quaternion
    velocity: Vector
    rate: Vector


def odometry(packets: Iterable[tuple[int, bytes]], origin: Origin, live: bool = True,
             by_receive_time: bool = False) -> Iterator[Posed]:
    """packets: (received [ns since 1970], 72 bytes), in the order they came. origin: as the node had it.

    live: whether they came from a unit and not from a file. by_receive_time: the parameter stamp_source.
    """
    parser, status, minute = NcomParser(), StatusTracker(), HostMinute()
    for received_ns, raw in packets:
        for received in parser.feed(raw, received_ns if live else None):
            received.received_ns = received_ns
            if received.order not in (NEW, SAME):
                continue
            packet = received.packet
            if received.rule.status and origin.frame is None:
                place = (packet.latitude, packet.longitude, packet.altitude) if packet.channel == 25 else None
                status.update(packet.channel, packet.batch_s, None, place)
            motion = motion_of(received)
            frame = None if motion is None else origin.look(motion, status, received_ns)
            if received.kind != "regular" or received.order != NEW:
                continue
            if live:
                minute.look(received, received_ns, parser.clock)
            stamp = received_ns if by_receive_time else received.utc_ns
            if motion is not None and frame is not None and stamp is not None:
                yield Posed(stamp, motion.position(frame), motion.attitude.quaternion(), motion.body_velocity,
                            motion.angular_velocity)
