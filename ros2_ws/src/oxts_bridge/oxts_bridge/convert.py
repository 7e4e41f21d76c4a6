"""Converts the motion and status of the INS to ROS messages and publishes them; frames, signs and units as in REP-103.

Frequent messages are reused, because publishing copies them and constructing an Odometry takes longer than all other
work on a packet.
"""

from collections.abc import Callable
from math import degrees, isfinite
from types import SimpleNamespace
from typing import Any

from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus, TimeReference
from st_msgs.msg import InsStatus, Ncom, Trigger
from st_ros.polling import LATCHED, SAMPLE_QOS, OnDemandPublisher
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from .channels import Value
from .geometry import Quaternion, Vector, flu_from_frd
from .motion import Accuracy, Motion, compute_variances
from .ncom import STATUS_RULES, Counters, describe_mode, get_fix_status
from .status import StatusTracker
from .stream import ReceivedPacket

# Variance of an unknown quantity in messages that cannot express "unknown": large enough for filters to ignore it,
# but finite, because an infinite variance makes filters fail.
UNKNOWN_VARIANCE = 1e6
_UNKNOWN_BLOCK = (UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE, 0.0, 0.0, 0.0, UNKNOWN_VARIANCE)

MESSAGE_TYPES = {
    "ncom": Ncom, "odometry": Odometry, "imu": Imu, "nav_sat_fix": NavSatFix, "velocity": TwistWithCovarianceStamped,
    "time_reference": TimeReference, "status": InsStatus, "trigger": Trigger, "origin": NavSatFix}
"""Topic under ins/ -> type of its messages."""
DERIVED_TOPICS = ("imu", "nav_sat_fix", "velocity", "time_reference")


