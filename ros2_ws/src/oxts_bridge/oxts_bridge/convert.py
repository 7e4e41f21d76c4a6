"""ROS messages from what a packet says. Each maker fills one message over and over: publishing copies it, and a new
Odometry costs more than everything else done for a packet. Signs and units: REP-103; unknown variances: see
UNKNOWN_VARIANCE."""

from math import degrees
from typing import Any

from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus, TimeReference
from st_msgs.msg import InsStatus, Ncom, Trigger
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from .attitude import Vector, flu_from_frd
from .fields import Value
from .modes import fix_status, mode_text
from .motion import Accuracy, Motion
from .navigation import rule
from .ncom import Packet
from .resync import Counters
from .status import StatusTracker

# Of a quantity whose accuracy the unit does not vouch for, where the message has no way to say "unknown": large
# enough that no filter believes it, finite so that none breaks.
UNKNOWN_VARIANCE = 1e6


def set_stamp(header: Header, nanoseconds: int) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)


def _set_quaternion(message: Any, quaternion: tuple[float, float, float, float]) -> None:
    message.x, message.y, message.z, message.w = quaternion


def _set_vector(message: Any, vector: Vector) -> None:
    message.x, message.y, message.z = vector


class OdometryMaker:
    """nav_msgs/Odometry: pose of the INS point in the map frame (ENU), twist in its own axes (FLU)."""

    def __init__(self, map_frame: str, ins_frame: str, angular_velocity_stddev: float):
        self._message = Odometry(header=Header(frame_id=map_frame), child_frame_id=ins_frame)
        covariance = self._message.twist.covariance
        for i in (21, 28, 35):
            covariance[i] = angular_velocity_stddev**2 or UNKNOWN_VARIANCE

    def make(self, stamp_ns: int, position: Vector, motion: Motion, accuracy: Accuracy) -> Odometry:
        message = self._message
        set_stamp(message.header, stamp_ns)
        pose, twist = message.pose.pose, message.twist.twist
        _set_vector(pose.position, position)
        _set_quaternion(pose.orientation, motion.attitude.quaternion())
        _set_vector(twist.linear, motion.body_velocity)
        _set_vector(twist.angular, motion.angular_velocity)
        self._pose_covariance(message.pose.covariance, motion, accuracy)
        _set_block(message.twist.covariance, 0, _velocity_covariance(motion, accuracy))
        return message

    @staticmethod
    def _pose_covariance(covariance: Any, motion: Motion, accuracy: Accuracy) -> None:
        known = accuracy.position_known
        covariance[0] = accuracy.east**2 if known else UNKNOWN_VARIANCE
        covariance[7] = accuracy.north**2 if known else UNKNOWN_VARIANCE
        covariance[14] = accuracy.up**2 if known else UNKNOWN_VARIANCE
        _set_block(covariance, 21, _orientation_covariance(motion, accuracy))


class VelocityMaker:
    """geometry_msgs/TwistWithCovarianceStamped in the axes of the INS frame (FLU)."""

    def __init__(self, ins_frame: str, angular_velocity_stddev: float):
        self._message = TwistWithCovarianceStamped(header=Header(frame_id=ins_frame))
        for i in (21, 28, 35):
            self._message.twist.covariance[i] = angular_velocity_stddev**2 or UNKNOWN_VARIANCE

    def make(self, stamp_ns: int, motion: Motion, accuracy: Accuracy) -> TwistWithCovarianceStamped:
        message = self._message
        set_stamp(message.header, stamp_ns)
        _set_vector(message.twist.twist.linear, motion.body_velocity)
        _set_vector(message.twist.twist.angular, motion.angular_velocity)
        _set_block(message.twist.covariance, 0, _velocity_covariance(motion, accuracy))
        return message


def _velocity_covariance(motion: Motion, accuracy: Accuracy) -> tuple[float, ...]:
    if not accuracy.velocity_known:
        return (UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE)
    variances = (accuracy.velocity_east**2, accuracy.velocity_north**2, accuracy.velocity_up**2)
    return motion.attitude.covariance_to_body(variances)


def _orientation_covariance(motion: Motion, accuracy: Accuracy) -> tuple[float, ...]:
    if not accuracy.attitude_known:
        return (UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE)
    return motion.attitude.orientation_covariance(accuracy.roll, accuracy.pitch, accuracy.heading)


