"""Columns of a raw run as serialised messages of the suite: blocks of (topic, times, bytes) ready to be written."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from oxts_bridge.file_decoder import Columns
from rosbags.typesys.store import Typestore
from st_core.vehicle import VehicleParameters

from .can_signals import CanSignals
from .cdr import CAN_FRAMES, NCOM, ODOMETRY, STEERING, WHEEL_FIELDS, WHEEL_SPEEDS, Layout
from .frames import ERROR, EXTENDED, FD, REMOTE, Frames
from .ncom import ACCURACIES, NcomLog, held, sent

# As in oxts_bridge.convert: large enough that filters ignore it, finite so that none breaks.
UNKNOWN_VARIANCE = 1e6


class Covariances:
    """Accuracies of one file; each is valid from the packet that carries it until the next."""

    def __init__(self, columns: Columns):
        self._held = {}
        for channel, names in ACCURACIES.items():
            index, values = sent(columns, channel, names)
            self._held[channel] = index, np.radians(values) if channel == 5 else values

    def of(self, ins: NcomLog, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(pose, twist) covariances, (n, 36) each, of the odometry of some fixes.

        Pose: east, north, up, then rotations about the fixed axes. Twist: body axes. Variances that the unit does
        not report, and those of angular rates, are UNKNOWN_VARIANCE.
        """
        packets = ins.rows[rows]
        yaw, pitch, roll = (a[rows] for a in (ins.yaw, ins.pitch, ins.roll))
        pose, twist = np.zeros((len(packets), 6, 6)), np.zeros((len(packets), 6, 6))
        position, known = self._at(3, packets)
        pose[:, :3, :3] = np.where(known[:, None], position**2, UNKNOWN_VARIANCE)[:, :, None] * np.eye(3)
        angles, known = self._at(5, packets)
        turn = _rotation(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
        pose[:, 3:, 3:] = _turned(angles, known, np.swapaxes(turn, 1, 2))
        velocity, known = self._at(4, packets)
        twist[:, :3, :3] = _turned(velocity, known, _rotation(yaw, pitch, roll))
        twist[:, 3:, 3:] = np.eye(3) * UNKNOWN_VARIANCE
        return pose.reshape(-1, 36), twist.reshape(-1, 36)

    def _at(self, channel: int, packets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) standard deviations at packets, and where all three are known."""
        found = held(*self._held[channel], packets)
        known = np.isfinite(found).all(axis=1)
        return np.where(known[:, None], found, 0.0), known


def _turned(deviation: np.ndarray, known: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """R^T diag(variance) R, (n, 3, 3)."""
    turned = np.einsum("nij,ni,nik->njk", rotation, deviation**2, rotation)
    return np.where(known[:, None, None], turned, np.eye(3) * UNKNOWN_VARIANCE)


def _rotation(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(n, 3, 3) body axes to map axes, Rz(yaw) Ry(pitch) Rx(roll)."""
    (sy, cy), (sp, cp), (sr, cr) = ((np.sin(a), np.cos(a)) for a in (yaw, pitch, roll))
    return np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
                     sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
                     -sp, cp * sr, cp * cr], axis=1).reshape(-1, 3, 3)


MAP_FRAME, INS_FRAME = "map", "ins_link"
CAN_PERIOD_NS = 20_000_000  # of one can/frames message, as the live bridge sends them


@dataclass(frozen=True)
class Messages:
    """Messages of one topic in order of time: message k is data[edges[k]:edges[k + 1]]. time_ns: when to play it."""

    topic: str
    type_name: str
    time_ns: np.ndarray
    data: memoryview
    edges: np.ndarray

    def __len__(self) -> int:
        return len(self.time_ns)


def _fixed(topic: str, type_name: str, time_ns: np.ndarray, rows: np.ndarray) -> Messages:
    edges = np.arange(len(rows) + 1, dtype=np.int64) * rows.shape[1]
    return Messages(topic, type_name, time_ns, memoryview(rows.reshape(-1).data), edges)


