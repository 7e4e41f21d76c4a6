"""Odometry and steering reconstructed from the raw packets and frames of a recording, as the bridges publish them."""

import math
import tempfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from canedge_bridge.decode import SteeringCalibration
from oxts_bridge.motion import FIRST_FIX, GIVEN, Origin, reconstruct_odometry
from rosbags.typesys.store import Typestore
from st_core.checks import Series
from st_core.errors import StCoreError
from st_core.vehicle import VehicleParameters

from .bag_storage import Storage, Topic
from .errors import RunError
from .extras import SPEEDS, car_speed, series
from .messages import CAN_FRAMES, NCOM
from .recorded_texts import parameters, text_of

ORIGIN = "ins/origin"
RECONSTRUCTED = " (reconstructed)"  # behind the name of the topic that it was computed from


class Reconstruction:
    """Of one recording. records: its metadata records: parameters of the nodes, DBC, table and vehicle."""

    def __init__(self, path: Path, storage: Storage, records: Mapping[str, Mapping[str, str]], store: Typestore):
        self._path, self._storage, self._store = path, storage, store
        self._records, self._nodes = records, parameters(records)
        self._topics = storage.topics()

    def has(self, type_name: str) -> bool:
        """Whether there are raw packets (NCOM) or frames (CAN_FRAMES)."""
        return any(t.type_name == type_name and t.count for t in self._topics)

    def topic(self, type_name: str) -> Topic:
        """Of those that are there."""
        return next(t for t in self._topics if t.type_name == type_name and t.count)

    @property
    def bus_is_described(self) -> bool:
        """Whether the recording carries the DBC and table of its frames."""
        return self.has(CAN_FRAMES) and None not in self._descriptions()

    def map_frame(self) -> str:
        return str(self._nodes.get("oxts_bridge", {}).get("map_frame", "map"))

    def odometry(self, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
        """The fields of nav_msgs/Odometry, as oxts_bridge had published them. Raises RunError, without a fix too."""
        bridge = self._nodes.get("oxts_bridge", {})
        columns = self._storage.columns({self.topic(NCOM): ("header.stamp", "raw_packet")}, self._store)
        found = columns.get(self.topic(NCOM).name)
        if found is None:
            raise RunError(self._path, "its raw packets are not alike", "repair the bag with `st recover`")
        packets = zip(found["header.stamp"].tolist(), map(bytes, found["raw_packet"]), strict=True)
        rows = [(one.stamp_ns, *one.position, *one.orientation, *one.velocity[:2], one.rate[2])
                for one in reconstruct_odometry(packets, self._origin(bridge), not bridge.get("replay_file"),
                                          bridge.get("stamp_source") == "receive")]
        if not rows:
            raise RunError(self._path, "none of its raw packets has a fix and a time", "record with the unit locked")
        stamps, *values = zip(*rows, strict=True)
        names = [field for field in fields if not field.endswith("stamp")]
        # Altitude is not among the requested fields.
        chosen = [values[k] for k in (0, 1, *range(3, len(values)))]
        return {"header.stamp": np.array(stamps, np.int64),
                **{name: np.array(column) for name, column in zip(names, chosen, strict=True)}}

    def _origin(self, bridge: Mapping[str, Any]) -> Origin:
        origin = next((t for t in self._topics if t.name.endswith(ORIGIN) and t.count), None)
        if origin is not None:
            fix: Any = self._store.deserialize_cdr(next(self._storage.messages(origin.name)), origin.type_name)
            return Origin(GIVEN, (fix.latitude, fix.longitude, fix.altitude))
        source = bridge.get("origin_source", FIRST_FIX)
        latitude, longitude, altitude = (float(bridge.get(f"origin_{name}", math.nan))
                                         for name in ("latitude", "longitude", "altitude"))
        return Origin(source, (latitude, longitude, altitude) if source == GIVEN else None)

    def steering(self) -> dict[str, np.ndarray]:
        """The fields of st_msgs/Steering, as canedge_bridge had published them. Raises RunError."""
        from .can_signals import steering_of

        bridge = self._nodes.get("canedge_bridge", {})
        signal = steering_of(self._signals, self._path, self._table)
        ratio, offset = (self._steering(bridge, name) for name in ("steering_ratio", "steering_wheel_offset"))
        calibration = SteeringCalibration(bridge.get("steering_sign", 1), offset, ratio)
        latency_ns = round(float(bridge.get("steering_latency", 0.0)) * 1e9)
        return {"header.stamp": signal.time_ns - latency_ns,
                "steering_wheel_angle": calibration.steering_wheel_angle(signal.values),
                "road_wheel_angle": calibration.road_wheel_angle(signal.values), "valid": signal.valid}

    def _steering(self, bridge: Mapping[str, Any], name: str) -> float:
        value = float(bridge.get(name, math.nan))
        if math.isfinite(value):
            return value
        text = text_of(self._records, str(bridge.get("vehicle_file", "")))
        try:
            return getattr(VehicleParameters.from_yaml(text or "", "the vehicle in the recording"), name)
        except StCoreError as error:
            raise RunError(self._path, f"the steering of its raw frames needs a vehicle file: {error}") from None

    def speeds(self) -> tuple[Series | None, Series | None]:
        """(speed of the car by its wheels, forward speed that the INS sends on CAN)."""
        found = {name: signal for name in SPEEDS if (signal := self._signals.first_of(name)) is not None}
        wheels = {name: (signal.time_ns[signal.valid], signal.values[signal.valid]) for name, signal in found.items()}
        ins = self._signals.all_of("ins_velocity_x")
        if not ins:
            return car_speed(wheels), None
        order = np.argsort(np.concatenate([signal.rows for signal in ins]), kind="stable")
        time_ns, values = (np.concatenate([getattr(signal, name) for signal in ins])[order]
                           for name in ("time_ns", "values"))
        return car_speed(wheels), series(time_ns, values)

    def _descriptions(self) -> tuple[str | None, ...]:
        bridge = self._nodes.get("canedge_bridge", {})
        return tuple(text_of(self._records, str(bridge.get(name, ""))) for name in ("dbc_file", "signals_file"))

    @cached_property
    def _table(self) -> Any:
        from .can_signals import load_signal_table

        if not self.bus_is_described:
            raise RunError(self._path, "it holds raw CAN frames, but not the DBC and table to decode them with",
                           "record vehicle/steering too")
        with tempfile.TemporaryDirectory() as folder:
            files = Path(folder, "can.dbc"), Path(folder, "signals.yaml")
            for file, text in zip(files, self._descriptions(), strict=True):
                file.write_text(text or "", encoding="utf-8")
            return load_signal_table(*files)

    @cached_property
    def _signals(self) -> Any:
        from .can_signals import decode_signals  # the CAN libraries: a second that other bags need not wait for
        from .recorded_frames import read_frames

        table = self._table
        try:
            frames = read_frames(self._storage.messages(self.topic(CAN_FRAMES).name))
        except ValueError as error:
            raise RunError(self._path, f"its raw CAN frames are damaged: {error}",
                           "repair the bag with `st recover`") from None
        return decode_signals(frames, table)
