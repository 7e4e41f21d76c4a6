"""Lifecycle node oxts_bridge, which publishes NCOM packets from UDP or a file as ROS topics."""

import ipaddress
import math
import sys
import time
from pathlib import Path
from types import SimpleNamespace

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from st_ros import parameters, spin
from st_ros.diagnostics import Diagnostics
from st_ros.parameters import ConfigurationError, Parameter
from st_ros.polling import MAX_BACKLOG

from .convert import MESSAGE_TYPES, Publishers
from .geometry import LocalFrame, Vector
from .health import Health
from .motion import FIRST_FIX, GIVEN, UNIT, Accuracy, Motion, Origin, extract_motion
from .ncom import DUPLICATE, NEW, SAME, NcomError, Packet, to_unix_nanoseconds
from .sources import ReplaySource, Source, UdpSource, continues_stream
from .status import StatusTracker
from .stream import NcomParser, ReceivedPacket, StreamStatistics

NCOM, RECEIVE = "ncom", "receive"

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start; false: wait for a lifecycle manager"),
    Parameter("bind_address", "127.0.0.1", "local address to listen on; 0.0.0.0: all interfaces of this host"),
    Parameter("udp_port", 3000, "UDP port the unit sends to", "", 1, 65535),
    Parameter("sender_filter", "", "IP address of the unit; empty: the first address that sends NCOM"),
    Parameter("replay_file", "", "NCOM file to replay instead of listening"),
    Parameter("speed_factor", 1.0, "replay: playback speed; 1: real time", "1", 0.01, 1000.0),
    Parameter("loop", False, "replay: start again at the end"),
    Parameter("start_offset", 0.0, "replay: start this long after the first time in the file", "s", 0.0, 1e9),
    Parameter("publish_clock", False, "publish /clock with the UTC of the packets, for a replay"),
    Parameter("topics", list(MESSAGE_TYPES), "topics under ins/ to publish"),
    Parameter("publish_tf", True, "publish map -> odom -> base_link -> ins_link"),
    Parameter("map_frame", "map", "frame of odometry: east, north, up from the origin"),
    Parameter("odom_frame", "odom", "REP-105 frame between map and base; identical to map here"),
    Parameter("base_frame", "base_link", "frame of the vehicle: forward, left, up"),
    Parameter("ins_frame", "ins_link", "frame of the INS point, parallel to base_frame"),
    Parameter("base_to_ins", [0.0, 0.0, 0.0], "position of the INS point in base_frame: forward, left, up, in m"),
    Parameter("origin_source", FIRST_FIX, "origin of the map frame", choices=(FIRST_FIX, GIVEN, UNIT)),
    Parameter("origin_latitude", math.nan, "latitude of the origin, for origin_source given", "deg", -90.0, 90.0),
    Parameter("origin_longitude", math.nan, "longitude of the origin, for origin_source given", "deg", -180.0, 180.0),
    Parameter("origin_altitude", math.nan, "altitude of the origin, for origin_source given; above geoid or ellipsoid "
              "as sent by the unit", "m", -1e4, 1e5),
    Parameter("altitude_is_ellipsoidal", False, "whether the unit is configured to send ellipsoidal altitude"),
    Parameter("stamp_source", NCOM, "stamps of motion, IMU and position: UTC of the unit, or host receive time",
              choices=(NCOM, RECEIVE)),
    Parameter("status_period", 1.0, "longest time between messages on ins/status; also sent at every change of mode",
              "s", 0.05, 60.0),
    Parameter("silence_after", 1.0, "time without a packet after which an error is reported", "s", 0.05, 60.0),
    Parameter("angular_velocity_stddev", 0.0, "for covariances, as the unit sends none; 0: unknown", "rad/s", 0.0,
              10.0),
    Parameter("linear_acceleration_stddev", 0.0, "for covariances, as the unit sends none; 0: unknown", "m/s^2", 0.0,
              100.0),
)

