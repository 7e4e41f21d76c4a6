"""Node canedge_bridge, which publishes the signals in live CAN frames of a car as ROS topics."""

import logging
import math
import struct
import time
from collections import deque
from collections.abc import Mapping
from types import SimpleNamespace

import can
import rclpy
from rclpy.node import Node
from st_core.errors import StCoreError
from st_core.vehicle import VehicleParameters
from st_msgs.msg import CanFrames, InsOnCan, Steering, WheelSpeeds
from st_ros import parameters, spin
from st_ros.diagnostics import Diagnostics
from st_ros.parameters import ConfigurationError, Parameter
from st_ros.polling import MAX_BACKLOG, SAMPLE_QOS, OnDemandPublisher, create_steady_timer, from_nanoseconds
from std_msgs.msg import Header

from .decode import DecodedFrame, Decoder, SteeringCalibration
from .health import Health
from .ins_time import replace_gps_time
from .receiver import BusState, Receiver
from .signals import CANONICAL_SIGNALS
from .transport import check_channel, make_id_filters, open_bus
from .yaml_reader import read_text

FRAMES_PERIOD = 0.1  # s; raw frames are not time-critical

_CDR_HEADER = b"\0\1\0\0"  # little-endian
_FRAME = struct.Struct("<iII4?I")  # stamp (8 bytes), identifier, flags, data length
_STAMP_SIZE = 8
# Signal -> field of st_msgs/WheelSpeeds or st_msgs/InsOnCan.
_WHEEL_SPEEDS = {name: name.removeprefix("wheel_speed_") for name in CANONICAL_SIGNALS if "speed" in name}
_INS = {name: name.removeprefix("ins_") for name in CANONICAL_SIGNALS if name.startswith("ins_")}

PARAMETERS = (
    Parameter("interface", "socketcan", "python-can interface: socketcan, udp_multicast (loopback only), ..."),
    Parameter("channel", "can0", "can0 for socketcan, group or group:port for udp_multicast"),
    Parameter("bitrate", 0, "for interfaces that python-can configures; 0: their default", "bit/s", 0, 8_000_000),
    Parameter("dbc_file", "", "DBC of the bus"),
    Parameter("signals_file", "", "table from DBC signals to canonical names, signs, units and checks"),
    Parameter("vehicle_file", "", "vehicle parameters, for steering_ratio and steering_wheel_offset"),
    Parameter("needed_messages", [], "messages required on the bus, instead of those marked in the table"),
    Parameter("checks", [], "overrides of the table: MESSAGE=off|warn|drop, MESSAGE.counter=..., MESSAGE.checksum=..."),
    Parameter("steering_sign", 1, "1: the decoded angle is positive to the left; -1: to the right", choices=(1, -1)),
    Parameter("steering_ratio", math.nan, "steering wheel angle divided by road wheel angle; NaN: from vehicle_file",
              "1", 1.0, 60.0),
    Parameter("steering_wheel_offset", math.nan, "decoded angle times steering_sign when driving straight; NaN: from "
              "vehicle_file", "rad", -math.pi, math.pi),
    Parameter("steering_latency", 0.0, "delay from steering wheel motion to the stamp of its frame", "s", 0.0, 1.0),
    Parameter("silence_after", 1.0, "time without a frame after which an open bus counts as silent", "s", 0.05, 60.0),
    Parameter("publish_frames", False, "publish every raw frame on can/frames"),
)


