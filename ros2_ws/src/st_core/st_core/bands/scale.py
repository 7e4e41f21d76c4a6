"""Scale of the errors: their typical magnitude as a function of the conditions at the start and of the time ahead.

    s_a(t | z)^2 = sigma_a(t | z)^2 + floor_a(t)^2,     floor_a(t)^2 = (NOISE_FACTOR n_a)^2 + (FLOOR_RATIO e_a t/T)^2
    log sigma_a(t_k | z) = phi(z) . C[a, k],     linear in log t between the knots t_k

a: along, across [m] or yaw [rad]; phi: `compute_features` of the conditions z. C is the penalised maximum likelihood
estimate for normal errors of mean 0, and also measures the scale of other distributions; runs have equal weights:

    minimise over C[a, k]   mean_w( log sigma + e^2 / (2 sigma^2) ) + RIDGE |C[a, k, 1:]|^2          (convex in C)

n_a and e_a are root mean square errors at the first point, which are due to sensor noise, and at the end of the horizon
T. The floor limits the scores of runs with noisier sensors, and of conditions with few and small errors.
Checked by: test_bands.py, test_bands_live.py.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import StCoreError
from ..log import LogSignals
from ..log_evaluation import LATERAL_ACCELERATION_EDGES, SPEED_EDGES, STEERING_RATE_EDGES
from ..timeseries import NANOSECOND

CONDITIONS = ("speed", "lateral_acceleration", "forward_acceleration", "steering_activity")
"""Conditions at the start of a prediction, which are known in advance: |v_x|, |v_x r|, |velocity_x_dot|, and the root
mean square of d(delta)/dt over the ACTIVITY_SPAN before the start. Velocity, yaw rate and acceleration are those of the
INS point; delta is the road wheel angle."""
UNITS = {"speed": "m/s", "lateral_acceleration": "m/s^2", "forward_acceleration": "m/s^2", "steering_activity": "rad/s"}
ACTIVITY_SPAN = 1.0  # s; about the duration of a steering correction; the live predictor stores two seconds
ACTIVITY_STEP = 0.05  # s; a step of 0.1 deg of the steering wheel, ratio 16, appears as a rate of 0.002 rad/s
_INSTANTS_NS = np.round(np.arange(-ACTIVITY_SPAN, 0.5 * ACTIVITY_STEP, ACTIVITY_STEP) / NANOSECOND).astype(np.int64)
MIN_STARTS = 10  # minimum number of starts of a run in a cell of speed and lateral acceleration; 1 s at 10 starts/s
MIN_RUNS_IN_CELL = 2  # minimum number of runs with MIN_STARTS; one run does not show the variation between runs
EDGES = {"speed": SPEED_EDGES, "lateral_acceleration": LATERAL_ACCELERATION_EDGES,
         "steering_activity": STEERING_RATE_EDGES}  # bin edges; the bins of speed and a_y define the cells
KNOTS = (0.1, 0.5, 1.0, 2.0, 3.5, 5.0)  # s ahead for a horizon of 5 s; proportional for other horizons
NOISE_FACTOR = 3.0  # ratio of the constant part of the floor to the RMS error at the first point
FLOOR_RATIO = 0.2  # ratio of the floor's part proportional to time to the RMS error, at the end of the horizon
ERROR_RESOLUTION = np.array([1.0e-3, 1.0e-3, 1.0e-4])  # m, m, rad; lower limit of the errors in the fit
RIDGE = 1.0e-2  # weight of the penalty in the loss; the constant term is not penalised
MAX_LOG_SCALE = 30.0  # limit of |log sigma|; exp of it is finite and far above any prediction error
MAX_NEWTON_STEPS, MAX_HALVINGS = 100, 20  # Newton steps of a fit, halvings of a step that does not reduce the loss
TOLERANCE = 1.0e-3  # maximum derivative at convergence, i.e. relative error of the mean squared errors
MAX_FIT_STARTS = 100  # maximum number of starts of a run in the fit; neighbouring starts are redundant
SPLINE_KNOTS = (1.5, 3.0, 4.5, 6.0, 7.5)  # m/s^2 of lateral acceleration; quadratic terms cannot fit tyre saturation
SPLINE_KNOT_SPACING = 1.5  # m/s^2

# Of each condition in its unit: minimum, offset and divisor in the logarithm (`compute_features`).
_FLOORS, _OFFSETS, _DIVISORS = (0.1, 0.0, 0.0, 0.0), (0.0, 0.3, 0.2, 0.005), (10.0, 1.5, 0.6, 0.02)
_PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))


def activity_instants(start_ns: int | np.ndarray) -> np.ndarray:
    """Instants (..., 21) [ns] of the road wheel angles that `steering_activity` uses, for starts (...) [ns]."""
    return np.asarray(start_ns, np.int64)[..., None] + _INSTANTS_NS


def steering_activity(angle: np.ndarray) -> np.ndarray:
    """RMS steering rate [rad/s] of road wheel angles (..., 21) [rad] at `activity_instants`; NaN if one is NaN."""
    rates = (angle[..., 1:] - angle[..., :-1]) / ACTIVITY_STEP
    return np.sqrt((rates * rates).mean(axis=-1))


def compute_conditions(velocity_x: float | np.ndarray, yaw_rate: float | np.ndarray,
                       velocity_x_dot: float | np.ndarray, activity: float | np.ndarray) -> np.ndarray:
    """Conditions (..., 4), columns as CONDITIONS, from velocity_x [m/s], yaw_rate [rad/s] and velocity_x_dot [m/s^2] at
    the INS point, and `steering_activity` [rad/s]."""
    magnitudes = compute_magnitudes(velocity_x, yaw_rate, velocity_x_dot, activity)
    return np.stack(np.broadcast_arrays(*magnitudes), axis=-1).astype(float)


def compute_magnitudes(velocity_x: Any, yaw_rate: Any, velocity_x_dot: Any, activity: Any) -> tuple[Any, ...]:
    """The four conditions as separate arrays, or as floats, which take far less time for one start."""
    return abs(velocity_x), abs(velocity_x * yaw_rate), abs(velocity_x_dot), abs(activity)


def conditions_at(signals: LogSignals, starts_ns: np.ndarray) -> np.ndarray:
    """Conditions (n, 4), columns as CONDITIONS, at starts (n,) [ns] of a recorded drive; NaN where unknown."""
    speed, yaw_rate, acceleration = signals.ins_at(starts_ns, "velocity_x", "yaw_rate", "velocity_x_dot")
    activity = steering_activity(signals.road_wheel_angle_at(activity_instants(starts_ns)))
    return compute_conditions(speed, yaw_rate, acceleration, activity)


def find_cells(conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of conditions (n, 4): indices (n,) of the bins of speed, and of lateral acceleration."""
    return find_bins(conditions, "speed"), find_bins(conditions, "lateral_acceleration")