def _set_block(covariance: Any, at: int, block: tuple[float, ...]) -> None:
    """A 3 x 3 block of a 6 x 6 matrix, its first element at index `at`."""
    covariance[at], covariance[at + 1], covariance[at + 2] = block[0:3]
    covariance[at + 6], covariance[at + 7], covariance[at + 8] = block[3:6]
    covariance[at + 12], covariance[at + 13], covariance[at + 14] = block[6:9]


class ImuMaker:
    """sensor_msgs/Imu in the INS frame (FLU): specific force (+9.8 up at rest), rates relative to inertial space.

    Covariances: zeros mean unknown, -1 in the first element that the quantity is not there at all (sensor_msgs
    convention).
    """

    def __init__(self, ins_frame: str, angular_velocity_stddev: float, linear_acceleration_stddev: float):
        self._message = Imu(header=Header(frame_id=ins_frame))
        for i in (0, 4, 8):
            self._message.angular_velocity_covariance[i] = angular_velocity_stddev**2
            self._message.linear_acceleration_covariance[i] = linear_acceleration_stddev**2

    def make(self, stamp_ns: int, packet: Packet, motion: Motion | None, accuracy: Accuracy) -> Imu:
        """motion: None while there is no valid attitude."""
        message = self._message
        set_stamp(message.header, stamp_ns)
        _set_vector(message.angular_velocity, flu_from_frd(packet.angular_rate))
        _set_vector(message.linear_acceleration, flu_from_frd(packet.acceleration))
        covariance = message.orientation_covariance
        if motion is None:
            _set_quaternion(message.orientation, (0.0, 0.0, 0.0, 1.0))
            covariance[:] = 0.0
            covariance[0] = -1.0
            return message
        _set_quaternion(message.orientation, motion.attitude.quaternion())
        covariance[:] = _orientation_covariance(motion, accuracy) if accuracy.attitude_known else 0.0
        return message


class NavSatFixMaker:
    """sensor_msgs/NavSatFix. The message means ellipsoidal height: without it the altitude is NaN, never a geoid
    height."""

    def __init__(self, ins_frame: str):
        service = NavSatStatus.SERVICE_GPS
        self._message = NavSatFix(header=Header(frame_id=ins_frame), status=NavSatStatus(service=service))

    def make(self, stamp_ns: int, motion: Motion, height: float, mode: int | None, accuracy: Accuracy) -> NavSatFix:
        """height: above the ellipsoid [m], NaN unknown. mode: position mode of the unit."""
        message = self._message
        set_stamp(message.header, stamp_ns)
        message.status.status = fix_status(mode)
        message.latitude, message.longitude = degrees(motion.latitude), degrees(motion.longitude)
        message.altitude = height
        known = accuracy.position_known
        covariance = message.position_covariance
        covariance[0] = accuracy.east**2 if known else 0.0
        covariance[4] = accuracy.north**2 if known else 0.0
        covariance[8] = accuracy.up**2 if known else 0.0
        message.position_covariance_type = (
            NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN if known else NavSatFix.COVARIANCE_TYPE_UNKNOWN
        )
        return message


class TransformMaker:
    """tf2_msgs/TFMessage odom -> base_link; base_to_ins: where the INS point is seen from base_link (FLU) [m]."""

    def __init__(self, odom_frame: str, base_frame: str, base_to_ins: Vector):
        self._transform = TransformStamped(header=Header(frame_id=odom_frame), child_frame_id=base_frame)
        self._message = TFMessage(transforms=[self._transform])
        self._to_base = (-base_to_ins[0], -base_to_ins[1], -base_to_ins[2])

    def make(self, stamp_ns: int, position: Vector, motion: Motion) -> TFMessage:
        set_stamp(self._transform.header, stamp_ns)
        lever = motion.attitude.to_enu(self._to_base)
        transform = self._transform.transform
        _set_vector(transform.translation, (position[0] + lever[0], position[1] + lever[1], position[2] + lever[2]))
        _set_quaternion(transform.rotation, motion.attitude.quaternion())
        return self._message


def static_transforms(
    stamp_ns: int, map_frame: str, odom_frame: str, base_frame: str, ins_frame: str, base_to_ins: Vector
) -> TFMessage:
    """map -> odom (identity: the INS does not drift away from the map) and base_link -> ins_link."""
    transforms = []
    for parent, child, offset in ((map_frame, odom_frame, (0.0, 0.0, 0.0)), (base_frame, ins_frame, base_to_ins)):
        transform = TransformStamped(header=Header(frame_id=parent), child_frame_id=child)
        set_stamp(transform.header, stamp_ns)
        _set_vector(transform.transform.translation, offset)
        transforms.append(transform)
    return TFMessage(transforms=transforms)


