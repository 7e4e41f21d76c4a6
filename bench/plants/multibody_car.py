"""The cars of the multi-body plant: parameter sets and equations of the package commonroad-vehicle-models.

The 29 equations of the package are used unchanged. In the package all wheels have the same tyre; here each axle has its
own: `PerAxle` replaces `p.tire` in the source by `p.tire_front` or `p.tire_rear`.

Axes: the equations are written for y to the right and z down; their mirror image is valid for y to the left (yaw left
+). Roll is therefore positive with the left side down, and "left" wheels of the package are on the right; pitch is
positive nose up.
Source: Althoff and Wuersching, CommonRoad: Vehicle Models, 2020. Checked by: tests/bench/test_discovery_plants.py.
"""

import dataclasses
import re
from collections import Counter, namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.abc import ExecutionLoader
from importlib.util import find_spec, module_from_spec, spec_from_loader
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from st_core.tyres import GRAVITY, MagicFormula, magic_formula_coefficients, magic_formula_force
from st_core.vehicle import TYRE_QUANTITIES, VehicleParameters
from st_sim.settings import IDEAL
from vehiclemodels import vehicle_parameters as package
from vehiclemodels.utils.tire_model import formula_lateral
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

MAX_STEERING_RATE = 5.0
"""Limit at the road wheels [rad/s]; that of the package, 0.4, is for planners."""
SLIP_SPEED = 5.0
"""`minimum_slip_speed` of the vehicle files [m/s]; at a lower one, prediction steps of 50 ms are too long for these
tyres."""
SLIP_RANGE, LOAD_RANGE = 0.2, (0.3, 1.8)
"""Slip angles [rad], and loads relative to the static load, for the fit of the tyre in the vehicle file."""


@dataclass(frozen=True)
class CarData:
    """Number of a parameter set of the package, and data that it does not contain. The INS is on the centreline, at the
    height of the CG of the body."""

    number: int
    name: str
    steering_ratio: float
    cg_to_ins_x: float  # [m]


CARS = MappingProxyType({
    "escort": CarData(1, "Ford Escort, multi-body", 18.5, -0.45),
    "bmw_320i": CarData(2, "BMW 320i, multi-body", 15.5, -0.25),
    "vanagon": CarData(3, "VW Vanagon, multi-body", 20.5, 0.30),
})
"""The Escort has front-wheel drive, the others rear-wheel drive."""

STEERING = ("steering_offset", "steering_ratio_factor", "steering_lag", "steering_delay", "steering_backlash")
BODY = ("mass_factor", "yaw_inertia_factor", "cg_shift", "friction_factor", "front_stiffness_factor",
        "rear_stiffness_factor")
ENVIRONMENT = ("drag_area", "bank_angle", "grade_angle", "hillside_slope", "terrain_wave", "friction_patch",
                "wind_speed", "gust_speed")
SENSORS = ("ins_noise", "ins_time_error", "ins_misalignment", "ins_lever_error", "yaw_rate_scale", "yaw_rate_bias",
           "velocity_scale", "lateral_acceleration_bias", "steering_sensor_noise", "steering_sensor_latency")
SUPPORTED_SETTINGS = (*STEERING, *BODY, *ENVIRONMENT, *SENSORS)
"""Settings of this plant, with names, units and signs of st_sim.settings, and in addition yaw_rate_bias [rad/s]."""

# The sensors multiply the gradients by accelerations, in place of which this plant records roll and pitch.
HEALTHY: Mapping[str, float] = MappingProxyType({
    **IDEAL, "yaw_rate_bias": 0.0, "ins_noise": 1.0, "steering_sensor_noise": 0.0005, "roll_gradient": 1.0,
    "pitch_gradient": 1.0})
"""Settings without a hidden effect: the car of the package, with normal noise."""


def complete_settings(settings: Mapping[str, float]) -> dict[str, float]:
    """HEALTHY with the given settings. Raises ValueError for one that this plant does not have."""
    unsupported = [name for name, value in settings.items()
                   if name not in SUPPORTED_SETTINGS and value != HEALTHY.get(name)]
    if unsupported:
        raise ValueError(f"the multi-body car has no {', '.join(unsupported)}")
    return {**HEALTHY, **settings}