def find_bins(conditions: np.ndarray, name: str) -> np.ndarray:
    """Indices (n,) of the bins of one of the conditions (n, 4); see EDGES."""
    return np.searchsorted(EDGES[name], conditions[:, CONDITIONS.index(name)], side="right") - 1


@dataclass(frozen=True, eq=False)
class CalibrationDomain:
    """Conditions with enough calibration runs: cells of speed and lateral acceleration, and two upper limits."""

    starts: np.ndarray  # count by (speed, lateral acceleration); 0 if fewer than MIN_RUNS_IN_CELL runs have MIN_STARTS
    upper_limits: tuple[float, float]  # forward_acceleration [m/s^2], steering_activity [rad/s]

    @classmethod
    def from_runs(cls, conditions: Sequence[np.ndarray]) -> "CalibrationDomain":
        """The domain of conditions (n, 4), one array for each run."""
        starts = np.zeros((len(conditions), len(SPEED_EDGES), len(LATERAL_ACCELERATION_EDGES)), int)
        for run, counts in zip(conditions, starts, strict=True):
            np.add.at(counts, find_cells(run), 1)
        has_enough_runs = (starts >= MIN_STARTS).sum(axis=0) >= MIN_RUNS_IN_CELL
        rows = np.concatenate(conditions)
        return cls(np.where(has_enough_runs, starts.sum(axis=0), 0), (float(rows[:, 2].max()), float(rows[:, 3].max())))

    def contains(self, conditions: np.ndarray) -> np.ndarray:
        """(n,) bool: whether conditions (n, 4) are in the domain; False where one is NaN."""
        known = np.isfinite(conditions).all(axis=1)
        rows = np.where(known[:, None], conditions, 0.0)
        return known & (self.starts[find_cells(rows)] > 0) & (rows[:, 2:] <= self.upper_limits).all(axis=1)

    def describe_outside(self, condition: Sequence[float]) -> str:
        """One-line reason why four conditions are outside the domain; empty if they are inside."""
        if self.contains(np.array([condition], float))[0]:
            return ""
        for name, value in zip(CONDITIONS, condition, strict=True):
            if not np.isfinite(value):
                return f"{name.replace('_', ' ')} is unknown"
        for name, value, limit in zip(CONDITIONS[2:], condition[2:], self.upper_limits, strict=True):
            if value > limit:
                text = name.replace("_", " ").replace("forward acceleration", "|forward acceleration|")
                return f"{text} {value:.3g} {UNITS[name]} exceeds the calibrated limit {limit:.3g}"
        return (f"{condition[0]:.1f} m/s with {condition[1]:.1f} m/s^2 lateral acceleration: fewer than "
                f"{MIN_RUNS_IN_CELL} calibration runs have {MIN_STARTS} predictions in this range")


