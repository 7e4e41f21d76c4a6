"""Writes the folder of a new car with placeholders to fill in, and finds problems in the folder of a car."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canedge_bridge.signals import find_unit as find_dbc_unit
from canedge_bridge.signals import load_table
from st_core.errors import ConfigurationError, StCoreError
from st_core.handling import find_implausible_values
from st_core.integrate import required_slip_speed
from st_core.prediction import PredictionSettings
from st_core.vehicle import (
    DEFAULT_UNCERTAINTIES,
    OPTIONAL_QUANTITIES,
    TYRE_QUANTITIES,
    TYRES,
    VEHICLE_QUANTITIES,
    VehicleParameters,
)

from .car import Car, load_car, read_vehicle
from .paths import config
from .runs.columns import find_unit
from .runs.errors import RunError
from .runs.ins_log import SPEEDS
from .runs.run_file import read_yaml_mapping

FILL_IN = "FILL_IN"
"""Placeholder for values that only the owner of the car can give; commands reject files that contain it."""
MEASUREMENT_HINTS = {
    "mass": "four wheel scales, with driver and equipment",
    "yaw_inertia": "value of a comparable car at first; identify it later",
    "wheelbase": "tape measure, or the registration papers",
    "cg_to_front_axle": "wheelbase * mass on the rear axle / total mass",
    "cg_to_ins_x": "tape measure, from the CG to the unit's measurement point; behind the CG is negative",
    "steering_ratio": "turntables, mean of both front wheels",
    "drive_front": "1: front-wheel drive, 0: rear-wheel drive, between: fraction of the drive torque on the front axle",
    "cornering_stiffness_front": "value of a comparable car at first; identify it later",
    "cornering_stiffness_rear": "value of a comparable car at first; identify it later",
}
"""Quantity that must be given for each car -> how to obtain it."""
ASSUMED_UNCERTAINTIES = {"cg_height": 0.1}
"""Quantity -> standard deviation [SI] if the value of the Leaf is used; CG heights of cars are 0.45 to 0.65 m."""
STABILITY_SPEEDS = tuple(0.5 * k for k in range(1, 81))
"""Speeds [m/s] at which the numerical integration of the models must be stable."""
ZERO_QUANTITIES = ("cg_to_ins_y", "steering_wheel_offset")  # quantities that the template sets to 0
# Quantities that st discover never fits.
FIXED_QUANTITIES = ("wheelbase", "minimum_slip_speed", "length", "width", *OPTIONAL_QUANTITIES)
_VEHICLE_ROW = re.compile(r'^(?P<indent> *)(?P<key>\w+): \{value: (?P<value>\S+), unit: (?P<unit>.+?), source: ".*"\}$')

SIGNALS_TEMPLATE = """\
messages:
  FILL_IN_message:                      # name of the message in can.dbc that carries the steering wheel angle
    needed: true
    period: {value: 0.01, unit: s}
    timeout: {value: 0.2, unit: s}
    # counter: {signal: NAME, check: warn}                # if the message has them
    # checksum: {signal: NAME, rule: sum8_id, check: drop}
    signals:
      # unit: as in the DBC, or the actual unit if the DBC gives none. Leave sign at 1: the sign of the sensor is
      # steering_sign in car.yaml. sign_signal: NAME of a separate signal of the sign, if any (1: negative).
      FILL_IN_signal: {name: steering_wheel_angle, unit: deg, sign: 1, range: [-900, 900], max_rate: 2000}

  # The speed of the car or of its wheels (vehicle_speed, wheel_speed_rear_left, ...), if it is on the bus: it aligns
  # the clocks of INS and CAN log if the bus has no INS frames, and `st check` compares it with the INS.
  # NAME_OF_MESSAGE:
  #   needed: false
  #   period: {value: 0.02, unit: s}
  #   timeout: {value: 0.2, unit: s}
  #   signals:
  #     NAME_OF_SIGNAL: {name: vehicle_speed, unit: km/h, sign: 1}

"""
DBC_TEMPLATE = """\
VERSION ""

BU_: CAR RT LOGGER