class Publishers:
    """Publishes all topics of the bridge; frequent messages are filled only while their topic has subscribers.

    Arguments of the methods: stamp_ns, utc_ns [ns since 1970].
    """

    def __init__(self, node: Node, settings: SimpleNamespace):
        self._node, self._settings = node, settings
        self._publishers: list[Publisher] = []
        self._outputs = {
            name: self._create(type_, f"ins/{name}", LATCHED if name in ("status", "origin") else SAMPLE_QOS,
                               name in settings.topics) for name, type_ in MESSAGE_TYPES.items()}
        self._tf = self._create(TFMessage, "/tf", 100, settings.publish_tf)
        self._tf_static = self._create(TFMessage, "/tf_static", LATCHED, settings.publish_tf)
        self._clock = self._create(Clock, "/clock", 10, settings.publish_clock)
        frame = settings.ins_frame
        self._odometry = Odometry(header=Header(frame_id=settings.map_frame), child_frame_id=frame)
        self._velocity = TwistWithCovarianceStamped(header=Header(frame_id=frame))
        for covariance in (self._odometry.twist.covariance, self._velocity.twist.covariance):
            covariance[21::7] = settings.angular_velocity_stddev**2 or UNKNOWN_VARIANCE
        self._imu = Imu(header=Header(frame_id=frame))
        self._imu.angular_velocity_covariance[::4] = settings.angular_velocity_stddev**2
        self._imu.linear_acceleration_covariance[::4] = settings.linear_acceleration_stddev**2
        self._fix = NavSatFix(header=Header(frame_id=frame), status=NavSatStatus(service=NavSatStatus.SERVICE_GPS))
        self._ncom = Ncom(header=Header(frame_id=frame))
        self._time_reference = TimeReference(header=Header(frame_id=frame), source="ncom")
        x, y, z = map(float, settings.base_to_ins)
        self._base_to_ins, self._ins_to_base = (x, y, z), (-x, -y, -z)
        self._transform = TransformStamped(
            header=Header(frame_id=settings.odom_frame), child_frame_id=settings.base_frame)
        self._transforms = TFMessage(transforms=[self._transform])

    def _create(self, type_: type, name: str, qos: QoSProfile | int, is_enabled: bool) -> OnDemandPublisher:
        if not is_enabled:
            return OnDemandPublisher(None)
        self._publishers.append(self._node.create_publisher(type_, name, qos))
        return OnDemandPublisher(self._publishers[-1])

    def pause_derived(self, is_paused: bool) -> None:
        """Set whether to omit the frequent messages that can be computed from raw packets or odometry."""
        for publisher in (self._tf, *(self._outputs[name] for name in DERIVED_TOPICS)):
            publisher.is_paused = is_paused

    def destroy(self) -> None:
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def publish_raw(self, received: ReceivedPacket) -> None:
        """Publish st_msgs/Ncom: the packet as received, stamped with the time of receipt."""
        if received.received_ns is not None and self._outputs["ncom"].has_subscribers():
            _set_time(self._ncom.header.stamp, received.received_ns)
            self._ncom.raw_packet.data[:] = memoryview(received.raw)
            self._outputs["ncom"].publish(self._ncom)

    def publish_time_reference(self, received: ReceivedPacket) -> None:
        """Publish sensor_msgs/TimeReference: host time of receipt (header) and UTC of the INS."""
        received_ns, utc_ns = received.received_ns, received.utc_ns
        if received_ns is not None and utc_ns is not None and self._outputs["time_reference"].has_subscribers():
            message = self._time_reference
            _set_time(message.header.stamp, received_ns)
            _set_time(message.time_ref, utc_ns)
            self._outputs["time_reference"].publish(message)

    def publish_motion(self, stamp_ns: int, motion: Motion, position: Vector | None, accuracy: Accuracy) -> None:
        """Publish odometry, the transform from odom to base_link, and velocity.

        Odometry: pose of the INS point in the map frame (ENU), twist in vehicle axes (FLU). position: ENU in the map
        frame [m]; None while the origin is unknown: only velocity is published.
        """
        attitude = motion.attitude
        if position is not None:
            if self._outputs["odometry"].has_subscribers():
                message = self._odometry
                _set_time(message.header.stamp, stamp_ns)
                _set_pose(message.pose.pose, position, motion)
                _set_twist(message.twist.twist, motion)
                message.pose.covariance[:15:7] = compute_variances(accuracy.position) or UNKNOWN_VARIANCE
                _set_block(message.pose.covariance, 21, attitude.rotate_orientation_covariance, accuracy.attitude)
                _set_block(message.twist.covariance, 0, attitude.rotate_covariance, accuracy.velocity)
                self._outputs["odometry"].publish(message)
            if self._tf.has_subscribers():
                x, y, z = attitude.to_enu(self._ins_to_base)
                _set_time(self._transform.header.stamp, stamp_ns)
                _set_vector(self._transform.transform.translation, (position[0] + x, position[1] + y, position[2] + z))
                _set_quaternion(self._transform.transform.rotation, attitude.to_quaternion())
                self._tf.publish(self._transforms)
        if self._outputs["velocity"].has_subscribers():
            _set_time(self._velocity.header.stamp, stamp_ns)
            _set_twist(self._velocity.twist.twist, motion)
            _set_block(self._velocity.twist.covariance, 0, attitude.rotate_covariance, accuracy.velocity)
            self._outputs["velocity"].publish(self._velocity)

    def publish_fix(self, stamp_ns: int, motion: Motion, accuracy: Accuracy, status: StatusTracker) -> None:
        """Publish sensor_msgs/NavSatFix; altitude above the ellipsoid, NaN while the geoid undulation is unknown."""
        if not self._outputs["nav_sat_fix"].has_subscribers():
            return
        # Height above the ellipsoid = altitude + undulation; the manual subtracts it, which recordings contradict.
        undulation = 0.0 if self._settings.altitude_is_ellipsoidal else status.get_number("Undulation")
        message, variances = self._fix, compute_variances(accuracy.position)
        _set_time(message.header.stamp, stamp_ns)
        message.latitude, message.longitude = degrees(motion.latitude), degrees(motion.longitude)
        message.altitude = motion.altitude + undulation
        message.status.status = get_fix_status(status.get("GpsPosMode"))
        message.position_covariance[::4] = variances or 0.0
        message.position_covariance_type = (
            NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN if variances else NavSatFix.COVARIANCE_TYPE_UNKNOWN)
        self._outputs["nav_sat_fix"].publish(message)

    def publish_imu(self, stamp_ns: int, received: ReceivedPacket, motion: Motion | None, accuracy: Accuracy) -> None:
        """Publish sensor_msgs/Imu, unless a rate or acceleration is invalid. motion: see `extract_motion`.

        The orientation covariance is 0 if unknown; its first element is -1 if there is no orientation (no `motion`).
        """
        packet, covariance = received.packet, self._imu.orientation_covariance
        is_valid = isfinite(sum(packet.acceleration) + sum(packet.angular_rate))
        if not is_valid or not self._outputs["imu"].has_subscribers():
            return
        _set_time(self._imu.header.stamp, stamp_ns)
        _set_vector(self._imu.angular_velocity, flu_from_frd(packet.angular_rate))
        _set_vector(self._imu.linear_acceleration, flu_from_frd(packet.acceleration))
        if motion is None:
            _set_quaternion(self._imu.orientation, (0.0, 0.0, 0.0, 1.0))
            covariance[:] = 0.0
            covariance[0] = -1.0
        else:
            _set_quaternion(self._imu.orientation, motion.attitude.to_quaternion())
            variances = compute_variances(accuracy.attitude)
            covariance[:] = motion.attitude.rotate_orientation_covariance(variances) if variances else 0.0
        self._outputs["imu"].publish(self._imu)

    def publish_trigger(self, stamp_ns: int, channel: int, count: int, position: Vector | None,
                        motion: Motion | None) -> None:
        """Publish st_msgs/Trigger for an event input or output; position, motion: at the event; None if unknown."""
        message = Trigger(header=Header(frame_id=self._settings.map_frame), source=channel, count=count)
        _set_time(message.header.stamp, stamp_ns)
        if position is not None and motion is not None:
            message.pose_valid = True
            _set_pose(message.pose, position, motion)
            _set_twist(message.twist, motion)
        self._outputs["trigger"].publish(message)

    def publish_status(self, stamp_ns: int, navigation_status: int, status: StatusTracker, counters: Counters,
                       time_jumps: int) -> None:
        """Publish st_msgs/InsStatus with the newest values of all status channels."""
        number, get, accuracy = status.get_number, status.get, Accuracy.from_status(status)
        (east, north, up), (velocity_east, velocity_north, velocity_up), (roll, pitch, heading) = accuracy
        message = InsStatus(
            header=Header(frame_id=self._settings.ins_frame),
            navigation_status=navigation_status,
            navigation_status_text=STATUS_RULES[navigation_status].text,
            satellites=_to_integer(get("GpsNumObs")),
            position_accuracy_north=north, position_accuracy_east=east, position_accuracy_down=up,
            velocity_accuracy_north=velocity_north, velocity_accuracy_east=velocity_east,
            velocity_accuracy_down=velocity_up,
            heading_accuracy=heading, pitch_accuracy=pitch, roll_accuracy=roll,
            geoid_undulation=number("Undulation"),
            utc_offset=number("TimeUtcOffset"),
            output_latency=number("OutputLatency"),
            differential_age=number("GpsDiffAge"),
            antenna_lever_arm=[number("GAPx"), number("GAPy"), number("GAPz")],
            # A serial number above 65535 is sent in channel 40 instead of 30.
            serial_number=_to_integer(get("SerialNumber24") if get("SerialNumber") is None else get("SerialNumber")),
            firmware=str(get("DevId") or ""),
            seen_channels=sorted(status.raw),
            packets=counters.packets, checksum_errors=counters.checksum_errors, skipped_bytes=counters.skipped_bytes,
            late_packets=counters.late, time_jumps=time_jumps)
        _set_time(message.header.stamp, stamp_ns)
        for name, field in (("position", "GpsPosMode"), ("velocity", "GpsVelMode"), ("orientation", "GpsAttMode")):
            setattr(message, f"{name}_mode", _to_integer(get(field)))
            setattr(message, f"{name}_mode_text", describe_mode(get(field)))
        self._outputs["status"].publish(message)

    def publish_origin(self, stamp_ns: int, geodetic: tuple[float, float, float]) -> None:
        """Publish the origin of the map. geodetic: latitude, longitude [deg], altitude as sent by the INS [m]."""
        message = NavSatFix(header=Header(frame_id=self._settings.map_frame))
        _set_time(message.header.stamp, stamp_ns)
        message.latitude, message.longitude, message.altitude = geodetic
        self._outputs["origin"].publish(message)

    def publish_clock(self, utc_ns: int) -> None:
        message = Clock()
        _set_time(message.clock, utc_ns)
        self._clock.publish(message)

    def publish_static_transforms(self, stamp_ns: int) -> None:
        """Publish map -> odom (identity, as the INS does not drift relative to the map) and base_link -> ins_link."""
        s = self._settings
        transforms = [TransformStamped(header=Header(frame_id=parent), child_frame_id=child)
                      for parent, child in ((s.map_frame, s.odom_frame), (s.base_frame, s.ins_frame))]
        for transform in transforms:
            _set_time(transform.header.stamp, stamp_ns)
        _set_vector(transforms[1].transform.translation, self._base_to_ins)
        self._tf_static.publish(TFMessage(transforms=transforms))