class CanedgeBridge(Node):
    """Decodes and publishes each frame in the receive thread, without waiting for the executor."""

    def __init__(self) -> None:
        super().__init__("canedge_bridge")
        self._settings = settings = parameters.declare(self, PARAMETERS)
        self._decoder = _make_decoder(settings)
        self._calibration = self._make_calibration()
        self._latency_ns = round(settings.steering_latency * 1e9)
        self._steering = self.create_publisher(Steering, "vehicle/steering", SAMPLE_QOS)
        self._wheel_speeds = OnDemandPublisher(self.create_publisher(WheelSpeeds, "vehicle/wheel_speeds", SAMPLE_QOS))
        self._ins_on_can = OnDemandPublisher(self.create_publisher(InsOnCan, "vehicle/ins_on_can", SAMPLE_QOS))
        self._frames: deque[bytes] = deque()  # serialised, not published yet
        if settings.publish_frames:
            self._can_frames = self.create_publisher(CanFrames, "can/frames", SAMPLE_QOS)
            create_steady_timer(self, FRAMES_PERIOD, self._publish_frames)
        self._has_kernel_stamps = settings.interface in ("socketcan", "udp_multicast")  # on the host's clock
        self._receiver = Receiver(
            self._open, self._on_frame, on_state=self._on_state, on_error=self._on_error,
            silence=settings.silence_after,
            network_interface=settings.channel if settings.interface == "socketcan" else "")
        self._bus_name = bus_name = f"{settings.interface}:{settings.channel}"
        self._health = Health(bus_name, self._decoder, self._receiver.status, time.time_ns)
        self._diagnostics = Diagnostics(self, bus_name, self._health.checks)
        # The receive thread reports a change through this condition, because only the executor may publish diagnostics.
        self._bus_changed = self.create_guard_condition(self._diagnostics.publish)
        self._log_start()
        self._receiver.start()

    def close(self) -> None:
        self._receiver.stop()
        if self._settings.publish_frames:
            self._publish_frames()

    def _make_calibration(self) -> SteeringCalibration | None:
        if self._decoder.table.find_steering() is None:
            return None
        settings = self._settings
        ratio, offset = settings.steering_ratio, settings.steering_wheel_offset
        if file := settings.vehicle_file:
            try:
                vehicle = VehicleParameters.from_yaml(read_text(file), file)
            except StCoreError as error:
                raise ConfigurationError(f"canedge_bridge.vehicle_file: {error}") from None
            ratio = ratio if math.isfinite(ratio) else vehicle.steering_ratio
            offset = offset if math.isfinite(offset) else vehicle.steering_wheel_offset
        for name, value in (("steering_ratio", ratio), ("steering_wheel_offset", offset)):
            if not math.isfinite(value):
                raise ConfigurationError(f"canedge_bridge.{name}: not set; set it or vehicle_file")
        return SteeringCalibration(settings.steering_sign, offset, ratio)

    def _open(self) -> can.BusABC:
        settings = self._settings
        # can/frames must contain every frame; otherwise only the messages of the table are needed.
        filters = None if settings.publish_frames else make_id_filters(self._decoder.keys)
        return open_bus(settings.interface, settings.channel, filters, settings.bitrate)

    def _on_frame(self, frame: can.Message, time_ns: int) -> None:
        if self._settings.publish_frames:
            self._frames.append(serialise_frame(frame, time_ns))
        is_late = self._has_kernel_stamps and (time.time_ns() - time_ns) * 1e-9 > MAX_BACKLOG
        decoded = self._decoder.decode(frame, time_ns, needed_only=is_late)
        if decoded is not None:
            self._publish(decoded)

    def _publish(self, decoded: DecodedFrame) -> None:
        sensor = decoded.values.get("steering_wheel_angle")
        if sensor is not None and self._calibration is not None:
            steering_wheel_angle, road_wheel_angle = self._calibration.convert(sensor)
            self._steering.publish(Steering(
                header=_make_header(decoded.time_ns - self._latency_ns), valid=decoded.valid,
                steering_wheel_angle=steering_wheel_angle, road_wheel_angle=road_wheel_angle))
        if self._wheel_speeds.has_subscribers() and (fields := _select_fields(decoded.values, _WHEEL_SPEEDS)):
            self._wheel_speeds.publish(WheelSpeeds(header=_make_header(decoded.time_ns), valid=decoded.valid, **fields))
        if self._ins_on_can.has_subscribers() and (fields := _select_fields(replace_gps_time(decoded.values), _INS)):
            self._ins_on_can.publish(InsOnCan(header=_make_header(decoded.time_ns), **fields))

    def _publish_frames(self) -> None:
        # The length is read only once, because the receive thread keeps appending frames.
        if frames := [self._frames.popleft() for _ in range(len(self._frames))]:
            self._can_frames.publish(serialise_frames(frames, self._bus_name))

    def _on_state(self, state: BusState, reason: str) -> None:
        if rclpy.ok():
            self._bus_changed.trigger()

    def _on_error(self, error: Exception) -> None:
        # At shutdown, the context is destroyed before the thread ends, and publishing fails as expected.
        if rclpy.ok():
            self.get_logger().error(f"error while receiving CAN frames: {error!r}", throttle_duration_sec=5.0)

    def _log_start(self) -> None:
        logger, table = self.get_logger(), self._decoder.table
        needed = ", ".join(m.name for m in table.messages.values() if m.is_needed) or "nothing"
        absent = f"; not in the DBC: {', '.join(table.absent_messages)}" if table.absent_messages else ""
        logger.info(f"bus {self._bus_name}, {table.dbc_file} with {table.signals_file}: "
                    f"decodes {len(table.messages)} messages, requires {needed}{absent}")
        if self._calibration is not None:
            logger.info(self._calibration.formula())


