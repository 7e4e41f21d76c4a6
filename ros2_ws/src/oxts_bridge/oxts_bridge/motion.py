"""Extracts the motion of the vehicle from packets and locates it in the map frame."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import degrees, isfinite, isnan, radians
from typing import NamedTuple

from .geometry import Attitude, LocalFrame, Number, Vector, flu_from_frd
from .ncom import NEW, SAME, Packet
from .status import StatusTracker
from .stream import NcomParser, ReceivedPacket

FIRST_FIX, GIVEN, UNIT = "first_fix", "given", "unit"  # sources of the origin of the map
# A unit with a local frame sends it at least every 200 packets; after this time [ns], it is assumed to have none.
LOCAL_FRAME_TIMEOUT_NS = 10_000_000_000


class Accuracy(NamedTuple):
    """Standard deviations reported by the unit; NaN if unknown (never sent, or declared outdated)."""

    position: Vector  # east, north, up [m]
    velocity: Vector  # east, north, up [m/s]
    attitude: Vector  # roll, pitch, heading [rad]

    @classmethod
    def from_status(cls, status: StatusTracker) -> "Accuracy":
        number = status.get_number
        return cls((number("EastAcc"), number("NorthAcc"), number("AltAcc")),
                   (number("VeAcc"), number("VnAcc"), number("VdAcc")),
                   (radians(number("RollAcc")), radians(number("PitchAcc")), radians(number("HeadingAcc"))))


def compute_variances(standard_deviations: Vector) -> Vector | None:
    """Squares of three standard deviations; None if any is unknown."""
    a, b, c = standard_deviations
    return None if isnan(a + b + c) else (a**2, b**2, c**2)


@dataclass(slots=True)
class Motion:
    """Motion of the INS point in ROS axes, at one instant, or as arrays over time."""

    latitude: Number  # as sent [rad]
    longitude: Number  # as sent [rad]
    altitude: Number  # as sent [m]
    attitude: Attitude
    velocity: Vector  # ENU [m/s]
    body_velocity: Vector  # FLU [m/s]
    angular_velocity: Vector  # FLU [rad/s]
    acceleration: Vector  # specific force, FLU, +9.8 up at rest [m/s^2]

    @classmethod
    def from_packet(cls, packet: Packet) -> "Motion":
        attitude = Attitude.from_ned(packet.heading, packet.pitch, packet.roll)
        north, east, down = packet.velocity_ned
        velocity = east, north, -down
        return cls(packet.latitude, packet.longitude, packet.altitude, attitude, velocity, attitude.to_body(velocity),
                   flu_from_frd(packet.angular_rate), flu_from_frd(packet.acceleration))

    def locate(self, frame: LocalFrame) -> Vector:
        """East, north, up [m] in a local frame."""
        return frame.to_enu(self.latitude, self.longitude, self.altitude)


def extract_motion(received: ReceivedPacket) -> Motion | None:
    """The motion in a packet; None unless it has a fix and valid position, velocity, angles and angular rates."""
    if received.rule.navigation != "valid" or received.kind not in ("regular", "trigger"):
        return None
    packet = received.packet
    total = sum(packet.velocity_ned) + sum(packet.angular_rate) + packet.latitude + packet.heading
    total += packet.pitch + packet.roll
    return Motion.from_packet(packet) if isfinite(total) else None


class Origin:
    """Origin of the map frame: the first fix, a given point, or the unit's own local frame; constant once chosen.

    frame: None until chosen. geodetic: latitude, longitude [deg], altitude [m] of the origin. source: as configured.
    chosen_source: source of the chosen origin ("" before), FIRST_FIX if a unit's local frame is missing for 10 s.
    """

    def __init__(self, source: str, given: tuple[float, float, float] | None = None) -> None:
        """given: latitude, longitude [deg], altitude [m] as sent by the unit; required for source GIVEN."""
        self.source = source
        self.chosen_source = ""
        self.frame: LocalFrame | None = None
        self.geodetic: tuple[float, float, float] | None = None
        self._waiting_since_ns: int | None = None  # for the unit's local frame
        if given is not None:
            self._set(GIVEN, *given)

    def update(self, motion: Motion, status: StatusTracker, now_ns: int) -> LocalFrame | None:
        """The map frame; chosen in this call if it was not before. None while waiting for the unit's local frame.

        now_ns: time [ns], always of the same clock; the wait also ends if it is set back to before the wait began.
        """
        if self.frame is not None:
            return self.frame
        if self.source == UNIT:
            if (local_origin := status.local_origin) is not None:
                return self._set(UNIT, *local_origin)
            if self._waiting_since_ns is None:
                self._waiting_since_ns = now_ns
            if 0 <= now_ns - self._waiting_since_ns < LOCAL_FRAME_TIMEOUT_NS:
                return None
        return self._set(FIRST_FIX, degrees(motion.latitude), degrees(motion.longitude), motion.altitude)

    def _set(self, source: str, latitude: float, longitude: float, altitude: float) -> LocalFrame:
        self.chosen_source = source
        self.geodetic = latitude, longitude, altitude
        self.frame = LocalFrame(radians(latitude), radians(longitude), altitude)
        return self.frame


def reconstruct_odometry(packets: Iterable[tuple[int, bytes]], origin: Origin, live: bool = True,
                         by_receive_time: bool = False) -> Iterator[tuple[int, Vector, Motion]]:
    """Yields (header stamp [ns since 1970], ENU position relative to the origin [m], motion) of every odometry message
    that the node would publish for these packets, with identical values.

    packets: (time of receipt [ns since 1970], 72 bytes), in order of receipt. origin: as configured in the node.
    live: the packets came from a unit, not from a replayed file. by_receive_time: stamp_source was "receive".
    """
    parser, status = NcomParser(), StatusTracker()
    for received_ns, raw in packets:
        for received in parser.feed(raw, received_ns if live else None):
            received.received_ns = received_ns
            if received.order not in (NEW, SAME):
                continue
            if origin.frame is None:
                status.update_from(received)
            motion = extract_motion(received)
            frame = None if motion is None else origin.update(motion, status, received_ns)
            if received.kind != "regular" or received.order != NEW:
                continue
            stamp = received_ns if by_receive_time else received.utc_ns
            if motion is not None and frame is not None and stamp is not None:
                yield stamp, motion.locate(frame), motion
