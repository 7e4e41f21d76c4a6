"""Serialises the columns of a raw run as ROS messages of the suite."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from oxts_bridge.file_decoder import Columns
from oxts_bridge.geometry import Attitude
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore
from st_core.vehicle import VehicleParameters

from .can_signals import CanSignals
from .cdr import CAN_FRAMES, NCOM, ODOMETRY, STEERING, WHEEL_FIELDS, WHEEL_SPEEDS, CdrLayout
from .frames import ERROR, EXTENDED, FD, FRAME_HEAD_LENGTH, REMOTE, Frames
from .ncom import ACCURACIES, NcomLog, decode_status_channel, select_latest_values

UNKNOWN_VARIANCE = 1e6
"""Variance [SI], as in oxts_bridge.convert: so large that filters ignore the value, but finite, so they do not fail."""
MAP_FRAME, INS_FRAME = "map", "ins_link"
CAN_PERIOD_NS = 20_000_000
"""Duration of the frames in one can/frames message [ns]; 0.1 s in the live bridge."""


class Covariances:
    """Covariances of odometry, from the accuracies in a file. Each accuracy is valid until the next one is sent."""

    def __init__(self, columns: Columns):
        self._accuracies = {}
        for channel, names in ACCURACIES.items():
            packets, values = decode_status_channel(columns, channel, names)
            self._accuracies[channel] = packets, np.radians(values) if channel == 5 else values

    def compute(self, ins: NcomLog, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(pose, twist) covariances, (n, 36) each, for rows of the log.

        The axes of the pose are east, north, up, and rotations about these fixed axes; the twist is in body axes.
        Variances of angular rates, and variances that the unit does not report, are UNKNOWN_VARIANCE.
        """
        packets = ins.rows[rows]
        attitude = ins.select_attitude(rows)
        pose, twist = np.zeros((len(packets), 6, 6)), np.zeros((len(packets), 6, 6))
        pose[:, :3, :3] = self._compute_block(3, packets, Attitude(0.0, 0.0, 0.0).rotate_covariance)
        pose[:, 3:, 3:] = self._compute_block(5, packets, attitude.rotate_orientation_covariance)
        twist[:, :3, :3] = self._compute_block(4, packets, attitude.rotate_covariance)
        twist[:, 3:, 3:] = np.eye(3) * UNKNOWN_VARIANCE
        return pose.reshape(-1, 36), twist.reshape(-1, 36)

    def _compute_block(self, channel: int, packets: np.ndarray, rotate: Callable[[Any], tuple]) -> np.ndarray:
        """Covariances (n, 3, 3) from the accuracies in a status channel. rotate: variances -> elements, row by row."""
        deviation = select_latest_values(*self._accuracies[channel], packets)
        is_known = np.isfinite(deviation).all(axis=1)[:, None, None]
        elements = np.broadcast_arrays(*rotate(np.nan_to_num(deviation).T ** 2))
        return np.where(is_known, np.stack(elements, axis=-1).reshape(-1, 3, 3), np.eye(3) * UNKNOWN_VARIANCE)


Message = tuple[int, str, bytes]
"""(log time [ns], topic, serialised message)."""


