"""The publishers of the bridge: each fills its message only while somebody listens."""

from math import isfinite, nan
from types import SimpleNamespace

from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix, TimeReference
from st_msgs.msg import InsStatus, Ncom, Trigger
from st_ros.polling import OnDemandPublisher
from tf2_msgs.msg import TFMessage

from .. import convert
from ..attitude import Vector
from ..geodesy import ellipsoidal_height
from ..motion import Accuracy, Motion
from ..status import StatusTracker
from ..stream import Received

# Four seconds at 250 Hz: what a reader that was held up (a busy machine, a laptop that slept) can still be sent again.
QOS = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
TF_QOS = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
TYPES = {
    "ncom": Ncom,
    "odometry": Odometry,
    "imu": Imu,
    "nav_sat_fix": NavSatFix,
    "velocity": TwistWithCovarianceStamped,
    "time_reference": TimeReference,
    "trigger": Trigger,
}


class Outputs:
    """All topics. Times in ns since 1970."""

    def __init__(self, node: Node, settings: SimpleNamespace):
        self._node, self._settings = node, settings
        self._publishers: list[Publisher] = []
        ins, lever = settings.ins_frame, tuple(settings.base_to_ins)
        self._out = {name: self._output(name, type_) for name, type_ in TYPES.items()}
        self._status = self._create(InsStatus, "ins/status", LATCHED) if "status" in settings.topics else None
        self._origin = self._create(NavSatFix, "ins/origin", LATCHED) if "origin" in settings.topics else None
        self._tf = OnDemandPublisher(self._create(TFMessage, "/tf", TF_QOS) if settings.publish_tf else None)
        self._tf_static = self._create(TFMessage, "/tf_static", LATCHED) if settings.publish_tf else None
        self._clock = self._create(Clock, "/clock", 10) if settings.publish_clock else None
        rate, acceleration = settings.angular_velocity_stddev, settings.linear_acceleration_stddev
        self._ncom = convert.NcomMaker(ins)
        self._odometry = convert.OdometryMaker(settings.map_frame, ins, rate)
        self._velocity = convert.VelocityMaker(ins, rate)
        self._imu = convert.ImuMaker(ins, rate, acceleration)
        self._nav_sat_fix = convert.NavSatFixMaker(ins)
        self._time_reference = convert.TimeReferenceMaker(ins)
        self._transform = convert.TransformMaker(settings.odom_frame, settings.base_frame, lever)

    def _create(self, type_: type, name: str, qos: QoSProfile | int) -> Publisher:
        publisher = self._node.create_publisher(type_, name, qos)
        self._publishers.append(publisher)
        return publisher

    def _output(self, name: str, type_: type) -> OnDemandPublisher:
        return OnDemandPublisher(self._create(type_, f"ins/{name}", QOS) if name in self._settings.topics else None)

    def destroy(self) -> None:
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def raw(self, received: Received, now: float) -> None:
        if received.received_ns is not None and self._out["ncom"].has_subscribers(now):
            self._out["ncom"].publish(self._ncom.make(received.received_ns, received.raw))

    def time_reference(self, received: Received, now: float) -> None:
        received_ns, utc_ns = received.received_ns, received.utc_ns
        if received_ns is not None and utc_ns is not None and self._out["time_reference"].has_subscribers(now):
            self._out["time_reference"].publish(self._time_reference.make(received_ns, utc_ns))

    def motion(self, stamp_ns: int, motion: Motion, position: Vector | None, accuracy: Accuracy, now: float) -> None:
        """Odometry, transform and velocity; position: in the map frame, None until there is one."""
        out = self._out
        if position is not None:
            if out["odometry"].has_subscribers(now):
                out["odometry"].publish(self._odometry.make(stamp_ns, position, motion, accuracy))
            if self._tf.has_subscribers(now):
                self._tf.publish(self._transform.make(stamp_ns, position, motion))
        if out["velocity"].has_subscribers(now):
            out["velocity"].publish(self._velocity.make(stamp_ns, motion, accuracy))

    def fix(self, stamp_ns: int, motion: Motion, accuracy: Accuracy, status: StatusTracker, now: float) -> None:
        if not self._out["nav_sat_fix"].has_subscribers(now):
            return
        undulation = status.get("Undulation")
        if self._settings.altitude_is_ellipsoidal:
            height = motion.altitude
        else:
            height = nan if undulation is None else ellipsoidal_height(motion.altitude, undulation)
        mode = status.get("GpsPosMode")
        self._out["nav_sat_fix"].publish(self._nav_sat_fix.make(stamp_ns, motion, height, mode, accuracy))

    def imu(self, stamp_ns: int, received: Received, motion: Motion | None, accuracy: Accuracy, now: float) -> None:
        packet = received.packet
        if self._out["imu"].has_subscribers(now) and isfinite(sum(packet.acceleration) + sum(packet.angular_rate)):
            self._out["imu"].publish(self._imu.make(stamp_ns, packet, motion, accuracy))

    def trigger(self, message: Trigger) -> None:
        if "trigger" in self._settings.topics:
            self._out["trigger"].publish(message)

    def status(self, message: InsStatus) -> None:
        if self._status is not None:
            self._status.publish(message)

    def origin(self, stamp_ns: int, degrees: tuple[float, float, float]) -> None:
        """Latitude, longitude [deg], altitude [m] that the map frame starts at."""
        if self._origin is not None:
            self._origin.publish(convert.make_origin(stamp_ns, self._settings.map_frame, degrees))

    def clock(self, utc_ns: int) -> None:
        if self._clock is not None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(utc_ns, 1_000_000_000)
            self._clock.publish(message)

    def static_transforms(self, stamp_ns: int) -> None:
        if self._tf_static is not None:
            s = self._settings
            x, y, z = map(float, s.base_to_ins)
            self._tf_static.publish(
                convert.static_transforms(
                    stamp_ns, s.map_frame, s.odom_frame, s.base_frame, s.ins_frame, (x, y, z)
                )
            )
