"""Writes files of the virtual car: CAN logs (run.log, run.mf4) and the true motion (truth.mcap)."""

import itertools
import json
from collections.abc import Mapping
from copy import copy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import can
import numpy as np
from can.io.canutils import CanutilsLogWriter
from mcap.writer import Writer
from st_core.errors import ConfigurationError

from .encoders import INS_BUS, VEHICLE_BUS
from .plant import Truth
from .settings import Settings

CHUNK_SIZE = 64 * 1024  # bytes, about 1 s of true states; at most this much is lost if the process is killed

_HISTORY = "<FHcomment><TX>created</TX><tool_id>virtual_leaf</tool_id><tool_vendor>st_sim</tool_vendor></FHcomment>"

_UNITS = {
    "x": "m", "y": "m", "z": "m", "yaw": "rad", "velocity_x": "m/s", "velocity_y": "m/s", "velocity_z": "m/s",
    "yaw_rate": "rad/s", "acceleration_x": "m/s^2", "acceleration_y": "m/s^2", "yaw_acceleration": "rad/s^2",
    "roll": "rad, positive right side down", "pitch": "rad, positive nose up",
    "steering_wheel_angle": "rad", "road_wheel_angle": "rad", "gear": "1 P, 2 R, 3 N, 4 D",
    "wheel_speed": "m/s: FL, FR, RL, RR", "lateral_force_front": "N", "lateral_force_rear": "N",
    "longitudinal_force_front": "N", "longitudinal_force_rear": "N", "load_front": "N", "load_rear": "N",
    "slip_angle_front": "rad, mean of both wheels, positive if they slide to the left",
    "slip_angle_rear": "rad, mean of both wheels, positive if they slide to the left", "friction": "1",
    "bank_angle": "rad", "grade_angle": "rad", "wind_x": "m/s", "wind_y": "m/s",
}
TRUTH_SCHEMA = {
    "type": "object", "title": "Truth",
    "description": "State at the true CG (map axes ENU, body axes FLU) and forces on a simulated car.",
    "properties": {
        "time": {"type": "number", "description": "s since the start of the drive"},
        **{name: {"type": "array" if ":" in unit else "number", "description": unit} for name, unit in _UNITS.items()}}}


def choose_truth_file(folder: Path) -> Path:
    """The first of truth.mcap, truth_2.mcap, truth_3.mcap, ... that does not exist in a folder yet."""
    names = itertools.chain(["truth.mcap"], (f"truth_{number}.mcap" for number in itertools.count(2)))
    return next(folder / name for name in names if not (folder / name).is_file())


class TruthFile:
    """MCAP file with the true states, as JSON messages on /truth (log time: UTC of the state). metadata: content of
    the record `run`. fault: why the file is incomplete; empty if it is complete."""

    def __init__(self, path: Path, start_ns: int, settings: Settings, metadata: Mapping[str, object]):
        self._start_ns, self._name = start_ns, path.name
        self.fault = ""
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_SIZE)
        self._writer.start(profile="", library="st_sim")
        schema = self._writer.register_schema("st_sim/Truth", "jsonschema", json.dumps(TRUTH_SCHEMA).encode())
        self._channel = self._writer.register_channel("/truth", "json", schema)
        self._writer.add_metadata("settings", {name: repr(value) for name, value in settings.items()})
        self._writer.add_metadata("run", {name: str(value) for name, value in metadata.items()})

    def write(self, truth: Truth) -> None:
        """Add a record. A write error, for example on a full disk, ends the file but not the drive."""
        if self.fault:
            return
        record = {name: getattr(truth, name) for name in ("time", *_UNITS) if name in Truth.__dataclass_fields__}
        for axle, wheels in (("front", slice(0, 2)), ("rear", slice(2, 4))) if truth.load else ():
            for name in ("lateral_force", "longitudinal_force", "load"):
                record[f"{name}_{axle}"] = sum(getattr(truth, name)[wheels])
            record[f"slip_angle_{axle}"] = sum(truth.slip_angle[wheels]) / 2
        time_ns = self._start_ns + round(truth.time * 1e9)
        data = json.dumps({**record, **truth.conditions}).encode()
        try:
            self._writer.add_message(self._channel, time_ns, data, time_ns)
        except OSError as error:
            self.fault = f"{self._name}: {error.strerror}"

    def close(self) -> None:
        try:
            self._writer.finish()
            self._stream.close()
        except OSError as error:
            self.fault = f"{self._name}: {error.strerror}"