// The messages of your car. You need one with the steering wheel angle, for example:
// BO_ 37 MyCar_Steering: 8 CAR
//  SG_ SteerAngle : 0|16@1- (0.1,0) [-3276.8|3276.7] "deg" LOGGER
// start bit | length @ 1: low byte first, 0: high byte first; - signed, + unsigned; (factor,offset) [minimum|maximum].
// A multiplexed signal (m0 with a selector M) is read from the frames that carry it.
// If the OxTS RT sends on the same bus, append its messages: cat rt.dbc >> can.dbc
"""
CAR_TEMPLATE = """\
# road_wheel_angle = (steering_sign * sensor - steering_wheel_offset) / steering_ratio, positive to the left.
# steering_wheel_offset and steering_ratio are values of vehicle.yaml.
steering_sign: 1         # 1: the sensor, as can.dbc and signals.yaml decode it, is positive to the left; -1: right
steering_latency: 0.0    # s, delay from steering wheel motion to the stamp of its frame (0 to 1)
"""
VEHICLE_TEMPLATE = """\
# Every value has a unit and a source. FILL_IN marks the values and sources that only you know.
# The other values are initial assumptions. uncertainty: one standard deviation, in the unit of the value;
# st discover uses it as a prior of the value. Without it, a default or no prior is used (see st car check).
name: FILL_IN
"""


def write_skeleton(folder: Path) -> list[Path]:
    """Writes vehicle.yaml, signals.yaml, can.dbc, rt.dbc and car.yaml to a new or empty folder; returns their paths.

    Raises RunError if the folder is not empty or cannot be written.
    """
    vehicle, signals, dbc = ((config("car/leaf") / name).read_text(encoding="utf-8")
                             for name in ("vehicle.yaml", "signals.yaml", "can.dbc"))
    blocks = re.split(r"\n(?=\S)", dbc)
    rt = "\n" + "".join(f"{block.rstrip()}\n\n" for block in blocks if re.match(r"BO_ \d+ RT_", block))
    rows = re.split(r"(?m)^name:.*\n", vehicle)[1].splitlines()
    head, messages = signals.split("messages:\n", 1)
    texts = {"vehicle.yaml": VEHICLE_TEMPLATE + "".join(f"{_make_template_row(row)}\n" for row in rows),
             "signals.yaml": head + SIGNALS_TEMPLATE + messages[messages.index("  # The INS on CAN"):],
             "can.dbc": DBC_TEMPLATE, "rt.dbc": rt, "car.yaml": CAR_TEMPLATE}
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise RunError(folder, "exists already, and nothing is overwritten", "name a new folder")
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(folder, f"cannot be written: {error.strerror}") from None
    return [folder / name for name in texts]


def find_problems(folder: str) -> list[str]:
    """Finds the problems in the folder of a car: one line each with file and key; empty for a valid car.

    Raises RunError for a folder without a car.
    """
    path = Path(folder)
    if "/" in folder and not path.is_dir():
        raise RunError(path, "the folder does not exist", f"create it with st car new {folder}")
    problems = []
    try:
        car = load_car(folder)
    except RunError as error:
        if not str(error.path).endswith("car.yaml"):
            raise
        car, problems = Car(Path(error.path).parent, 1, 0.0), [str(error)]
    return [*problems, *_find_vehicle_problems(car.vehicle), *_find_bus_problems(car)]


def list_remarks(folder: str) -> list[str]:
    """Lists remarks on a valid car: values unusual for a road car, doubtful CAN signals, and uncertainties in use."""
    car = load_car(folder)
    vehicle = read_vehicle(car.vehicle)
    return [*(f"{car.vehicle}: unusual: {text}" for text in find_implausible_values(vehicle)), *_list_bus_remarks(car),
            "uncertainty of each quantity, one standard deviation (the prior of st discover):",
            *(f"  {line}" for line in list_uncertainties(vehicle))]


def list_uncertainties(vehicle: VehicleParameters) -> list[str]:
    """One line for each quantity with a stated or default uncertainty; the last one names others that may be fitted."""
    quantities = {**VEHICLE_QUANTITIES,
                  **{f"{tyre}.{key}": quantity for tyre in TYRES for key, quantity in TYRE_QUANTITIES.items()}}
    lines, keys_without = [], []
    for key, quantity in quantities.items():
        uncertainty = vehicle.uncertainty(key)
        if uncertainty is None:
            keys_without.append(key)
            continue
        provenance = vehicle.provenance.get(key)
        unit = "" if quantity.si_unit == "1" else f" {quantity.si_unit}"
        default = DEFAULT_UNCERTAINTIES.get(key)
        if provenance is not None and provenance.uncertainty:
            lines.append(f"{key} +/- {uncertainty:.3g}{unit} (from the file)")
        elif default is not None:
            size = f"{100 * default.size:g} %" if default.relative else f"{uncertainty:.3g}{unit}"
            lines.append(f"{key} assumed +/- {size} ({default.source}); give `uncertainty` to change that")
    fit_keys = [key for key in keys_without if "." not in key and key not in FIXED_QUANTITIES]
    return [*lines, f"free in st discover unless `uncertainty` is given: {', '.join(fit_keys)}"] if fit_keys else lines


def _find_vehicle_problems(file: Path) -> list[str]:
    try:
        if unfilled_keys := _find_unfilled_keys(read_yaml_mapping(file)):
            entries = {key: "value, source and uncertainty" if key in DEFAULT_UNCERTAINTIES else "value and source"
                       for key in VEHICLE_QUANTITIES}
            return [f"{file}: {key}: not filled in"
                    + (f" ({entries[key]}; {VEHICLE_QUANTITIES[key].limits})" if key in entries else "")
                    for key in unfilled_keys]
        vehicle = read_vehicle(file)
    except (RunError, StCoreError) as error:
        return [str(error)]
    step = PredictionSettings().step
    slip_speed = required_slip_speed(("linear", "nonlinear"), vehicle, STABILITY_SPEEDS, step)
    if slip_speed is None:
        return [f"{file}: mass, yaw_inertia, cornering_stiffness_front, cornering_stiffness_rear: the "
                f"numerical integration is unstable at any minimum_slip_speed with steps of {1e3 * step:g} ms; is one "
                "of them in a different unit?"]
    if slip_speed <= vehicle.minimum_slip_speed:
        return []
    return [f"{file}: minimum_slip_speed: {vehicle.minimum_slip_speed:g} m/s is too low for integration steps of "
            f"{1e3 * step:g} ms; use {slip_speed:g} m/s or more, or shorter steps (st evaluate --step)"]


def _find_bus_problems(car: Car) -> list[str]:
    files = [file for file in (car.dbc, car.signals) if file.exists()]
    if not files:  # the car is only used with CSV files and bags
        return []
    if len(files) == 1:
        missing_file = car.signals if car.dbc.exists() else car.dbc
        return [f"{missing_file}: the file does not exist, and {files[0].name} cannot be used without it; write it, or "
                "delete both"]
    try:
        if _find_unfilled_keys(read_yaml_mapping(car.signals)):
            return [f"{car.signals}: messages: {FILL_IN}_message and {FILL_IN}_signal are not filled in: enter the "
                    f"names, as in {car.dbc.name}, of the message and the signal that carry the steering wheel angle; "
                    "if all recordings are CSV or bags, delete both files"]
        table = load_table(car.dbc, car.signals)
    except (RunError, ConfigurationError) as error:
        return [str(error)]
    if table.find_steering() is None:
        return [f"{car.signals}: messages: no signal of {car.dbc.name} is mapped to steering_wheel_angle, which every "
                "prediction needs"]
    return []


def _list_bus_remarks(car: Car) -> list[str]:
    """A line for each mapped signal with an unknown DBC unit, and one if all speed signals of the DBC are unmapped."""
    if not car.signals.exists():
        return []
    table = load_table(car.dbc, car.signals)
    signals = [signal for message in table.messages.values() for signal in message.signals]
    remarks = [f"{car.signals}: {signal.dbc.name}: {car.dbc.name} gives the unknown unit {signal.dbc.unit!r}; the unit "
               f"{signal.unit!r} of the table is used" for signal in signals if find_dbc_unit(signal.dbc.unit) is None]
    if any(signal.name in SPEEDS for signal in signals):
        return remarks
    names = [f"{message.name}.{signal.name}" for message in table.database.messages for signal in message.signals
              if "speed" in signal.name.lower() and find_unit("speed", signal.unit or "") and
              not message.name.startswith("RT_")]
    return [*remarks, f"{car.signals}: it maps no speed signal, but {car.dbc.name} has {', '.join(names[:4])}: map one "
            "to vehicle_speed (or wheel_speed_rear_left, ...); it aligns the clocks of INS and CAN log better than the "
            "steering"] if names else remarks


def _find_unfilled_keys(document: Mapping[str, Any]) -> list[str]:
    return [str(key) for key, value in document.items() if FILL_IN in f"{key} {value}"]


def _make_template_row(line: str) -> str:
    """Converts a line of the vehicle file of the Leaf to the template for a new car."""
    row = _VEHICLE_ROW.match(line)
    if row is None:
        return line
    key, unit = row["key"], row["unit"]
    if key in MEASUREMENT_HINTS:
        uncertainty = f", uncertainty: {FILL_IN}" if key in DEFAULT_UNCERTAINTIES else ""
        return f"{key}: {{value: {FILL_IN}, unit: {unit}, source: {FILL_IN}{uncertainty}}}  # {MEASUREMENT_HINTS[key]}"
    value, reason = (0.0, "none") if key in ZERO_QUANTITIES else (row["value"], "as a Nissan Leaf ZE0")
    uncertainty = f", uncertainty: {ASSUMED_UNCERTAINTIES[key]}" if key in ASSUMED_UNCERTAINTIES else ""
    return f'{row["indent"]}{key}: {{value: {value}, unit: {unit}, source: "assumed: {reason}"{uncertainty}}}'