def _set_time(time: Any, nanoseconds: int) -> None:
    time.sec, time.nanosec = divmod(nanoseconds, 1_000_000_000)


def _set_quaternion(message: Any, quaternion: Quaternion) -> None:
    message.x, message.y, message.z, message.w = quaternion


def _set_vector(message: Any, vector: Vector) -> None:
    message.x, message.y, message.z = vector


def _set_block(covariance: Any, first: int, rotate: Callable[[Vector], tuple[float, ...]],
               standard_deviations: Vector) -> None:
    """Set a 3 x 3 block of a 6 x 6 covariance matrix; `first` is the index of the first element of the block.

    rotate: variances -> elements of the block, row by row. Unknown standard deviations: UNKNOWN_VARIANCE.
    """
    variances = compute_variances(standard_deviations)
    block = _UNKNOWN_BLOCK if variances is None else rotate(variances)
    for row in (0, 1, 2):
        covariance[first + 6 * row : first + 6 * row + 3] = block[3 * row : 3 * row + 3]


def _set_pose(pose: Any, position: Vector, motion: Motion) -> None:
    _set_vector(pose.position, position)
    _set_quaternion(pose.orientation, motion.attitude.to_quaternion())


def _set_twist(twist: Any, motion: Motion) -> None:
    _set_vector(twist.linear, motion.body_velocity)
    _set_vector(twist.angular, motion.angular_velocity)


def _to_integer(value: Value) -> int:
    """A status value as an integer; -1 if unknown."""
    return -1 if value is None else int(value)