class NcomMaker:
    """st_msgs/Ncom: the packet as it came, stamped with the receive time."""

    def __init__(self, ins_frame: str):
        self._message = Ncom(header=Header(frame_id=ins_frame))

    def make(self, received_ns: int, raw: bytes) -> Ncom:
        set_stamp(self._message.header, received_ns)
        self._message.raw_packet.data[:] = memoryview(raw)
        return self._message


class TimeReferenceMaker:
    """sensor_msgs/TimeReference: when the host got it (header) against the INS's UTC."""

    def __init__(self, ins_frame: str):
        self._message = TimeReference(header=Header(frame_id=ins_frame), source="ncom")

    def make(self, received_ns: int, utc_ns: int) -> TimeReference:
        set_stamp(self._message.header, received_ns)
        self._message.time_ref.sec, self._message.time_ref.nanosec = divmod(utc_ns, 1_000_000_000)
        return self._message


def make_trigger(
    stamp_ns: int, map_frame: str, channel: int, count: int, position: Vector | None, motion: Motion | None
) -> Trigger:
    """position, motion: at the event; None where they are not known."""
    message = Trigger(header=Header(frame_id=map_frame), source=channel, count=count)
    set_stamp(message.header, stamp_ns)
    message.pose_valid = position is not None and motion is not None
    if position is not None and motion is not None:
        _set_vector(message.pose.position, position)
        _set_quaternion(message.pose.orientation, motion.attitude.quaternion())
        _set_vector(message.twist.linear, motion.body_velocity)
        _set_vector(message.twist.angular, motion.angular_velocity)
    return message


def make_origin(stamp_ns: int, map_frame: str, degrees: tuple[float, float, float]) -> NavSatFix:
    """Where the map frame starts: latitude, longitude [deg], altitude [m] of the kind the unit sends."""
    message = NavSatFix(header=Header(frame_id=map_frame))
    set_stamp(message.header, stamp_ns)
    message.latitude, message.longitude, message.altitude = degrees
    return message


def make_status(
    stamp_ns: int, ins_frame: str, navigation_status: int, status: StatusTracker, counters: Counters, time_jumps: int
) -> InsStatus:
    """Everything the status channels have said so far."""
    number, get = status.number, status.get
    message = InsStatus(header=Header(frame_id=ins_frame), navigation_status=navigation_status)
    set_stamp(message.header, stamp_ns)
    message.navigation_status_text = rule(navigation_status).text
    for name, field in (("position", "GpsPosMode"), ("velocity", "GpsVelMode"), ("orientation", "GpsAttMode")):
        mode = get(field)
        setattr(message, f"{name}_mode", -1 if mode is None else mode)
        setattr(message, f"{name}_mode_text", mode_text(mode))
    message.satellites = _integer(get("GpsNumObs"))
    accuracy = Accuracy.from_status(status)
    message.position_accuracy_north, message.position_accuracy_east = accuracy.north, accuracy.east
    message.position_accuracy_down = accuracy.up
    message.velocity_accuracy_north, message.velocity_accuracy_east = accuracy.velocity_north, accuracy.velocity_east
    message.velocity_accuracy_down = accuracy.velocity_up
    message.heading_accuracy = accuracy.heading
    message.pitch_accuracy, message.roll_accuracy = accuracy.pitch, accuracy.roll
    message.geoid_undulation = number("Undulation")
    message.utc_offset = number("TimeUtcOffset")
    message.output_latency = number("OutputLatency")
    message.differential_age = number("GpsDiffAge")
    message.antenna_lever_arm = [number("GAPx"), number("GAPy"), number("GAPz")]
    # Units numbered above 65535 use channel 40.
    message.serial_number = _integer(get("SerialNumber") if get("SerialNumber") is not None else get("SerialNumber24"))
    message.firmware = str(get("DevId") or "")
    message.seen_channels = sorted(status.seen)
    message.packets = counters.packets
    message.checksum_errors, message.skipped_bytes = counters.checksum_errors, counters.skipped_bytes
    message.late_packets, message.time_jumps = counters.late, time_jumps
    return message


def _integer(value: Value) -> int:
    return -1 if value is None else int(value)
