"""Fuzz targets for configuration files: DBC, signal table, vehicle, model, run.yaml, settings of the virtual car."""

from collections.abc import Callable
from pathlib import Path

import can
from canedge_bridge.decode import Decoder
from drives import weave, write_drive
from st_core.errors import ConfigurationError, StCoreError
from st_core.model_file import ModelFile
from st_core.vehicle import VehicleParameters
from st_recordings.runs import RunError, RunSource, find_runs, read
from st_sim import scenarios
from st_sim.settings import read_vehicle, resolve_settings
from support import ROOT

from .harness import Target, one_line

CAN = ROOT / "config" / "can"
VEHICLES = ROOT / "config" / "vehicle"
ROADS = ROOT / "config" / "manoeuvres"
# Nine references to nine references to nine ...: a few hundred bytes that expand to billions.
NINES = [b"&a%d [%s]" % (k, b", ".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 10)]
BOMB = b"[&a0 [x, x], " + b", ".join(NINES) + b"]"
YAML_FRAGMENTS = (b"\0", b"\xff\xfe", b"\xc3\x28", b"\t", b"\r", b"[" * 50, b"{a: " * 50, BOMB, *br"""
&a|*a|<<: *a|!!int abc|!!timestamp 2001-99-99|!!python/object/apply:os.system [id]|!!binary a|!!set {a}|!!float ''
? [a, b] : c|~|.nan|.inf|0x|1e400|>-|---|...|{}|[]|2001-01-01|2001-99-99|1:60:60|on|off|: |- |#|'|"|\|"\e[2J": |"a\nb":
""".replace(b"\n", b"|").split(b"|"), b"%YAML 9.9\n---")
DBC_FRAGMENTS = (b"\0", b"\xb0", b"|", *br"""
BO_ 2 Leaf_Steering: 5 SAS~SG_ A : 0\64@1+ (1,0) [0\1] "" V~ m0 ~ M ~ m0M ~NS_ :~VERSION ""~VAL_ 2 A 1 "x" ;~CM_ "
BO_ 3 A: 8 V~BA_DEF_ BO_ "x" INT 0 1;~BA_ "x" BO_ 2 1;~VAL_TABLE_ t 1 "x" ;~SG_MUL_VAL_ 2 A B 0-1;~SIG_GROUP_ 2 g 1 : A;
BO_TX_BU_ 2 : V;~EV_ e: 0 [0\1] "" 0 0 DUMMY_NODE_VECTOR0 V;~BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 X
SIG_VALTYPE_ 2 A : 1;~SIG_VALTYPE_ 2 SteeringWheelAngle : 2;~SG_ SteeringWheelAngle : 0\16@1- (-0.1,0) [0\0] "deg" L
(0,0)~(nan,0)~@0-~@1-~(1e999,0)~"~;
""".replace(b"\n", b"~").replace(b"\\", b"|").split(b"~"))


def _bytes(*paths: Path) -> list[bytes]:
    return [path.read_bytes() for path in paths]


def _decode_frames(decoder: Decoder) -> str:
    """An accepted table must decode any frame."""
    for number, extended in decoder.keys:
        for data in (bytes([byte] * size) for size in (0, 5, 8) for byte in (0x00, 0x7F, 0x80, 0xFF)):
            decoder.decode(can.Message(arbitration_id=number, is_extended_id=extended, data=data), 10**18)
    return f"accepted: {len(decoder.keys)} messages"


def _dbc(data: bytes, folder: Path) -> str:
    file = folder / "car.dbc"
    file.write_bytes(data)
    try:
        decoder = Decoder(file, CAN / "leaf_ze0.yaml")
    except ConfigurationError as error:
        return one_line(error, data)
    return _decode_frames(decoder)


def _signal_table(data: bytes, folder: Path) -> str:
    file = folder / "car.yaml"
    file.write_bytes(data)
    try:
        decoder = Decoder(CAN / "leaf_ze0.dbc", file)
    except ConfigurationError as error:
        return one_line(error, data)
    return _decode_frames(decoder)


def _vehicle(data: bytes, folder: Path) -> str:
    try:
        vehicle = VehicleParameters.from_yaml(data.decode(errors="replace"), "car.yaml")
    except StCoreError as error:
        return one_line(error, data)
    assert VehicleParameters.from_yaml(vehicle.to_yaml()).hash == vehicle.hash
    return "accepted"


