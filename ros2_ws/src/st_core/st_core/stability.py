"""Whether the integration step is short enough for the stiffness and the speed at hand.

The lateral dynamics of a car become stiffer as it slows down: the damping goes with C / (m v). Under classical
Runge-Kutta a mode with eigenvalue s is damped as long as |R(h s)| <= 1; beyond that a prediction rings, diverges or
settles in the wrong place, although the car would not. Below minimum_slip_speed the models keep the stiffness they have
there.
"""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from .models import Model, get_model
from .vehicle import VEHICLE_QUANTITIES, VehicleParameters

MOST_SUBSTEPS = 64
HIGHEST_SLIP_SPEED = VEHICLE_QUANTITIES["minimum_slip_speed"].maximum  # m/s, that a vehicle file may hold
FASTEST = 60.0  # m/s, where the search for the lowest stable speed begins
_LATERAL = (3, 5)  # velocity_y, yaw_rate; and what states follow the six
_SMALL = 1.0e-5  # of the difference quotients [m/s, rad/s]
_said: set[tuple[str, str, float]] = set()


class StepTooLongWarning(UserWarning):
    """The integration step leaves the stability region of Runge-Kutta at a speed that occurs."""


def lateral_modes(model: str | Model, vehicle: VehicleParameters, speed: float) -> np.ndarray:
    """Eigenvalues [1/s] of velocity_y, yaw_rate and the extra states about straight driving at a speed [m/s].

    By central differences of the model's own equations. Checked by: test_stability.py, against handling.linear_system.
    """
    model = get_model(model)
    p = model.parameters(vehicle)
    w = model.inputs(0.0, 0.0, p, *(0.0 for _ in model.signals))
    state = [float(s) for s in model.start_state((0.0, 0.0, float(speed), 0.0, 0.0, 0.0), w, p)]
    rows = [*_LATERAL, *range(6, len(state))]

    def derivative(changed: int, by: float) -> np.ndarray:
        moved = list(state)
        moved[changed] += by
        return np.array(model.rhs(tuple(moved), w, p), float)[rows]

    jacobian = [(derivative(row, _SMALL) - derivative(row, -_SMALL)) / (2.0 * _SMALL) for row in rows]
    return np.linalg.eigvals(np.array(jacobian).T)


def growth(model: str | Model, vehicle: VehicleParameters, speed: float, step: float) -> float:
    """Largest factor per step [1] by which Runge-Kutta lets a mode grow that the car itself damps; <= 1: stable.

        |1 + z + z^2/2 + z^3/6 + z^4/24|,  z = step * eigenvalue, real part of the eigenvalue < 0
    """
    modes = lateral_modes(model, vehicle, speed)
    z = step * modes[modes.real < -1.0e-9]
    return float(np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))).max(initial=0.0))


def lowest_stable_speed(model: str | Model, vehicle: VehicleParameters, step: float) -> float:
    """The speed [m/s] above which steps of `step` [s] are stable; 0 when they are at all speeds, inf when at none.

    With minimum_slip_speed set low, RK4 at 50 ms needs 2.66 m/s for the Leaf and 3.98 m/s for the Genesis.
    """
    speeds = np.geomspace(FASTEST, 0.05, 200)
    unstable = [growth(model, vehicle, v, step) > 1.0 for v in speeds]
    if not any(unstable):
        return 0.0
    first = unstable.index(True)
    if first == 0:
        return np.inf
    low, high = speeds[first], speeds[first - 1]
    while high - low > 1.0e-6:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if growth(model, vehicle, middle, step) > 1.0 else (low, middle)
    return float(high)


def stable(models: Sequence[str | Model], vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> bool:
    """Whether steps of `step` [s] are short enough for all the models at all the speeds [m/s]."""
    return all(growth(model, vehicle, v, step) <= 1.0 for v in speeds for model in models)


def substeps_needed(model: str | Model, vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> int:
    """Into how many equal parts a step must be divided to be stable at all the speeds [m/s]; at most MOST_SUBSTEPS."""
    speeds = list(speeds)
    return next((count for count in range(1, MOST_SUBSTEPS) if stable([model], vehicle, speeds, step / count)),
                MOST_SUBSTEPS)


def slip_speed_needed(models: Sequence[str | Model], vehicle: VehicleParameters, speeds: Iterable[float],
                      step: float) -> float | None:
    """The minimum_slip_speed [m/s], in tenths, from which on the models are stable at all the speeds [m/s].

    It is more than `lowest_stable_speed`: a slower car keeps the damping it has there, but not the
    coupling v r of its two modes, and one of the two becomes faster. None where no value a vehicle file may hold
    helps: extra states, such as those of tyres that relax, have a stiffness of their own, at high speed.
    """
    speeds, models = sorted(speeds), [get_model(model) for model in models]

    def helps(tenths: int) -> bool:
        return stable(models, replace(vehicle, minimum_slip_speed=tenths / 10.0), speeds, step)

    first = math.ceil(10.0 * vehicle.minimum_slip_speed)
    tried = np.unique(np.geomspace(first, 10.0 * HIGHEST_SLIP_SPEED, 80).astype(int)).tolist()
    good = next((k for k, tenths in enumerate(tried) if helps(tenths)), None)
    if good is None:
        return None
    below = tried[good - 1] + 1 if good else first
    return next(tenths for tenths in range(below, tried[good] + 1) if helps(tenths)) / 10.0


def warn_if_too_long(model: str | Model, vehicle: VehicleParameters, speeds: Iterable[float], step: float) -> None:
    """StepTooLongWarning, once for a model, car and step, when a step [s] is too long at one of the speeds [m/s]."""
    model = get_model(model)
    key = (model.name, vehicle.name, step)
    if key in _said:
        return
    factors = {float(v): growth(model, vehicle, v, step) for v in speeds}
    worst = max(factors, key=factors.__getitem__, default=None)
    if worst is None or factors[worst] <= 1.0:
        return
    _said.add(key)
    needed = slip_speed_needed([model], vehicle, factors, step)
    in_the_file = f"a minimum_slip_speed of {needed:g} m/s in the vehicle file, or " if needed else ""
    warnings.warn(
        f"{model.name} model of {vehicle.name}: integration steps of {step * 1e3:g} ms are too long at {worst:.2f} m/s,"
        f" the lateral motion comes out wrong; cured by {in_the_file}"
        f"substeps={substeps_needed(model, vehicle, factors, step)}", StepTooLongWarning, stacklevel=3)