class Serialiser:
    """Serialises the messages of a run. store: message types of ROS and of the suite."""

    def __init__(self, store: Typestore):
        self._store = store
        self._layouts: dict[str, CdrLayout] = {}

    def _make_blank(self, type_name: str, **texts: str) -> Any:
        """A message of zeros. texts: name of a string field of the message or of its header -> text."""
        values: dict[str, Any] = {}
        fields: Any = self._store.fielddefs[type_name][1]
        for name, (node, detail) in fields:
            if node == Nodetype.NAME:
                values[name] = self._make_blank(detail, **texts)
            elif node == Nodetype.BASE:
                values[name] = texts.get(name, "") if detail[0] == "string" else np.zeros(1, detail[0])[0].item()
            else:
                (_, base), count = detail
                values[name] = np.zeros(count, base[0]) if node == Nodetype.ARRAY else []
        return self._store.types[type_name](**values)

    def _serialise(self, topic: str, type_name: str, columns: Mapping[str, np.ndarray], **texts: str) -> list[Message]:
        if type_name not in self._layouts:
            self._layouts[type_name] = CdrLayout(self._store, type_name, self._make_blank(type_name, **texts))
        times = columns["header.stamp"].tolist()
        rows = self._layouts[type_name].rows(len(times), columns)
        return [(time_ns, topic, row.tobytes()) for time_ns, row in zip(times, rows, strict=True)]

    def serialise_odometry(self, ins: NcomLog, rows: slice, covariances: Covariances) -> list[Message]:
        """Odometry of the INS point: pose in the map (ENU), twist in body axes (FLU)."""
        pose_covariance, twist_covariance = covariances.compute(ins, rows)
        columns = {"header.stamp": ins.time_ns[rows], "pose.covariance": pose_covariance,
                   "twist.covariance": twist_covariance}
        for k, axis in enumerate("xyz"):
            columns[f"pose.pose.position.{axis}"] = ins.position[k][rows]
            columns[f"twist.twist.linear.{axis}"] = ins.motion.body_velocity[k][rows]
            columns[f"twist.twist.angular.{axis}"] = ins.motion.angular_velocity[k][rows]
        quaternion = ins.select_attitude(rows).to_quaternion()
        columns |= {f"pose.pose.orientation.{axis}": values for axis, values in zip("xyzw", quaternion, strict=True)}
        return self._serialise("/ins/odometry", ODOMETRY, columns, frame_id=MAP_FRAME, child_frame_id=INS_FRAME)

    def serialise_ncom(self, raw: np.ndarray, time_ns: np.ndarray) -> list[Message]:
        """Raw packets, given as (n, 72) uint8."""
        return self._serialise("/ins/ncom", NCOM, {"header.stamp": time_ns, "raw_packet": raw}, frame_id=INS_FRAME)

    def serialise_steering(self, time_ns: np.ndarray, wheel: np.ndarray, valid: np.ndarray,
                           vehicle: VehicleParameters) -> list[Message]:
        """Steering angles. wheel: steering wheel angle [rad], left positive, without offset correction."""
        return self._serialise("/vehicle/steering", STEERING, {
            "header.stamp": time_ns, "steering_wheel_angle": wheel, "road_wheel_angle": vehicle.road_wheel_angle(wheel),
            "valid": valid})

    def serialise_wheel_speeds(self, message: str, signals: CanSignals, to_reference: Any) -> list[Message]:
        """Wheel speeds [m/s], one ROS message per frame of a CAN message; NaN for wheels that are not in the frame.

        to_reference: converts log times to the INS clock [ns].
        """
        wheels = {field: signals.signals[name, message] for name, field in WHEEL_FIELDS.items()
                  if (name, message) in signals.signals}
        log_ns = np.unique(np.concatenate([signal.time_ns for signal in wheels.values()]))
        columns = {field: np.full(len(log_ns), np.nan) for field in WHEEL_FIELDS.values()}
        valid = np.zeros(len(log_ns), bool)
        for field, signal in wheels.items():  # a multiplexed signal is not in every frame
            rows = np.searchsorted(log_ns, signal.time_ns)
            columns[field][rows], valid[rows] = signal.values, signal.valid
        return self._serialise("/vehicle/wheel_speeds", WHEEL_SPEEDS, {
            "header.stamp": to_reference(log_ns), "valid": valid, **columns})

    def serialise_can_frames(self, frames: Frames, time_ns: np.ndarray, bus_name: str) -> list[Message]:
        """Frames of one bus, one message per CAN_PERIOD_NS. time_ns: ascending times of the frames.

        Each frame consists of a head (stamp, id, four flags, length of the data) and its data, padded to 4 bytes.
        """
        n = len(frames)
        width = FRAME_HEAD_LENGTH + frames.payload.shape[1]
        rows = np.zeros((n, width), np.uint8)
        words = rows[:, :12].view("<i4")
        words[:, 0], words[:, 1] = np.divmod(time_ns, 1_000_000_000)
        words[:, 2] = (frames.id & ~np.uint32(EXTENDED)).view(np.int32)
        for byte, flag in ((13, ERROR), (14, REMOTE), (15, FD)):
            rows[:, byte] = (frames.flags & flag) != 0
        rows[:, 12] = (frames.id & np.uint32(EXTENDED)) != 0
        length = np.minimum(frames.length, frames.payload.shape[1]).astype(np.int64)
        rows[:, 16] = length
        rows[:, FRAME_HEAD_LENGTH:] = frames.payload
        rows[:, FRAME_HEAD_LENGTH:][np.arange(width - FRAME_HEAD_LENGTH) >= length[:, None]] = 0
        padded = FRAME_HEAD_LENGTH + (length + 3) // 4 * 4
        body = rows[np.arange(width) < padded[:, None]]
        starts = np.concatenate(([0], np.cumsum(padded)))
        cuts = np.nonzero(np.diff(time_ns // CAN_PERIOD_NS, prepend=-1))[0]
        ends = np.append(cuts[1:], n)
        head = bytearray(self._store.serialize_cdr(self._make_blank(CAN_FRAMES, frame_id=bus_name), CAN_FRAMES))
        messages = []
        for first, last, start_ns in zip(cuts.tolist(), ends.tolist(), time_ns[cuts].tolist(), strict=True):
            head[4:8] = (start_ns // 1_000_000_000).to_bytes(4, "little")
            head[8:12] = (start_ns % 1_000_000_000).to_bytes(4, "little")
            head[-4:] = (last - first).to_bytes(4, "little")
            # CDR does not pad the last frame of a message.
            padding = int(padded[last - 1] - FRAME_HEAD_LENGTH - length[last - 1])
            data = bytes(head) + body[starts[first] : starts[last] - padding].tobytes()
            messages.append((start_ns, "/can/frames", data))
        return messages