class PerAxle(ExecutionLoader):
    """Imports a module of the package with separate tyres for each axle, without changing the package. Raises
    ImportError for another version of the source."""

    def get_filename(self, fullname: str) -> str:
        return find_spec(fullname).origin

    def get_source(self, fullname: str) -> str:
        calls: Counter = Counter()

        def replace_tyre(call: re.Match) -> str:
            # The first argument is the slip of one wheel: s_lf, alpha_RR.
            axle = {"f": "tire_front", "r": "tire_rear"}[call[2].lower()]
            calls[axle] += 1
            return f"{call[1]}p.{axle})"
        source = re.sub(r"(\btireModel\.\w+\(\w+_[lr]([fr]), .*)\bp\.tire\)",
                        replace_tyre, Path(self.get_filename(fullname)).read_text("utf-8"), flags=re.IGNORECASE)
        if calls != {"tire_front": 8, "tire_rear": 8} or re.search(r"\bp\.tire\b", source):
            raise ImportError(f"{fullname}: the source differs from version 3.0.2, with 8 calls of the tyre per axle")
        return source


def per_axle(function: Callable) -> Callable:
    """The function of the package, from its module as `PerAxle` imports it."""
    specification = spec_from_loader(function.__module__, PerAxle())
    module = module_from_spec(specification)
    specification.loader.exec_module(module)
    return getattr(module, function.__name__)


dynamics = per_axle(vehicle_dynamics_mb)
"""f(x, (rate of the road-wheel angle [rad/s], acceleration [m/s^2]), parameters) -> list of 29 rates."""


def _fields(cls: type, *left_out: str) -> list[str]:
    return [f.name for f in dataclasses.fields(cls) if f.name not in left_out]


# Without the trailer and the common tyre. At module level, so that other processes find the cached machine code.
Numbers = namedtuple("Numbers", [*_fields(package.VehicleParameters, "tire", "trailer"), "tire_front", "tire_rear"])
TyreNumbers = namedtuple("TyreNumbers", _fields(package.TireParameters))
SteeringNumbers = namedtuple("SteeringNumbers", _fields(package.SteeringParameters))
LongitudinalNumbers = namedtuple("LongitudinalNumbers", _fields(package.LongitudinalParameters))


def _numbers(record: type, p: Any, **others: tuple) -> tuple:
    """Converts a dataclass of the package to a named tuple of floats; others: fields that are tuples."""
    return record(**{name: others[name] if name in others else float(getattr(p, name)) for name in record._fields})


_load_parameters = lru_cache(package.setup_vehicle_parameters)


def parameters_of(car: str, settings: Mapping[str, float]) -> Numbers:
    """The parameters of the equations, with `tire_front` and `tire_rear`."""
    s = complete_settings(settings)
    p = _load_parameters(CARS[car].number)
    mass, shift = s["mass_factor"], s["cg_shift"]
    front, rear = (
        dataclasses.replace(p.tire, p_ky1=p.tire.p_ky1 * s[stiffness], p_dx1=p.tire.p_dx1 * s["friction_factor"],
                            p_dy1=p.tire.p_dy1 * s["friction_factor"])
        for stiffness in ("front_stiffness_factor", "rear_stiffness_factor"))
    p = dataclasses.replace(
        p, m=p.m * mass, m_s=p.m_s * mass, m_uf=p.m_uf * mass, m_ur=p.m_ur * mass, I_z=p.I_z * s["yaw_inertia_factor"],
        a=p.a - shift, b=p.b + shift)
    steering = dataclasses.replace(p.steering, v_min=-MAX_STEERING_RATE, v_max=MAX_STEERING_RATE)
    return _numbers(Numbers, p, steering=_numbers(SteeringNumbers, steering),
                    longitudinal=_numbers(LongitudinalNumbers, p.longitudinal),
                    tire_front=_numbers(TyreNumbers, front), tire_rear=_numbers(TyreNumbers, rear))


def static_loads(p: Numbers) -> tuple[float, float]:
    """Loads of a front and a rear tyre at rest [N]."""
    wheelbase = p.a + p.b
    return (GRAVITY * (p.m_s * p.b / wheelbase + p.m_uf) / 2, GRAVITY * (p.m_s * p.a / wheelbase + p.m_ur) / 2)