_CLOCK_PERIOD = 0.01  # s
_ACCURACY_CHANNELS = frozenset((3, 4, 5))
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class OxtsBridge(LifecycleNode):
    """Creates its publishers when configured; when active, the thread of the source decodes packets and publishes."""

    def __init__(self) -> None:
        super().__init__("oxts_bridge")
        self._settings = parameters.declare(self, PARAMETERS)
        check_settings(self._settings, self.get_name())
        self._live = not self._settings.replay_file
        self._source: Source | None = None
        self._outputs: Publishers | None = None
        self._problem = ""
        self._reset()
        self._diagnostics = Diagnostics(self, "oxts", lambda: self._health.checks())  # noqa: PLW0108 - _reset() replaces it
        # The source's thread reports a change through this condition, since only the executor may publish diagnostics.
        self._source_changed = self.create_guard_condition(self._diagnostics.publish)
        if self._settings.autostart:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != _SUCCESS:
                    problem = f".{self._problem}" if self._problem else ": cannot be activated"
                    raise ConfigurationError(f"{self.get_name()}{problem}")

    def _reset(self) -> None:
        s = self._settings
        given = (s.origin_latitude, s.origin_longitude, s.origin_altitude) if s.origin_source == GIVEN else None
        self._parser, self._status = NcomParser(), StatusTracker()
        self._origin, self._statistics = Origin(s.origin_source, given), StreamStatistics()
        self._accuracy = Accuracy.from_status(self._status)
        self._health = Health(
            self._parser, self._status, self._origin, self._statistics,
            lambda: None if self._source is None else self._source.status,
            self._live, s.altitude_is_ellipsoidal, s.silence_after)
        self._published_frame: LocalFrame | None = None
        self._newest_packet: Packet | None = None
        self._reported_state: tuple | None = None
        self._reported_at = self._clock_at = float("-inf")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._reset()
        try:
            self._source = self._make_source()
        except (NcomError, OSError) as error:
            self._problem = f"replay_file: {error}"
            self.get_logger().error(self._problem)
            return _FAILURE
        self._outputs = Publishers(self, self._settings)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if self._source is None:
            self._source = self._make_source()
        assert self._outputs is not None, "created by on_configure()"
        self._outputs.publish_static_transforms(time.time_ns())
        self._source.start()
        self.get_logger().info(f"reading {self._source.status.name}")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.close()
        if self._outputs is not None:
            self._outputs.destroy()
            self._outputs = None
        return super().on_cleanup(state)

    on_shutdown = on_cleanup

    def _make_source(self) -> Source:
        s = self._settings
        if self._live:
            return UdpSource(s.bind_address, s.udp_port, s.sender_filter, self._on_data, self._source_changed.trigger,
                             lambda data: continues_stream(self._newest_packet, data))
        self._restart_stream()  # the file may have been replayed before a deactivation
        return ReplaySource(Path(s.replay_file), self._on_data, self._restart_stream, s.speed_factor, s.loop,
                            s.start_offset)

    def _restart_stream(self) -> None:
        self._parser.restart()
        self._status.restart()

    def close(self) -> None:
        """Stop the thread of the source, which must not publish after the node is destroyed."""
        if self._source is not None:
            self._source.stop()
            self._source = None

    # Packets; the following methods run in the thread of the source.

    def _on_data(self, data: bytes, received_ns: int, publish: bool) -> int:
        # A replay sets its own pace, so its receive times do not indicate gaps in the recording.
        packets = self._parser.feed(data, received_ns if self._live else None)
        for received in packets:
            received.received_ns = received_ns
            try:
                if self._outputs is not None:
                    self._process(received, received_ns, self._outputs, publish)
            except Exception as error:  # no packet may end the thread
                self._health.failures += 1
                self.get_logger().error(f"packet at byte {received.offset} failed: {error!r}",
                                        throttle_duration_sec=10.0)
        return len(packets)

    def _process(self, received: ReceivedPacket, received_ns: int, publishers: Publishers, publish: bool) -> None:
        now = time.monotonic()
        self._health.last_packet_at = now
        backlog = (time.time_ns() - received_ns) * 1e-9
        self._health.backlog = max(self._health.backlog, backlog)
        publishers.pause_derived(backlog > MAX_BACKLOG)
        if publish and received.order != DUPLICATE:
            publishers.publish_raw(received)
        if received.order not in (NEW, SAME):
            return
        if received.rule.is_defined and received.rule.kind != "trigger":
            self._health.navigation_status = received.packet.navigation_status
        if self._status.update_from(received) and received.packet.channel in _ACCURACY_CHANNELS:
            self._accuracy = Accuracy.from_status(self._status)
        if not publish:
            return
        is_new_regular = received.kind == "regular" and received.order == NEW
        motion = extract_motion(received)
        self._health.incomplete_packets += is_new_regular and motion is None and received.rule.navigation == "valid"
        position: Vector | None = None
        if motion is not None:
            frame = self._origin.update(motion, self._status, received_ns)
            if frame is not self._published_frame and self._origin.geodetic is not None:
                self._published_frame = frame
                publishers.publish_origin(received_ns, self._origin.geodetic)
            position = None if frame is None else motion.locate(frame)
        if received.event_ns is not None:
            # An event that is only repeated in a regular packet has no pose.
            pose = (position, motion) if received.kind == "trigger" else (None, None)
            utc_ns = to_unix_nanoseconds(received.event_ns, self._parser.utc_offset)
            publishers.publish_trigger(utc_ns, received.packet.channel, received.packet.batch_s[7], *pose)
        if is_new_regular:
            self._newest_packet = received.packet
            self._statistics.add(received)
            self._publish_motion(publishers, received, motion, position, now)
        self._publish_status(publishers, received.utc_ns if received.utc_ns is not None else received_ns, now)

    def _publish_motion(self, publishers: Publishers, received: ReceivedPacket, motion: Motion | None,
                        position: Vector | None, now: float) -> None:
        stamp = received.utc_ns if self._settings.stamp_source == NCOM else received.received_ns
        publishers.publish_time_reference(received)
        if stamp is None:
            return
        if motion is not None:
            publishers.publish_motion(stamp, motion, position, self._accuracy)
            publishers.publish_fix(stamp, motion, self._accuracy, self._status)
        publishers.publish_imu(stamp, received, motion, self._accuracy)
        if received.utc_ns is not None and now - self._clock_at >= _CLOCK_PERIOD:
            self._clock_at = now
            publishers.publish_clock(received.utc_ns)

    def _publish_status(self, publishers: Publishers, stamp: int, now: float) -> None:
        get = self._status.get
        state = (self._health.navigation_status, get("GpsPosMode"), get("GpsVelMode"), get("GpsAttMode"))
        if state == self._reported_state and now - self._reported_at < self._settings.status_period:
            return
        self._reported_state, self._reported_at = state, now
        publishers.publish_status(stamp, self._health.navigation_status or 0, self._status, self._parser.counters,
                                  self._parser.clock.jumps)