def compute_features(conditions: np.ndarray) -> np.ndarray:
    """Features phi (..., 20), of magnitude about 1, of the conditions (..., 4) in CONDITIONS.

    1; the four logarithms  log(v / 10 m/s),  log((a_y + 0.3 m/s^2) / 1.5 m/s^2),  log((a_x + 0.2 m/s^2) / 0.6 m/s^2),
    log((w + 0.005 rad/s) / 0.02 rad/s), w: steering activity, v >= 0.1 m/s; their squares and products;
    triangular functions of a_y, 3 m/s^2 wide, centred at SPLINE_KNOTS.
    """
    columns = compute_scalar_features(np.moveaxis(np.asarray(conditions, float), -1, 0), np.log, np.maximum)
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def compute_scalar_features(condition: Sequence[Any] | np.ndarray, log: Callable[[Any], Any] = math.log,
                            maximum: Callable[[Any, Any], Any] = max) -> list[Any]:
    """The 20 features (`compute_features`) of four conditions as a list; takes a tenth of the time for floats.

    log, maximum: functions for conditions of other types, such as CasADi symbols or arrays.
    """
    logs = [log((maximum(value, floor) + offset) / divisor)
            for value, floor, offset, divisor in zip(condition, _FLOORS, _OFFSETS, _DIVISORS, strict=True)]
    splines = [maximum(0.0, 1.0 - abs(condition[1] - knot) / SPLINE_KNOT_SPACING) for knot in SPLINE_KNOTS]
    return [1.0, *logs, *(logs[k] * logs[m] for k, m in _PAIRS), *splines]


def make_knots(horizon: float) -> np.ndarray:
    """KNOTS scaled to a horizon [s]."""
    return np.array(KNOTS) * (horizon / KNOTS[-1])


@dataclass(frozen=True, eq=False)
class Scale:
    """Scale s of the errors, fitted by `fit_scale`."""

    coefficients: np.ndarray  # C (3, knots, features)
    floor: np.ndarray  # (2, 3), NOISE_FACTOR n and, at the end of the horizon, FLOOR_RATIO e [m, m, rad]
    time: np.ndarray  # (points,) ahead [s, > 0]

    @cached_property
    def interpolation(self) -> np.ndarray:
        """Matrix (points, knots) for interpolation from knots to times ahead: linear in log t, constant outside."""
        log_time, log_knots = np.log(self.time), np.log(make_knots(float(self.time[-1])))
        return np.stack([np.interp(log_time, log_knots, row) for row in np.eye(len(KNOTS))], axis=-1)

    @property
    def floors(self) -> np.ndarray:
        """Floor (points, 3) [m, m, rad] at the times ahead."""
        return np.hypot(self.floor[0], self.floor[1] * (self.time / self.time[-1])[:, None])

    def __call__(self, conditions: np.ndarray) -> np.ndarray:
        """s (n, points, 3) [m, m, rad] under conditions (n, 4)."""
        phi = compute_features(conditions)
        logs = phi @ self.coefficients.reshape(-1, phi.shape[-1]).T  # (n, 3 * knots)
        logs = logs.reshape(len(phi), *self.coefficients.shape[:2]).transpose(0, 2, 1)
        sigma = np.exp(np.clip(self.interpolation @ logs, -MAX_LOG_SCALE, MAX_LOG_SCALE))
        return np.hypot(sigma, self.floors)