def _model(data: bytes, folder: Path) -> str:
    try:
        model = ModelFile.from_yaml(data.decode(errors="replace"), "model.yaml")
    except StCoreError as error:
        return one_line(error, data)
    assert ModelFile.from_yaml(model.to_yaml()).hash == model.hash
    return "accepted"


def _run_file(data: bytes, folder: Path) -> str:
    (folder / "drive.ncom").write_bytes(b"x")
    (folder / "drive.log").write_bytes(b"x")
    write_drive(folder / "drive.csv", weave(1.0))
    file = folder / "run.yaml"
    file.write_bytes(data)
    outcomes = [one_line(run.problem, data) if run.problem else _read(run, data) for run in find_runs([file])]
    assert outcomes
    return "; ".join(outcomes)


def _read(run: RunSource, data: bytes) -> str:
    if run.kind != "csv":
        return "accepted"
    try:
        return f"read, {len(read(run).warnings)} warnings"
    except RunError as error:
        return one_line(error, data)


def _simulated(read: Callable[[Path], object]) -> Callable[[bytes, Path], str]:
    """Files of the virtual car; an accepted road must be drivable."""

    def run(data: bytes, folder: Path) -> str:
        file = folder / "input.yaml"
        file.write_bytes(data)
        try:
            read(file)
        except ConfigurationError as error:
            return one_line(error, data)
        return "accepted"

    return run


def _road(file: Path) -> None:
    plan = scenarios.load_plan(str(file))
    for step in range(200):
        plan.make_demand(step * 0.1, step * 0.5, 5.0)


MODEL = b"""base: nonlinear
vehicle: {name: "Nissan Leaf ZE0", hash: "0123"}
effects:
  steering_lag:
    time_constant: {value: 0.08, unit: "s", interval: [0.07, 0.09], source: "found"}
  friction:
    scale: {value: 0.9, unit: "1", interval: null, source: "found"}
provenance: {date: "2026-11-21", version: "0.1.0", data: {"run.ncom": "0123"}, note: "a note"}
"""
PLANT = b"preset: realistic\nwind_speed: 12\nbank_angle: 0.02\n"
RUN = b"""name: morning
ins: drive.ncom
can: [drive.log, "*.log"]
offset: 0.25
labels:
  - {name: circle, start: 1.0, end: 20.5}
"""
RUN_OF_COLUMNS = b"""csv: drive.csv
columns: {yaw: yaw, road_wheel_angle: delta}
units: {yaw: deg, t: s, velocity_x: km/h}
correct:
  yaw_rate: {scale: 0.01745, add: -0.004, earlier: 0.31}
  position: {earlier: -0.02, ahead: -1.5}
  steering: {scale: -1}
  heading: {add: 0.01}
leave_out: [[0.1, 0.3]]
"""

TARGETS = (
    Target("dbc", lambda: _bytes(CAN / "leaf_ze0.dbc"), _dbc, DBC_FRAGMENTS, text=True),
    Target("signal_table", lambda: _bytes(CAN / "leaf_ze0.yaml"), _signal_table, YAML_FRAGMENTS, text=True),
    Target("vehicle", lambda: _bytes(*sorted(VEHICLES.glob("*.yaml"))), _vehicle, YAML_FRAGMENTS, text=True),
    Target("model", lambda: [MODEL], _model, YAML_FRAGMENTS, text=True),
    Target("run_file", lambda: [RUN, RUN_OF_COLUMNS, b"bag: drive.log\n",
                               b"each: drive.csv\ncolumns: {yaw: yaw}\n"], _run_file, YAML_FRAGMENTS, text=True),
    Target("sim_vehicle", lambda: _bytes(VEHICLES / "leaf.yaml"), _simulated(read_vehicle), YAML_FRAGMENTS, text=True),
    Target("sim_plant", lambda: [PLANT], _simulated(lambda file: resolve_settings(str(file))), YAML_FRAGMENTS,
           text=True),
    Target("sim_road", lambda: _bytes(*sorted(ROADS.glob("*.yaml"))), _simulated(_road), YAML_FRAGMENTS, text=True),
)
