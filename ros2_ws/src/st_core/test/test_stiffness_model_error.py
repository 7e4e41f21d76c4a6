"""Cornering stiffness intervals contain the slope at zero slip of tyres with a curve other than the vehicle file's.

The car is defined here: two axles of brush tyres with parabolic pressure (Pacejka, Tire and Vehicle Dynamics, ch. 3).
"""

from types import SimpleNamespace

import numpy as np
import pytest
from driven import SILENT, Sensors, drive, weave
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_prediction import STIFFNESSES, fit_stiffness

FRONT, REAR = 62_000.0, 88_000.0  # N/rad at zero slip
FRICTION = 0.9


def brush_force(slip, stiffness, load):
    """Opposes the slip; full sliding beyond tan(slip) = 3 mu F_z / C."""
    s, limit = np.tan(slip), FRICTION * load
    if stiffness * abs(s) >= 3.0 * limit:
        return -limit * np.sign(s)
    return -(stiffness * s - stiffness**2 * abs(s) * s / (3.0 * limit) + stiffness**3 * s**3 / (27.0 * limit**2))


def brush_car(car):
    """Model interface that `driven.drive` integrates: states x, y, forward, across, yaw, yaw rate; constant speed."""
    l_f, l_r, m = car.cg_to_front_axle, car.cg_to_rear_axle, car.mass
    load_f, load_r = (m * 9.81 * arm / (l_f + l_r) for arm in (l_r, l_f))

    def rhs(state, angle, _):
        _, _, u, v, psi, r = state
        front = brush_force(np.arctan2(v + l_f * r, u) - angle, FRONT, load_f)
        rear = brush_force(np.arctan2(v - l_r * r, u), REAR, load_r)
        c, s = np.cos(psi), np.sin(psi)
        across = front * np.cos(angle) + rear
        return (u * c - v * s, u * s + v * c, 0.0, across / m - u * r, r,
                (l_f * front * np.cos(angle) - l_r * rear) / car.yaw_inertia)

    return SimpleNamespace(rhs=rhs, parameters=lambda _: None, inputs=lambda angle, *_: angle, extra_states=())


@pytest.fixture(scope="module", params=[SILENT, Sensors()], ids=["noise-free", "noise"])
def logs(leaf, request):
    # 1.5 to 3.5 m/s^2: up to half of the friction.
    return [drive(leaf, speed, weave(angle), 40.0, model=brush_car(leaf), sensors=request.param, seed=3)
            for speed, angle in ((8.0, 0.12), (11.0, 0.075), (14.0, 0.055))]


@pytest.mark.slow
@pytest.mark.parametrize("identify", [
    identify_stiffness, lambda logs, car: fit_stiffness(logs, car, "linear"), fit_stiffness],
    ids=["regression", "linear prediction", "nonlinear prediction"])
def test_interval_contains_the_slope_at_zero_slip(leaf, logs, identify):
    found = identify(logs, leaf)
    for name, slope in zip(STIFFNESSES, (FRONT, REAR), strict=True):
        estimate = found[name]
        assert estimate.value < 0.96 * slope  # the secant itself is 5 to 8 % below
        assert estimate.interval95[0] < slope < estimate.interval95[1]
        assert estimate.standard_uncertainty < 0.25 * estimate.value
        assert "slip angles up to" in estimate.verdict and "model error" in estimate.verdict