def fit_scale(conditions: Sequence[np.ndarray], errors: Sequence[np.ndarray], time: np.ndarray) -> Scale:
    """Scale of the errors of several runs. Raises StCoreError if the fit fails.

    conditions, errors: (n, 4) and (n, points, 3) for each run. time: (points,) ahead [s].
    """
    knots = make_knots(float(time[-1]))
    selected = [select_evenly(len(run)) for run in conditions]
    phi = np.concatenate([compute_features(run[rows]) for run, rows in zip(conditions, selected, strict=True)])
    weights = np.concatenate([np.full(len(rows), 1.0 / (len(rows) * len(selected))) for rows in selected])
    squares = [np.maximum(np.square(run[rows].astype(float)), np.square(ERROR_RESOLUTION))
               for run, rows in zip(errors, selected, strict=True)]
    first, last = np.sqrt(np.mean([run[:, [0, -1]].mean(axis=0) for run in squares], axis=0))
    floor = np.stack([NOISE_FACTOR * first, FLOOR_RATIO * last])
    nearest = [int(np.abs(time - knot).argmin()) for knot in knots]
    targets = np.concatenate([run[:, nearest] for run in squares]).reshape(len(phi), -1)  # (n, knots * 3)
    c = _fit_gamma_regression(phi, weights, targets)
    return Scale(c.reshape(phi.shape[1], len(knots), 3).transpose(2, 1, 0), floor, np.asarray(time, float))


def _fit_gamma_regression(phi: np.ndarray, weights: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """C (features, m) that minimises the loss of the squares (n, m): gamma regression with log link, by Newton steps. A
    hundredth of the expected Hessian is added to the actual Hessian, which vanishes where sigma is too large."""
    ridge = np.full((phi.shape[1], 1), RIDGE)
    ridge[0] = 0.0
    regularisation = 0.02 * phi.T @ (weights[:, None] * phi) + 2.0 * np.diag(ridge[:, 0]) + 1.0e-9 * np.eye(len(ridge))

    def evaluate_loss(c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(loss (m,), its derivative (features, m), e^2 / sigma^2 (n, m))."""
        eta = phi @ c
        ratio = squares * np.exp(-2.0 * np.clip(eta, -MAX_LOG_SCALE, MAX_LOG_SCALE))
        return (weights @ (eta + 0.5 * ratio) + (ridge * c * c).sum(axis=0),
                phi.T @ (weights[:, None] * (1.0 - ratio)) + 2.0 * ridge * c, ratio)

    c = np.zeros((phi.shape[1], squares.shape[1]))
    c[0] = 0.5 * np.log(weights @ squares)  # log of the root mean square error of all starts
    value, slope, ratio = evaluate_loss(c)
    for _ in range(MAX_NEWTON_STEPS):
        if np.abs(slope).max() < TOLERANCE:
            return c
        hessian = np.stack([phi.T @ ((2.0 * weights * column)[:, None] * phi) for column in ratio.T]) + regularisation
        step, fraction = np.linalg.solve(hessian, slope.T[:, :, None])[:, :, 0].T, np.ones(c.shape[1])
        for _ in range(MAX_HALVINGS):
            new_value, new_slope, new_ratio = evaluate_loss(c - fraction * step)
            worse = ~(new_value <= value + 1.0e-12)
            if not worse.any():
                break
            fraction = np.where(worse, 0.5 * fraction, fraction)
        c, value, slope, ratio = c - fraction * step, new_value, new_slope, new_ratio
    raise StCoreError(f"the scale of the errors cannot be fitted: no convergence after {MAX_NEWTON_STEPS} steps; look "
                      "for starts with errors that are larger by orders of magnitude")


def select_evenly(count: int, limit: int = MAX_FIT_STARTS) -> np.ndarray:
    """Indices of at most `limit` of `count` rows, evenly spaced."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).round().astype(int)