class LogFile(CanutilsLogWriter):
    """CAN log in the text format of candump; can0 is the car, can1 the INS."""

    def write(self, time_ns: int, frame: can.Message) -> None:
        logged_frame, bus = copy(frame), cast(int, frame.channel)  # a background frame is sent repeatedly
        logged_frame.timestamp, logged_frame.channel = time_ns / 1e9, bus - 1
        self.on_message_received(logged_frame)


class Mf4File:
    """MDF 4.11 file in the finalised format of a CANedge: one bus-logging group per channel, times on a grid of 50 us.
    CAN1 is the car, CAN2 the INS. stop() writes the file; until then, the frames are kept in memory."""

    GRID_NS = 50_000

    def __init__(self, path: Path, start_ns: int):
        self._path, self._start_ns = path, start_ns
        self._frames: dict[int, list[tuple[int, int, bytes]]] = {VEHICLE_BUS: [], INS_BUS: []}

    def write(self, time_ns: int, frame: can.Message) -> None:
        self._frames[cast(int, frame.channel)].append(
            (time_ns - self._start_ns, frame.arbitration_id, bytes(frame.data)))

    def stop(self) -> None:
        from asammdf import MDF
        from asammdf.blocks.v4_blocks import FileHistory

        log = MDF(version="4.11")
        log.header.start_time = datetime.fromtimestamp(self._start_ns / 1e9, UTC)
        for bus, frames in self._frames.items():
            if frames:
                log.append([self._make_signal(bus, frames)], comment="virtual Leaf", common_timebase=True)
                group: Any = log.groups[-1].channel_group
                # asammdf names all these groups CAN, but a CANedge numbers its channels.
                group.acq_name = f"CAN{bus}"
                group.flags |= 0x6  # bus event, plain bus event: required by readers of bus logs
        # asammdf's own history would contain the current time, but equal seeds must give equal bytes.
        history = FileHistory()
        history.comment, history.abs_time = _HISTORY, self._start_ns
        log.file_history.append(history)
        log.save(self._path, overwrite=True, add_history_block=False)
        log.close()

    def _make_signal(self, bus: int, frames: list[tuple[int, int, bytes]]) -> object:
        from asammdf import Signal
        from asammdf.blocks import v4_constants as v4
        from asammdf.blocks.source_utils import Source

        dtypes = {"BusChannel": "u1", "ID": "<u4", "IDE": "u1", "DLC": "u1", "DataLength": "u1", "DataBytes": "(8,)u1",
                  "Dir": "u1", "EDL": "u1", "BRS": "u1", "ESI": "u1"}
        rows = np.zeros(len(frames), [(f"CAN_DataFrame.{name}", dtype) for name, dtype in dtypes.items()])
        time_ns = np.array([time for time, _, _ in frames], dtype=np.int64)
        times = np.round(time_ns / self.GRID_NS) * (self.GRID_NS / 1e9)
        rows["CAN_DataFrame.BusChannel"] = bus
        rows["CAN_DataFrame.ID"] = [identifier for _, identifier, _ in frames]
        rows["CAN_DataFrame.DLC"] = rows["CAN_DataFrame.DataLength"] = [len(data) for _, _, data in frames]
        rows["CAN_DataFrame.DataBytes"] = np.frombuffer(b"".join(d.ljust(8, b"\0") for _, _, d in frames),
                                                        np.uint8).reshape(-1, 8)
        source = Source(name=f"CAN{bus}", path=f"CAN{bus}", comment="", source_type=v4.SOURCE_BUS,
                        bus_type=v4.BUS_TYPE_CAN)
        return Signal(samples=rows, timestamps=times, name="CAN_DataFrame", source=source)


def make_folder(option: str, folder: Path) -> Path:
    """Create the folder given with an option. Raises ConfigurationError naming the option."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{option} {folder}: cannot be created: {error.strerror}") from None
    return folder