def _make_decoder(settings: SimpleNamespace) -> Decoder:
    for name in ("dbc_file", "signals_file"):
        if not getattr(settings, name):
            raise ConfigurationError(f"canedge_bridge.{name}: not set; give a file from config/can/")
    try:
        check_channel(settings.interface, settings.channel)
        checks = {}
        for text in settings.checks:
            key, equals, mode = text.partition("=")
            if not equals:
                raise ValueError(f"checks: {text!r} is not MESSAGE=off|warn|drop, MESSAGE.counter=... or "
                                 "MESSAGE.checksum=...")
            checks[key.strip()] = mode.strip()
        return Decoder(settings.dbc_file, settings.signals_file, settings.needed_messages, checks)
    except ValueError as error:
        raise ConfigurationError(f"canedge_bridge: {error}") from None


def serialise_frame(frame: can.Message, time_ns: int) -> bytes:
    """st_msgs/CanFrame as CDR, padded to a multiple of four bytes; ten times as fast as serialising a message."""
    data, (seconds, nanoseconds) = bytes(frame.data), divmod(time_ns, 1_000_000_000)
    return _FRAME.pack(seconds, nanoseconds, frame.arbitration_id, frame.is_extended_id, frame.is_error_frame,
                       frame.is_remote_frame, frame.is_fd, len(data)) + data + bytes(-len(data) % 4)


def serialise_frames(frames: list[bytes], bus: str) -> bytes:
    """st_msgs/CanFrames as CDR, with the first frame's stamp. frames: one or more from `serialise_frame`, in order."""
    name = bus.encode() + b"\0"
    head = frames[0][:_STAMP_SIZE] + struct.pack("<I", len(name)) + name + bytes(-len(name) % 4)
    return b"".join((_CDR_HEADER, head, struct.pack("<I", len(frames)), *frames))


def _make_header(time_ns: int) -> Header:
    return Header(stamp=from_nanoseconds(time_ns))


def _select_fields(values: Mapping[str, float], names: dict[str, str]) -> dict[str, float]:
    """Value of each field in `names` (signal -> field): NaN if the frame lacks the signal; empty if it lacks all."""
    if not any(name in values for name in names):
        return {}
    return {field: values.get(name, math.nan) for name, field in names.items()}


def main() -> int:
    # python-can logs every failed attempt to open a bus; the node reports failures in its diagnostics instead.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    return spin.run(CanedgeBridge)