def check_settings(settings: SimpleNamespace, node_name: str) -> None:
    """Raises ConfigurationError for a parameter value that is invalid although it is within its declared range."""

    def reject(key: str, reason: str) -> None:
        raise ConfigurationError(f"{node_name}.{key}: {reason}")

    for topic in settings.topics:
        if topic not in MESSAGE_TYPES:
            reject("topics", f"{topic!r} is not one of {', '.join(MESSAGE_TYPES)}")
    for key in ("bind_address", "sender_filter") if settings.sender_filter else ("bind_address",):
        try:
            ipaddress.ip_address(getattr(settings, key))
        except ValueError:
            reject(key, f"{getattr(settings, key)!r} is not an IP address")
    arm = settings.base_to_ins
    if len(arm) != 3 or not all(isinstance(v, int | float) and math.isfinite(v) and abs(v) <= 100 for v in arm):
        reject("base_to_ins", f"{list(arm)} is not three lengths within +/- 100 m")
    if settings.origin_source == GIVEN:
        for key in ("origin_latitude", "origin_longitude", "origin_altitude"):
            if math.isnan(getattr(settings, key)):
                reject(key, "is required when origin_source is 'given'")
    frames = [settings.map_frame, settings.odom_frame, settings.base_frame, settings.ins_frame]
    if settings.publish_tf and len(set(frames)) != len(frames):
        reject("map_frame", f"the four frames {', '.join(frames)} must differ while publish_tf is true")
    if settings.replay_file and not Path(settings.replay_file).is_file():
        reject("replay_file", f"{settings.replay_file} is not a file")


def main() -> None:
    sys.exit(spin.run(OxtsBridge))
