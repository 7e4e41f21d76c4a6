"""What one packet says about the vehicle in ROS' axes and units, and how sure the unit is. No ROS in here."""

from dataclasses import dataclass
from math import isfinite, isnan, radians

from .attitude import Attitude, Vector, enu_from_ned, flu_from_frd
from .geodesy import LocalFrame
from .status import StatusTracker
from .stream import Received


@dataclass(slots=True)
class Accuracy:
    """One standard deviation of each, NaN unknown (never sent, or older than the unit vouches for).

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
        number = status.number
        return cls(
            number("EastAcc"),
            number("NorthAcc"),
            number("AltAcc"),
            number("VeAcc"),
            number("VnAcc"),
            number("VdAcc"),
            radians(number("RollAcc")),
            radians(number("PitchAcc")),
            radians(number("HeadingAcc")),
        )

    @property
    def position_known(self) -> bool:
        return not isnan(self.east + self.north + self.up)

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
    """The motion a packet tells, None unless position, velocity, angles and rates are valid (no fix in status 2)."""
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