class Serialiser:
    """Makes messages of a run. store: types of ROS and of the suite."""

    def __init__(self, store: Typestore):
        self._store = store
        self._layouts: dict[str, Layout] = {}

    def _message(self, type_name: str, **values: Any) -> Any:
        return self._store.types[type_name](**values)

    def _header(self, frame: str) -> Any:
        time = self._message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return self._message("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def _layout(self, type_name: str, example: Any) -> Layout:
        if type_name not in self._layouts:
            self._layouts[type_name] = Layout(self._store, type_name, example)
        return self._layouts[type_name]

    def odometry(self, ins: NcomLog, rows: slice, covariances: Covariances) -> Messages:
        """Pose of the INS point in the map (ENU), twist in body axes (FLU) at it."""
        zero = {k: 0.0 for k in "xyz"}
        pose = self._message("geometry_msgs/msg/Pose", position=self._message("geometry_msgs/msg/Point", **zero),
                             orientation=self._message("geometry_msgs/msg/Quaternion", **zero, w=1.0))
        twist = self._message("geometry_msgs/msg/Twist", linear=self._message("geometry_msgs/msg/Vector3", **zero),
                              angular=self._message("geometry_msgs/msg/Vector3", **zero))
        layout = self._layout(ODOMETRY, self._message(
            ODOMETRY, header=self._header(MAP_FRAME), child_frame_id=INS_FRAME,
            pose=self._message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self._message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))))
        time_ns = ins.time_ns[rows]
        pose_covariance, twist_covariance = covariances.of(ins, rows)
        columns = {"header.stamp": time_ns, "pose.covariance": pose_covariance, "twist.covariance": twist_covariance}
        for k, axis in enumerate("xyz"):
            columns[f"pose.pose.position.{axis}"] = ins.position[k, rows]
            columns[f"twist.twist.linear.{axis}"] = ins.velocity[k, rows]
            columns[f"twist.twist.angular.{axis}"] = ins.rate[k, rows]
        for axis, values in zip("xyzw", quaternion(ins.yaw[rows], ins.pitch[rows], ins.roll[rows]), strict=True):
            columns[f"pose.pose.orientation.{axis}"] = values
        return _fixed("/ins/odometry", ODOMETRY, time_ns, layout.rows(len(time_ns), columns))

    def ncom(self, raw: np.ndarray, time_ns: np.ndarray) -> Messages:
        """The packets as they were. raw: (n, 72) uint8."""
        layout = self._layout(NCOM, self._message(NCOM, header=self._header(INS_FRAME),
                                                  raw_packet=np.zeros(72, np.uint8)))
        rows = layout.rows(len(raw), {"header.stamp": time_ns, "raw_packet": raw})
        return _fixed("/ins/ncom", NCOM, time_ns, rows)

    def steering(self, time_ns: np.ndarray, wheel: np.ndarray, valid: np.ndarray,
                 vehicle: VehicleParameters) -> Messages:
        """wheel: steering wheel angle, sign applied [rad]."""
        layout = self._layout(STEERING, self._message(STEERING, header=self._header(""), steering_wheel_angle=0.0,
                                                      road_wheel_angle=0.0, valid=True))
        road = vehicle.road_wheel_angle(wheel)
        columns = {"header.stamp": time_ns, "steering_wheel_angle": wheel, "road_wheel_angle": road, "valid": valid}
        return _fixed("/vehicle/steering", STEERING, time_ns, layout.rows(len(time_ns), columns))

    def wheel_speeds(self, message: str, signals: CanSignals, to_reference: Any) -> Messages:
        """One per frame of a CAN message, NaN for what that frame does not hold."""
        nan = dict.fromkeys(WHEEL_FIELDS.values(), float("nan"))
        layout = self._layout(WHEEL_SPEEDS, self._message(WHEEL_SPEEDS, header=self._header(""), valid=True, **nan))
        found = {field: signals.signals[name, message] for name, field in WHEEL_FIELDS.items()
                 if (name, message) in signals.signals}
        first = next(iter(found.values()))
        time_ns = to_reference(first.time_ns)
        columns: Mapping[str, np.ndarray] = {"header.stamp": time_ns, "valid": first.valid,
                                             **{field: s.values for field, s in found.items()}}
        return _fixed("/vehicle/wheel_speeds", WHEEL_SPEEDS, time_ns, layout.rows(len(time_ns), columns))

    def can_frames(self, frames: Frames, time_ns: np.ndarray, bus_name: str) -> Messages:
        """Frames of one bus, in messages of 20 ms. time_ns: of each frame, rising.

        Each frame is 20 bytes and its data, padded to 4: stamp, id, four flags, length of the data, the data.
        """
        n = len(frames)
        width = 20 + frames.payload.shape[1]
        rows = np.zeros((n, width), np.uint8)
        words = rows[:, :12].view("<i4")
        words[:, 0], words[:, 1] = np.divmod(time_ns, 1_000_000_000)
        words[:, 2] = (frames.id & ~np.uint32(EXTENDED)).view(np.int32)
        for at, flag in ((13, ERROR), (14, REMOTE), (15, FD)):
            rows[:, at] = (frames.flags & flag) != 0
        rows[:, 12] = (frames.id & np.uint32(EXTENDED)) != 0
        length = np.minimum(frames.length, frames.payload.shape[1]).astype(np.int64)
        rows[:, 16] = length
        rows[:, 20:] = frames.payload
        rows[:, 20:][np.arange(width - 20) >= length[:, None]] = 0
        padded = 20 + (length + 3) // 4 * 4
        body = rows[np.arange(width) < padded[:, None]]
        starts = np.concatenate(([0], np.cumsum(padded)))
        cuts = np.nonzero(np.diff(time_ns // CAN_PERIOD_NS, prepend=-1))[0]
        ends = np.append(cuts[1:], n)
        example = self._message(CAN_FRAMES, header=self._header(bus_name), frames=[])
        head = bytearray(self._store.serialize_cdr(example, CAN_FRAMES))  # with header and number of frames
        data = bytearray()
        edges = [0]
        for first, last, at in zip(cuts.tolist(), ends.tolist(), time_ns[cuts].tolist(), strict=True):
            head[4:8] = (at // 1_000_000_000).to_bytes(4, "little")
            head[8:12] = (at % 1_000_000_000).to_bytes(4, "little")
            head[-4:] = (last - first).to_bytes(4, "little")
            data += head
            # The last frame of a message ends with its data, as a serialiser leaves it.
            spare = int(padded[last - 1] - 20 - length[last - 1])
            data += body[starts[first] : starts[last] - spare].tobytes()
            edges.append(len(data))
        return Messages("/can/frames", CAN_FRAMES, time_ns[cuts], memoryview(bytes(data)), np.array(edges, np.int64))


def quaternion(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> tuple[np.ndarray, ...]:
    """x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll), w >= 0."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a / 2), np.sin(a / 2)) for a in (yaw, pitch, roll))
    w = cy * cp * cr + sy * sp * sr
    sign = np.where(w < 0, -1.0, 1.0)
    x, y, z = cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr
    return sign * x, sign * y, sign * z, sign * w


def in_time_order(parts: list[Messages]) -> Iterator[tuple[int, str, memoryview]]:
    """(time in ns, topic, bytes) of all parts, merged."""
    if not parts:
        return
    time_ns = np.concatenate([p.time_ns for p in parts])
    which = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    place = np.concatenate([np.arange(len(p)) for p in parts])
    order = np.argsort(time_ns, kind="stable")
    edges = [p.edges.tolist() for p in parts]
    for time, part, k in zip(time_ns[order].tolist(), which[order].tolist(), place[order].tolist(), strict=True):
        yield time, parts[part].topic, parts[part].data[edges[part][k] : edges[part][k + 1]]
