"""Healthy cars: the plants with small random deviations from their nominal parameters."""

from dataclasses import dataclass, field

import numpy as np
from st_sim.settings import REALISTIC, SETTINGS, Settings

from . import multibody_car

LEAF = "leaf"
PLANTS = (LEAF, *multibody_car.CARS)

# Standard deviations, relative to the nominal value or in its unit.
_RELATIVE = {
    "mass_factor": 0.03, "yaw_inertia_factor": 0.05, "front_stiffness_factor": 0.04, "rear_stiffness_factor": 0.04,
    "friction_factor": 0.03, "steering_ratio_factor": 0.02, "relaxation_length": 0.15, "steering_lag": 0.2,
    "steering_compliance": 0.2, "roll_gradient": 0.1, "velocity_scale": 0.001, "yaw_rate_scale": 0.002,
    "drag_area": 0.1, "rolling_resistance": 0.1,
}
_ABSOLUTE = {
    "steering_offset": 0.001, "cg_shift": 0.02, "ins_misalignment": 0.002, "ins_lever_error": 0.01,
    "lateral_acceleration_bias": 0.02, "roll_steer": 0.01,
}


@dataclass(frozen=True)
class HealthyCar:
    """A car of a plant (one of PLANTS), with the seed of its deviations and the settings of plant and sensors."""

    plant: str
    seed: tuple[int, ...]
    settings: Settings = field(compare=False)


def healthy_car(plant: str, seed: tuple[int, ...], **others: float) -> HealthyCar:
    """A car with random deviations. others: settings without a deviation."""
    generator = np.random.default_rng(seed)
    leaf = plant == LEAF
    values = dict(REALISTIC if leaf else multibody_car.HEALTHY)
    for table, apply in ((_RELATIVE, lambda a, b: a * (1.0 + b)), (_ABSOLUTE, lambda a, b: a + b)):
        for name, spread in table.items():
            drawn = spread * np.clip(generator.standard_normal(), -2.5, 2.5)
            if leaf or name in multibody_car.SUPPORTED_SETTINGS:
                values[name] = apply(values[name], drawn)
    values |= others
    # The programmes already contain the tremor of the driver.
    values["driver_tremor"] = 0.0
    return HealthyCar(plant, seed, {n: _clip(n, float(v)) for n, v in values.items()})


def has_setting(plant: str, setting: str) -> bool:
    return setting in (SETTINGS if plant == LEAF else multibody_car.SUPPORTED_SETTINGS)


def _clip(name: str, value: float) -> float:
    limits = SETTINGS.get(name)
    return value if limits is None or name in ("roll_gradient", "pitch_gradient") else min(
        max(value, limits.low), limits.high)
