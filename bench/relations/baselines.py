"""Other methods, for comparison with a proposal: regressions of the residual accelerations.

A sparse regression (that of `discovery.baselines`) or a Gaussian process predicts the residual accelerations. They are
added to those of the model in the simulation of the held-out drives.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from st_core.augmented import AugmentedModel
from st_core.discovery.settings import DiscoverySettings
from st_core.discovery.windows import STEP, Windows
from st_core.log import DriveLog
from st_core.types import cg_to_ins_position
from st_core.vehicle import VehicleParameters

from ..discovery.baselines import TERMS, Regression, make_library
from ..discovery.oracle import mean_distance

HORIZON = 5.0  # s
SAMPLES, SEED = 250, 5
"""Number of random samples for the Gaussian process, because its cost grows with their cube."""
FEATURES = ("angle", "slip front", "slip rear", "speed", "yaw rate", "a_x")
Residual = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(states (6, n), road wheel angle, forward acceleration) -> residual accelerations of v_y and yaw [m/s^2, rad/s^2]."""


def compare_methods(drives: Sequence[DriveLog], held_out: Sequence[DriveLog], vehicle: VehicleParameters,
                    answer: AugmentedModel, settings: DiscoverySettings) -> dict[str, Any]:
    """Held-out position error after 5 s [m] by method, and the effects or inputs that the methods suggest."""
    windows = Windows(held_out, vehicle, settings)
    regression = Regression(drives, vehicle, answer)
    process, inputs = _fit_process(regression, drives, vehicle, answer)
    return {"plain": _position_error(windows, vehicle, answer, lambda s, angle, a_x: (0.0, 0.0)),
            "regression": _position_error(windows, vehicle, answer, _regression_residual(regression, vehicle, answer)),
            "process": _position_error(windows, vehicle, answer, process),
            "regression_names": list(regression.suggested_effects), "process_names": inputs}


def _library(states: np.ndarray, angle: np.ndarray, a_x: np.ndarray, car: VehicleParameters) -> np.ndarray:
    """The terms of the regression in a simulation, where the rate of the angle is neglected."""
    vx, vy, r = states[2], states[3], states[5]
    return make_library(car, (vx, vy, r), angle, 0.0 * angle, vx * r, a_x)


def _features(library: np.ndarray) -> np.ndarray:
    """The features (n, features), from the terms of the regression."""
    terms = dict(zip(TERMS, library.T, strict=True))
    speed = np.sqrt(np.maximum(terms["vx^2"], 0.0))
    rate = terms["r vx"] / np.maximum(speed, 3.0)
    return np.stack([terms["angle"], terms["slip front"], terms["slip rear"], speed, rate, terms["ax"]], axis=1)


def _regression_residual(regression: Regression, vehicle: VehicleParameters, answer: AugmentedModel) -> Residual:
    car = answer.effective_vehicle(vehicle)
    coefficients = regression.coefficients * regression.target_deviation[:, None] / regression.deviation
    constant = -coefficients @ regression.mean

    def residual(states, angle, a_x):
        predicted = coefficients @ _library(states, angle, a_x, car).T + constant[:, None]
        return predicted[0], predicted[1]
    return residual


def _fit_process(regression: Regression, drives: Sequence[DriveLog], vehicle: VehicleParameters,
                 answer: AugmentedModel) -> tuple[Residual, list[str]]:
    """Fits a Gaussian process to each acceleration; also returns the input with the shortest length scale of each."""
    car = answer.effective_vehicle(vehicle)
    library, target = regression.make_rows(drives)
    inputs = _features(library)
    mean, size = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    chosen = np.random.default_rng(SEED).choice(len(inputs), min(SAMPLES, len(inputs)), replace=False)
    processes, relevant_inputs = [], []
    for k in (0, 1):
        kernel = RBF(np.ones(len(FEATURES)), (0.2, 1e3)) + WhiteKernel(0.5)
        process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=SEED)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # of irrelevant inputs
            process.fit((inputs[chosen] - mean) / size, target[chosen, k])
        processes.append(process)
        relevant_inputs.append(FEATURES[int(np.argmin(process.kernel_.k1.length_scale))])

    def residual(states, angle, a_x):
        features = (_features(_library(states, angle, a_x, car)) - mean) / size
        finite = np.isfinite(features).all(axis=1)
        predicted = np.zeros((2, len(features)))
        for k, process in enumerate(processes):
            predicted[k, finite] = process.predict(features[finite])
        return predicted[0], predicted[1]
    return residual, relevant_inputs


def _position_error(windows: Windows, vehicle: VehicleParameters, answer: AugmentedModel, residual: Residual) -> float:
    """Mean position error after HORIZON [m] of the model with residual accelerations, constant in each RK4 step."""
    signals = windows._batch.recording(answer).signals
    car, p = answer.effective_vehicle(vehicle), answer.parameters(vehicle)
    steps = round(HORIZON / STEP)
    times = windows.starts_ns[:, None] + np.round(np.arange(2 * steps + 1) * STEP / 2 * 1e9).astype(np.int64)
    angle, a_x = signals.road_wheel_angle_at(times), signals.ins_at(times, "velocity_x_dot")[0]
    rows = [tuple(np.broadcast_to(f, len(times)) for f in answer.inputs(angle[:, k], a_x[:, k], p))
            for k in range(2 * steps + 1)]
    state = tuple(answer.start_state(tuple(np.asarray(signals.states_at(windows.starts_ns, car)).T), rows[0], p))
    with np.errstate(all="ignore"):
        for k in range(0, 2 * steps, 2):
            lateral, yaw_acceleration = residual(np.stack(state[:6]), angle[:, k], a_x[:, k])
            state = _integrate_step(answer, state, rows[k:k + 3], p, lateral, yaw_acceleration)
        x, y = cg_to_ins_position(state[0], state[1], state[4], car.cg_to_ins_x, car.cg_to_ins_y)
        measured_x, measured_y = windows.measured_at(times[:, -1], "x", "y")
    return mean_distance(np.column_stack([x - measured_x, y - measured_y]))


def _integrate_step(model: AugmentedModel, state: tuple, w: Sequence[tuple], p, lateral, yaw_acceleration) -> tuple:
    def rates(s, row):
        f = model.rhs(s, row, p)
        return (*f[:3], f[3] + lateral, f[4], f[5] + yaw_acceleration, *f[6:])

    half = STEP / 2
    a = rates(state, w[0])
    b = rates(tuple(s + half * d for s, d in zip(state, a, strict=True)), w[1])
    c = rates(tuple(s + half * d for s, d in zip(state, b, strict=True)), w[1])
    d = rates(tuple(s + STEP * d for s, d in zip(state, c, strict=True)), w[2])
    return tuple(s + STEP / 6 * (i + 2 * j + 2 * k + m) for s, i, j, k, m in zip(state, a, b, c, d, strict=True))
