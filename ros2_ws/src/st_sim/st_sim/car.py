"""Reads the vehicle data of the virtual car from a vehicle file.

It does not use st_core.vehicle, so that an error in one of the two readers appears as a difference between them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from .settings import SimulationError, read_document

GRAVITY = 9.81  # m/s^2, as in st_core
TRACK_WIDTH = 1.54  # m, both axles, for every vehicle file; Leaf ZE0 by its manufacturer: 1.540 m front, 1.535 m rear

_TO_SI = {"deg": math.pi / 180, **dict.fromkeys(("rad", "kg", "kg m^2", "m", "m/s", "N", "N/rad", "1"), 1.0)}


@dataclass(frozen=True)
class Tyre:
    """Magic Formula coefficients of one tyre with SAE signs (p_ky1 < 0). nominal_load: F_z0 [N]. lambda_ky: factor on
    the cornering stiffness."""

    nominal_load: float
    p_cy1: float
    p_dy1: float
    p_dy2: float
    p_ey1: float
    p_ey2: float
    p_ey3: float
    p_ky1: float
    p_ky2: float
    p_ky4: float
    lambda_ky: float


@dataclass(frozen=True)
class Car:
    """Vehicle data [SI]; x forward, y left. Cornering stiffnesses are per axle and positive."""

    name: str
    mass: float
    yaw_inertia: float
    wheelbase: float
    cg_to_front_axle: float
    cg_height: float
    cg_to_ins_x: float
    cg_to_ins_y: float
    steering_ratio: float
    steering_wheel_offset: float
    cornering_stiffness_front: float
    cornering_stiffness_rear: float
    tyre_front: Tyre
    tyre_rear: Tyre

    @property
    def cg_to_rear_axle(self) -> float:
        return self.wheelbase - self.cg_to_front_axle


_CAR_KEYS = tuple(f.name for f in fields(Car) if f.name not in ("name", "tyre_front", "tyre_rear"))
_TYRE_KEYS = tuple(f.name for f in fields(Tyre) if f.name != "lambda_ky")


def read_car(file: str | Path) -> Car:
    """The car of a vehicle file. Raises SimulationError naming file and key."""
    path = Path(file)
    document = read_document(path)
    if not isinstance(document, Mapping):
        raise SimulationError(f"{path}: expected lines `key: value`")
    values = {key: _read_number(document, key, path, "") for key in _CAR_KEYS}
    for key, value in values.items():
        if value <= 0 and key not in ("cg_height", "cg_to_ins_x", "cg_to_ins_y", "steering_wheel_offset"):
            raise SimulationError(f"{path}: {key}: {value:g} is not above 0")
    front_load = values["mass"] * GRAVITY * (values["wheelbase"] - values["cg_to_front_axle"]) / values["wheelbase"] / 2
    rear_load = values["mass"] * GRAVITY * values["cg_to_front_axle"] / values["wheelbase"] / 2
    return Car(name=str(document.get("name", path.stem)),
               tyre_front=_read_tyre(document, "tyre_front", path, values["cornering_stiffness_front"], front_load),
               tyre_rear=_read_tyre(document, "tyre_rear", path, values["cornering_stiffness_rear"], rear_load),
               **values)


def _read_tyre(document: Mapping[str, Any], key: str, path: Path, axle_stiffness: float, static_load: float) -> Tyre:
    """One tyre of an axle. A missing lambda_ky is derived from the axle's cornering stiffness at static load."""
    section = document.get(key)
    if not isinstance(section, Mapping):
        raise SimulationError(f"{path}: {key} is missing")
    values = {name: _read_number(section, name, path, f"{key}.") for name in _TYRE_KEYS}
    if "lambda_ky" in section:
        return Tyre(lambda_ky=_read_number(section, "lambda_ky", path, f"{key}."), **values)
    try:
        nominal_load = values["nominal_load"]
        load_factor = math.sin(values["p_ky4"] * math.atan(static_load / (values["p_ky2"] * nominal_load)))
        unscaled = values["p_ky1"] * nominal_load * load_factor
        lambda_ky = axle_stiffness / (2 * abs(unscaled))
    except ArithmeticError:
        raise SimulationError(f"{path}: {key}: no stiffness from p_ky1, p_ky2, p_ky4 and nominal_load") from None
    return Tyre(lambda_ky=lambda_ky, **values)


def _read_number(section: Mapping[str, Any], key: str, path: Path, prefix: str) -> float:
    entry = section.get(key)
    if not isinstance(entry, Mapping) or "value" not in entry or "unit" not in entry:
        raise SimulationError(f"{path}: {prefix}{key}: expected {{value: ..., unit: ..., source: ...}}")
    value, unit = entry["value"], entry["unit"]
    if unit not in _TO_SI:
        raise SimulationError(f"{path}: {prefix}{key}: unit {unit!r} is not one of {', '.join(_TO_SI)}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SimulationError(f"{path}: {prefix}{key}: {value!r} is not a number")
    return float(value) * _TO_SI[unit]
