"""Healthy cars: the realistic virtual Leaf, each a few per cent off what the vehicle file says."""

from dataclasses import dataclass

import numpy as np
from st_sim.settings import REALISTIC, SETTINGS, Settings

# One standard deviation: as a factor of the realistic value, or added where that is 0 or 1 by nature.
_FACTOR = {
    "mass_factor": 0.03, "yaw_inertia_factor": 0.05, "front_stiffness_factor": 0.04, "rear_stiffness_factor": 0.04,
    "friction_factor": 0.03, "steering_ratio_factor": 0.02, "relaxation_length": 0.15, "steering_lag": 0.2,
    "steering_compliance": 0.2, "roll_gradient": 0.1, "velocity_scale": 0.001, "yaw_rate_scale": 0.002,
    "drag_area": 0.1, "rolling_resistance": 0.1,
}
_ADDED = {
    "steering_offset": 0.001, "cg_shift": 0.02, "ins_misalignment": 0.002, "ins_lever_error": 0.01,
    "lateral_acceleration_bias": 0.02, "roll_steer": 0.01,
}


@dataclass(frozen=True)
class HealthyCar:
    """settings of the plant and its sensors. number: which car of its set it is."""

    number: tuple[int, ...]
    settings: Settings


def healthy_car(number: tuple[int, ...], **others: float) -> HealthyCar:
    """The car of that number. others: settings it has for sure."""
    generator = np.random.default_rng(number)
    values = dict(REALISTIC)
    for name, spread in _FACTOR.items():
        values[name] *= 1.0 + spread * np.clip(generator.standard_normal(), -2.5, 2.5)
    for name, spread in _ADDED.items():
        values[name] += spread * np.clip(generator.standard_normal(), -2.5, 2.5)
    values |= others
    # Tremor is part of the programmes here.
    values["driver_tremor"] = 0.0
    return HealthyCar(number, {n: min(max(float(v), SETTINGS[n].low), SETTINGS[n].high) for n, v in values.items()})