def rest_pitch(p: Numbers) -> float:
    """Pitch of the car at rest [rad], nose up +, due to the deflection of the tyres."""
    front, rear = static_loads(p)
    return (rear - front) / p.K_zt / (p.a + p.b)


def tyre_force(slip: float, load: float, tyre: TyreNumbers) -> float:
    """F_y [N] of one upright wheel of the package at pure lateral slip [rad]."""
    return formula_lateral(slip, 0.0, load, tyre)[0]


def cornering_stiffness(load: float, tyre: TyreNumbers) -> float:
    """-dF_y/dalpha [N/rad] of one tyre at zero slip, as a difference quotient."""
    step = 1e-5
    return (tyre_force(-step, load, tyre) - tyre_force(step, load, tyre)) / (2 * step)


FITTED = ("p_cy1", "p_dy1", "p_dy2", "p_ey1", "p_ey2", "p_ky1")
FIXED = {"p_ky2": 20.0, "p_ky4": 2.5}
"""Stiffness nearly proportional to the load, as in the package; p_ky2 has its largest value."""


@lru_cache(maxsize=64)
def fit_tyre(load: float, tyre: TyreNumbers) -> tuple[MagicFormula, float]:
    """Fits the Magic Formula of the suite to a tyre of the package by least squares over slip angles and loads.

    load: static load of one tyre [N]. Also returns the rms residual divided by the peak force at this load [1].
    """
    slips, loads = np.meshgrid(np.linspace(-SLIP_RANGE, SLIP_RANGE, 81), load * np.linspace(*LOAD_RANGE, 7))
    target = np.vectorize(lambda a, f: tyre_force(a, f, tyre))(slips, loads)
    peak_force = tyre.p_dy1 * load
    start = np.array([tyre.p_cy1, tyre.p_dy1, 0.0, tyre.p_ey1, 0.0, tyre.p_ky1 * 8.0])
    low, high = ([getattr(TYRE_QUANTITIES[name], end) for name in FITTED] for end in ("minimum", "maximum"))

    def formula(values: np.ndarray) -> MagicFormula:
        return MagicFormula(nominal_load=load, p_ey3=0.0, **FIXED, **dict(zip(FITTED, values, strict=True)))

    def residuals(values: np.ndarray) -> np.ndarray:
        fitted = formula(values)
        force = magic_formula_force(slips, *magic_formula_coefficients(loads, fitted), fitted)
        return ((force - target) / peak_force).ravel()

    found = least_squares(residuals, np.clip(start, np.array(low) + 1e-9, np.array(high) - 1e-9), bounds=(low, high),
                          x_scale=np.maximum(np.abs(start), 0.1))
    return formula(found.x.tolist()), float(np.sqrt(np.mean(found.fun**2)))


def vehicle_of(car: str, settings: Mapping[str, float] | None = None) -> VehicleParameters:
    """The vehicle file of a car with these settings of body, tyres, steering and INS point (None: HEALTHY).

    Lags, sensors and environment are not part of a vehicle file.
    """
    s, choice = complete_settings(settings or {}), CARS[car]
    p = parameters_of(car, s)
    load_front, load_rear = static_loads(p)
    ratio = choice.steering_ratio * s["steering_ratio_factor"]
    vehicle = VehicleParameters(
        name=choice.name, mass=p.m, yaw_inertia=p.I_z, wheelbase=p.a + p.b, cg_to_front_axle=p.a, cg_height=p.h_cg,
        cg_to_ins_x=choice.cg_to_ins_x - s["cg_shift"] + s["ins_lever_error"], cg_to_ins_y=0.0,
        steering_ratio=ratio, steering_wheel_offset=-s["steering_offset"] * ratio,
        cornering_stiffness_front=2 * cornering_stiffness(load_front, p.tire_front),
        cornering_stiffness_rear=2 * cornering_stiffness(load_rear, p.tire_rear),
        minimum_slip_speed=SLIP_SPEED, length=p.l, width=p.w,
        tyre_front=fit_tyre(load_front, p.tire_front)[0], tyre_rear=fit_tyre(load_rear, p.tire_rear)[0])
    return vehicle.with_derived_scales()


@lru_cache
def nominal_car(car: str) -> VehicleParameters:
    """The car without hidden effects, for the manoeuvres and sensors of the benchmark."""
    return vehicle_of(car)
