"""Writes the folder of a new car with placeholders to fill in, and finds problems in the folder of a car."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canedge_bridge.signals import load_table
from canedge_bridge.units import find_unit, list_kinds
from st_core.errors import ConfigurationError, StCoreError
from st_core.handling import find_implausible_values
from st_core.integrate import required_slip_speed
from st_core.models import TYRE_MODELS
from st_core.prediction import PredictionSettings
from st_core.vehicle import DEFAULT_UNCERTAINTIES, FILE_QUANTITIES, OPTIONAL_QUANTITIES, VehicleParameters

from .car import STABILITY_SPEEDS, Car, load_car, read_vehicle
from .paths import config
from .runs.errors import RunError
from .runs.ins_log import SPEEDS
from .runs.run_file import read_yaml_mapping

FILL_IN = "FILL_IN"
"""Placeholder for values that only the owner of the car can give; commands reject files that contain it."""
TEMPLATE_FILES = ("vehicle.yaml", "signals.yaml", "can.dbc", "rt.dbc", "car.yaml")
# Quantities that st discover never fits.
FIXED_QUANTITIES = ("wheelbase", "minimum_slip_speed", "length", "width", *OPTIONAL_QUANTITIES)


def write_skeleton(folder: Path) -> list[Path]:
    """Copies the files of config/new_car to a new or empty folder; returns their paths.

    Raises RunError if the folder is not empty or cannot be written.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise RunError(folder, "already exists and is not overwritten", "name a new folder")
        folder.mkdir(parents=True, exist_ok=True)
        return [Path(shutil.copyfile(config("new_car") / name, folder / name)) for name in TEMPLATE_FILES]
    except OSError as error:
        raise RunError(folder, f"cannot be written: {error.strerror}") from None


def find_problems(folder: str) -> list[str]:
    """Finds the problems in the folder of a car: one line each with file and key, if any; empty for a valid car.

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
            "standard deviations (priors of st discover); `uncertainty` in the vehicle file replaces them:",
            *(f"  {line}" for line in list_uncertainties(vehicle))]


def list_uncertainties(vehicle: VehicleParameters) -> list[str]:
    """One line for each quantity with a stated or default uncertainty, and one with the others that can be fitted."""
    lines, keys_without_uncertainty = [], []
    for key, quantity in FILE_QUANTITIES.items():
        uncertainty = vehicle.uncertainty(key)
        if uncertainty is None:
            keys_without_uncertainty.append(key)
            continue
        unit = "" if quantity.si_unit == "1" else f" {quantity.si_unit}"
        default = DEFAULT_UNCERTAINTIES.get(key)
        if (provenance := vehicle.provenance.get(key)) is not None and provenance.uncertainty:
            lines.append(f"{key} +/- {uncertainty:.3g}{unit} (from the file)")
        elif default is not None:
            size = f"{100 * default.size:g} %" if default.relative else f"{uncertainty:.3g}{unit}"
            lines.append(f"{key} assumed +/- {size} ({default.source})")
    if fit_keys := [key for key in keys_without_uncertainty if "." not in key and key not in FIXED_QUANTITIES]:
        lines.append(f"no prior unless `uncertainty` is given: {', '.join(fit_keys)}")
    return lines


def _find_vehicle_problems(file: Path) -> list[str]:
    try:
        if unfilled_keys := _find_unfilled_keys(read_yaml_mapping(file)):
            entries = {key: "value, source and uncertainty" if key in DEFAULT_UNCERTAINTIES else "value and source"
                       for key in FILE_QUANTITIES}
            return [f"{file}: {key}: not filled in"
                    + (f" ({entries[key]}; {FILE_QUANTITIES[key].limits})" if key in entries else "")
                    for key in unfilled_keys]
        vehicle = read_vehicle(file)
    except (RunError, StCoreError) as error:
        return [str(error)]
    step = PredictionSettings().step
    slip_speed = required_slip_speed(TYRE_MODELS, vehicle, STABILITY_SPEEDS, step)
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
        return [f"{missing_file}: the file does not exist, and {files[0].name} cannot be used without it; create it "
                f"or delete {files[0].name}"]
    try:
        if _find_unfilled_keys(read_yaml_mapping(car.signals)):
            return [f"{car.signals}: messages: {FILL_IN}_message and {FILL_IN}_signal are not filled in: enter the "
                    f"names, as in {car.dbc.name}, of the message and the signal that carry the steering wheel angle; "
                    f"if all recordings are CSV or bags, delete {car.signals.name}, {car.dbc.name} and rt.dbc"]
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
               f"{signal.unit!r} of the table is used" for signal in signals if not list_kinds(signal.dbc.unit or "")]
    if any(signal.name in SPEEDS for signal in signals):
        return remarks
    names = [f"{message.name}.{signal.name}" for message in table.database.messages for signal in message.signals
              if "speed" in signal.name.lower() and find_unit("speed", signal.unit or "") and
              not message.name.startswith("RT_")]
    return [*remarks, f"{car.signals}: no speed signal is mapped, but {car.dbc.name} has {', '.join(names[:4])}: map "
            "one to vehicle_speed (or wheel_speed_rear_left, ...); a speed aligns the clocks of INS and CAN log better "
            "than the steering"] if names else remarks


def _find_unfilled_keys(document: Mapping[str, Any]) -> list[str]:
    return [str(key) for key, value in document.items() if FILL_IN in f"{key} {value}"]
