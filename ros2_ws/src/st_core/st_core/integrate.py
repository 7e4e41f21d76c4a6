"""Classical Runge-Kutta integration (RK4) with a fixed step, and the conditions under which the step is stable.

A state is a tuple of floats or of arrays of equal shape. `derivative(state, w, p)` returns the time derivative of the
state for the inputs w at one instant and constants p.

The lateral dynamics of a car become stiffer at lower speed, because their damping is proportional to C / (m v), down to
minimum_slip_speed. RK4 with step h and stability function R does not amplify a mode of eigenvalue s if |R(h s)| <= 1;
otherwise a prediction oscillates, diverges or converges to a wrong value.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .models import Model, get_model
from .vehicle import VEHICLE_QUANTITIES, VehicleParameters

Derivative = Callable[[tuple, Any, Any], tuple]
MAX_SUBSTEPS = 64
SLIP_SPEED_LIMIT = VEHICLE_QUANTITIES["minimum_slip_speed"].maximum  # m/s
SEARCH_START_SPEED = 60.0  # m/s, where the search for the lowest stable speed begins
_INCREMENT = 1.0e-5  # m/s or rad/s, increment of the difference quotients
_issued_warnings: set[tuple[str, str, float]] = set()


def rk4(derivative: Derivative, state: tuple, inputs: Sequence[Any], p: Any, step: float) -> list[tuple]:
    """States at 0, step, 2 step, ..., the start included: (len(inputs) - 1) / 2 steps.

    inputs: w at 0, step/2, step, ... (2 * steps + 1). step > 0. Global error O(step^4). Checked by: test_integrate.py.
    """
    advance = _rk4_step_six_states if len(state) == 6 else rk4_step
    states = [state]
    for k in range(0, len(inputs) - 2, 2):
        state = advance(derivative, state, inputs[k], inputs[k + 1], inputs[k + 2], p, step)
        states.append(state)
    return states


def rk4_step(derivative: Derivative, state: tuple, w_start: Any, w_middle: Any, w_end: Any, p: Any, step: Any) -> tuple:
    """The state after one step, for any number of states; w at the start, middle and end of the step."""
    half, sixth = 0.5 * step, step / 6.0
    a = derivative(state, w_start, p)
    b = derivative(tuple([s + half * d for s, d in zip(state, a, strict=True)]), w_middle, p)
    c = derivative(tuple([s + half * d for s, d in zip(state, b, strict=True)]), w_middle, p)
    d = derivative(tuple([s + step * d for s, d in zip(state, c, strict=True)]), w_end, p)
    return tuple([s + sixth * (i + 2.0 * (j + k) + m) for s, i, j, k, m in zip(state, a, b, c, d, strict=True)])


def _rk4_step_six_states(derivative: Derivative, state: tuple, w_start: Any, w_middle: Any, w_end: Any, p: Any,
                         step: float) -> tuple:
    # rk4_step written out for six states: 1.3 to 3 times as fast with floats, for the live predictor without numba.
    half, sixth = 0.5 * step, step / 6.0
    s0, s1, s2, s3, s4, s5 = state
    a0, a1, a2, a3, a4, a5 = derivative(state, w_start, p)
    b0, b1, b2, b3, b4, b5 = derivative(
        (s0 + half * a0, s1 + half * a1, s2 + half * a2, s3 + half * a3, s4 + half * a4, s5 + half * a5), w_middle, p)
    c0, c1, c2, c3, c4, c5 = derivative(
        (s0 + half * b0, s1 + half * b1, s2 + half * b2, s3 + half * b3, s4 + half * b4, s5 + half * b5), w_middle, p)
    d0, d1, d2, d3, d4, d5 = derivative(
        (s0 + step * c0, s1 + step * c1, s2 + step * c2, s3 + step * c3, s4 + step * c4, s5 + step * c5), w_end, p)
    return (s0 + sixth * (a0 + 2.0 * (b0 + c0) + d0), s1 + sixth * (a1 + 2.0 * (b1 + c1) + d1),
            s2 + sixth * (a2 + 2.0 * (b2 + c2) + d2), s3 + sixth * (a3 + 2.0 * (b3 + c3) + d3),
            s4 + sixth * (a4 + 2.0 * (b4 + c4) + d4), s5 + sixth * (a5 + 2.0 * (b5 + c5) + d5))


class StepTooLongWarning(UserWarning):
    """The integration step is unstable at a speed of the drive."""


def lateral_modes(model: str | Model, vehicle: VehicleParameters, speed: float) -> np.ndarray:
    """Eigenvalues [1/s] of velocity_y, yaw_rate and the extra states in straight driving at a speed [m/s], by central
    differences of the equations. Checked by: test_stability.py, against handling.linear_system."""
    model = get_model(model)
    p = model.parameters(vehicle)
    w = model.inputs(0.0, 0.0, p, *(0.0 for _ in model.signals))
    state = [float(s) for s in model.start_state((0.0, 0.0, float(speed), 0.0, 0.0, 0.0), w, p)]
    rows = [3, 5, *range(6, len(state))]  # velocity_y, yaw_rate and the extra states

    def derivative(row: int, increment: float) -> np.ndarray:
        changed = list(state)
        changed[row] += increment
        return np.array(model.rhs(tuple(changed), w, p), float)[rows]

    jacobian = [(derivative(row, _INCREMENT) - derivative(row, -_INCREMENT)) / (2.0 * _INCREMENT) for row in rows]
    return np.linalg.eigvals(np.array(jacobian).T)


def growth_factor(model: str | Model, vehicle: VehicleParameters, speed: float, step: float) -> float:
    """Largest growth factor per RK4 step [1] of the physically damped modes; 0 if there are none. Stable if <= 1.

        |1 + z + z^2/2 + z^3/6 + z^4/24|,  z = step * eigenvalue, real part of the eigenvalue < 0
    """
    modes = lateral_modes(model, vehicle, speed)
    z = step * modes[modes.real < -1.0e-9]
    return float(np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))).max(initial=0.0))


def lowest_stable_speed(model: str | Model, vehicle: VehicleParameters, step: float) -> float:
    """The speed [m/s] above which a step [s] is stable; 0 if below 0.05 m/s, inf if unstable at SEARCH_START_SPEED.
    With a low minimum_slip_speed, steps of 50 ms need 2.66 m/s for the Leaf and 3.98 m/s for the Genesis."""
    from scipy.optimize import brentq  # imported here: nodes do not need scipy

    def compute_excess(speed: float) -> float:
        return growth_factor(model, vehicle, speed, step) - 1.0

    speeds = np.geomspace(SEARCH_START_SPEED, 0.05, 200)
    index = next((k for k, v in enumerate(speeds) if compute_excess(v) > 0.0), None)
    if not index:
        return 0.0 if index is None else np.inf
    return float(brentq(compute_excess, speeds[index], speeds[index - 1], xtol=1e-6))


def are_stable(models: Sequence[str | Model], vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> bool:
    """Whether a step [s] is stable for all models at all speeds [m/s]."""
    return all(growth_factor(model, vehicle, v, step) <= 1.0 for v in speeds for model in models)


def required_substeps(model: str | Model, vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> int:
    """Number of substeps of a step [s] for stability at all speeds [m/s]; MAX_SUBSTEPS if more would be needed."""
    speeds = list(speeds)
    return next((count for count in range(1, MAX_SUBSTEPS) if are_stable([model], vehicle, speeds, step / count)),
                MAX_SUBSTEPS)


def required_slip_speed(models: Sequence[str | Model], vehicle: VehicleParameters, speeds: Iterable[float],
                        step: float) -> float | None:
    """Smallest minimum_slip_speed [m/s] for stability at all speeds [m/s]: a multiple of 0.1, at least the vehicle's.

    It exceeds `lowest_stable_speed`: below minimum_slip_speed the damping is constant, but the coupling v r of the two
    modes decreases, which makes one of them faster. None if no permitted value suffices, for example because the states
    of tyre relaxation are stiff at high speed.
    """
    speeds, models = sorted(speeds), [get_model(model) for model in models]
    speeds = speeds[-1:] + speeds  # a step is usually unstable at the highest speed or at the lowest speeds, if at all
    candidates = np.arange(math.ceil(10.0 * vehicle.minimum_slip_speed), 10.0 * SLIP_SPEED_LIMIT + 1.0) / 10.0
    return next((v for v in candidates.tolist()
                 if are_stable(models, replace(vehicle, minimum_slip_speed=v), speeds, step)), None)


def warn_if_step_too_long(model: str | Model, vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> None:
    """Issue StepTooLongWarning, once per model, car and step, if a step [s] is unstable at one of the speeds [m/s]."""
    model = get_model(model)
    key = (model.name, vehicle.name, step)
    if key in _issued_warnings:
        return
    factors = {float(v): growth_factor(model, vehicle, v, step) for v in speeds}
    worst = max(factors, key=factors.__getitem__, default=None)
    if worst is None or factors[worst] <= 1.0:
        return
    _issued_warnings.add(key)
    needed = required_slip_speed([model], vehicle, factors, step)
    slip_speed = f"a minimum_slip_speed of {needed:g} m/s in the vehicle file, or " if needed else ""
    warnings.warn(
        f"{model.name} model of {vehicle.name}: integration steps of {step * 1e3:g} ms are too long at {worst:.2f} m/s,"
        f" so the predicted lateral motion is wrong; use {slip_speed}"
        f"substeps={required_substeps(model, vehicle, factors, step)}", StepTooLongWarning, stacklevel=3)
