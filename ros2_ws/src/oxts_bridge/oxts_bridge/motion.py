"""Motion of the vehicle in the axes and units of ROS from one packet, the origin of the map frame, and odometry
reconstructed from recorded packets. No ROS in here.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import degrees, isfinite, isnan, radians
from typing import NamedTuple

from .geometry import Attitude, LocalFrame, Quaternion, Vector, enu_from_ned, flu_from_frd
from .packet_time import NEW, SAME
from .status import StatusTracker
from .stream import HostMinute, NcomParser, Received

FIRST_FIX, GIVEN, UNIT = "first_fix", "given", "unit"
# A unit repeats its local frame about every 200 packets; one that has not sent it after this time has none [ns].
LOCAL_FRAME_TIMEOUT_NS = 10_000_000_000


@dataclass(slots=True)
class Accuracy:
    """Standard deviations reported by the unit, NaN unknown (never sent, or marked as outdated).

    east, north, up [m]; velocity_east, velocity_north, velocity_up [m/s]; roll, pitch, heading [rad].
    """

    east: float
    north: float
    up: float
    velocity_east: float
    velocity_north: float
    velocity_up: float
    roll: float
    pitch: float
    heading: float

    @classmethod
    def from_status(cls, status: StatusTracker) -> "Accuracy":
        lengths = map(status.number, ("EastAcc", "NorthAcc", "AltAcc", "VeAcc", "VnAcc", "VdAcc"))
        return cls(*lengths, *(radians(status.number(name)) for name in ("RollAcc", "PitchAcc", "HeadingAcc")))

    @property
    def position_variances(self) -> Vector | None:
        """East, north, up [m^2]; None while unknown."""
        east, north, up = self.east**2, self.north**2, self.up**2
        return None if isnan(east + north + up) else (east, north, up)

    @property
    def velocity_known(self) -> bool:
        return not isnan(self.velocity_east + self.velocity_north + self.velocity_up)

    @property
    def attitude_known(self) -> bool:
        return not isnan(self.roll + self.pitch + self.heading)


@dataclass(slots=True)
class Motion:
    """Motion of the INS point at one instant.

    latitude, longitude [rad], altitude [m] as sent.  attitude: body (FLU) in ENU.  velocity: ENU [m/s].  body_velocity,
    angular_velocity, acceleration: FLU [m/s, rad/s, m/s^2]; acceleration is specific force, +9.8 up at rest.
    """

    latitude: float
    longitude: float
    altitude: float
    attitude: Attitude
    velocity: Vector
    body_velocity: Vector
    angular_velocity: Vector
    acceleration: Vector

    def position(self, frame: LocalFrame) -> Vector:
        """East, north, up [m] in a local frame."""
        return frame.enu(self.latitude, self.longitude, self.altitude)


def motion_of(received: Received) -> Motion | None:
    """Motion from one packet; None unless position, velocity, angles and rates are valid (status 2 has no fix)."""
    if received.rule.navigation != "valid" or received.kind not in ("regular", "trigger"):
        return None
    packet = received.packet
    total = sum(packet.velocity_ned) + sum(packet.angular_rate) + packet.latitude + packet.heading
    total += packet.pitch + packet.roll
    if not isfinite(total):
        return None
    attitude = Attitude(packet.heading, packet.pitch, packet.roll)
    velocity = enu_from_ned(packet.velocity_ned)
    return Motion(
        packet.latitude,
        packet.longitude,
        packet.altitude,
        attitude,
        velocity,
        attitude.to_body(velocity),
        flu_from_frd(packet.angular_rate),
        flu_from_frd(packet.acceleration),
    )


class Origin:
    """Origin of the map frame: the first fix, a given point, or the unit's own local frame; constant once chosen.

    frame: None until chosen. degrees: its latitude, longitude [deg], altitude [m], which reproduce the frame to the
    last bit. With source "unit" the first fix is used if the unit sends no local frame within 10 s.
    """

    def __init__(self, source: str, given: tuple[float, float, float] | None = None) -> None:
        """given: latitude, longitude [deg], altitude [m] of the same kind as the unit sends; for source "given"."""
        self.source = source
        self.used = ""
        self.frame: LocalFrame | None = None
        self.degrees: tuple[float, float, float] | None = None
        self._since_ns: int | None = None
        if source == GIVEN:
            if given is None:
                raise ValueError("origin_source given needs an origin")
            self._set(GIVEN, *given)

    def update(self, motion: Motion, status: StatusTracker, now_ns: int) -> LocalFrame | None:
        """The map frame, chosen at this fix if it was not yet; now_ns: time on any monotonic clock [ns]."""
        if self.frame is not None:
            return self.frame
        if self.source == UNIT:
            sent = status.local_frame
            if sent is not None:
                return self._set(UNIT, *sent[:3])
            self._since_ns = now_ns if self._since_ns is None else self._since_ns
            if 0 <= now_ns - self._since_ns < LOCAL_FRAME_TIMEOUT_NS:
                return None
        return self._set(FIRST_FIX, degrees(motion.latitude), degrees(motion.longitude), motion.altitude)

    def _set(self, used: str, latitude: float, longitude: float, altitude: float) -> LocalFrame:
        self.used = used
        self.degrees = latitude, longitude, altitude
        self.frame = LocalFrame(radians(latitude), radians(longitude), altitude)
        return self.frame


class ReconstructedOdometry(NamedTuple):
    """One odometry message. stamp_ns: UTC since 1970. position: ENU from the origin [m]. velocity, rate: FLU."""

    stamp_ns: int
    position: Vector
    orientation: Quaternion
    velocity: Vector
    rate: Vector


def reconstruct_odometry(
    packets: Iterable[tuple[int, bytes]], origin: Origin, live: bool = True, by_receive_time: bool = False
) -> Iterator[ReconstructedOdometry]:
    """Odometry as the live node published it from recorded packets, equal to the last bit; about 20 us per packet.

    packets: (received [ns since 1970], 72 bytes), in order of receipt. origin: as configured in the node. live: from a
    unit, not from a replayed file. by_receive_time: value "receive" of the parameter stamp_source.
    """
    parser, status, minute = NcomParser(), StatusTracker(), HostMinute()
    for received_ns, raw in packets:
        for received in parser.feed(raw, received_ns if live else None):
            received.received_ns = received_ns
            if received.order not in (NEW, SAME):
                continue
            if origin.frame is None:
                status.update_from(received)
            motion = motion_of(received)
            frame = None if motion is None else origin.update(motion, status, received_ns)
            if received.kind != "regular" or received.order != NEW:
                continue
            if live:
                minute.update(received, received_ns, parser.clock)
            stamp = received_ns if by_receive_time else received.utc_ns
            if motion is not None and frame is not None and stamp is not None:
                yield ReconstructedOdometry(stamp, motion.position(frame), motion.attitude.quaternion(),
                                            motion.body_velocity, motion.angular_velocity)
