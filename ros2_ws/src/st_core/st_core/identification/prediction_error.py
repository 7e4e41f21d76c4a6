"""Parameters from multi-step predictions of several drives at once: what the INS would show, minus what it showed.

From starts all over the drives a model predicts with the measured inputs. Residuals at a few points of the horizon:

    e_r = r_predicted - r,    e_v = (v_y + r d_x - gamma v_x)_predicted - v_y

yaw rate and lateral velocity at the INS, d_x its lever arm, gamma its misalignment, each divided by its own root mean
square. A prediction has forgotten the noise of its start after a few tenths of a second, so the residuals are those
of a simulation, but errors cannot pile up over a drive. Steering, tyres and INS noise enter where they act: the
estimate is not drawn towards zero by noisy slip angles as a regression of force on slip is.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from ..batch import LogBatch
from ..filtering import NANOSECOND
from ..log import INS_SIGNALS, DriveLog
from ..log_signals import LogSignals
from ..models import Model
from ..stability import StepTooLongWarning
from ..vehicle import VehicleParameters
from .blocks import Spread, blocks
from .free_parameters import DELAY, FREE, Applied, start_value
from .result import IdentificationError

APART = 1.0
"""s between two drives on the common clock, far more than any gap that is bridged."""
TUMBLED = 100.0
"""rad/s and m/s, residual of a prediction that is no longer finite."""

MOST_ROUNDS, SETTLED = 6, 0.02
"""Fits with the noise left over by the one before, and the relative change of it at which they end."""

DIFFERENCE = 1e-3
"""Step of the derivatives, in usual changes of a parameter (`FreeParameter.scale`)."""


@dataclass(frozen=True)
class PredictionErrorSettings:
    """points: of the horizon at which errors count [s], multiples of step. interval: between starts [s]. Starts are
    used when over their whole horizon the speed is at least minimum_speed [m/s] and |v_x r| at most
    maximum_acceleration [m/s^2]. step [s] is integrated in two. fewest_starts: below, the data are refused.
    """

    points: tuple[float, ...] = (0.5, 1.0, 1.5)
    interval: float = 0.5
    minimum_speed: float = 5.0
    maximum_acceleration: float = 4.0
    step: float = 0.05
    fewest_starts: int = 60
    maximum_gap: float = 0.1


@dataclass(frozen=True, eq=False)
class Fit:
    """Outcome of `PredictionError.fit`. values: of `names`, SI. jacobian: of the residuals, (m, p) and (m,), in units
    of their root mean squares `noise` (yaw rate [rad/s], lateral velocity [m/s]). run_of, time: of each residual.
    at_bound: names that stopped there.
    """

    names: tuple[str, ...]
    values: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    noise: np.ndarray
    run_of: np.ndarray
    time: np.ndarray
    at_bound: tuple[str, ...] = field(default=())

    def spread(self) -> Spread:
        """Covariance of the values over the blocks of driving, see `blocks`.

        Raises IdentificationError when the drives do not fix them.
        """
        squares = self.jacobian.T @ self.jacobian
        if np.linalg.cond(squares * np.outer(*2 * [1.0 / np.sqrt(np.diag(squares).clip(1e-300))])) > 1e12:
            raise IdentificationError(f"{', '.join(self.names)}: not fixed by the data; drive with more variety of "
                                      "speed and bends, or free fewer parameters")
        group = blocks(self.run_of, self.time)
        return group.spread(group.influence(self.jacobian, self.residuals))


class PredictionError:
    """Residuals of several drives as a function of parameters; see the module.

    names: of `free_parameters.FREE`; all others stay as in the vehicle file. base: linear or nonlinear.
    Raises IdentificationError when too few starts pass. Checked by: test_prediction_error.py.
    """

    def __init__(self, logs: Sequence[DriveLog], vehicle: VehicleParameters, names: Sequence[str],
                 base: str | Model = "nonlinear", settings: PredictionErrorSettings | None = None):
        self.settings = settings or PredictionErrorSettings()
        self.vehicle, self.names, self.base = vehicle, tuple(names), base
        self._apply = Applied(vehicle, base, names)
        delays = FREE[DELAY].bounds if DELAY in names else (0.0, 0.0)
        self._drives = drives = _Drives(logs, self.settings, delays)
        self.starts = dict(zip(drives.names, drives.used.tolist(), strict=True))
        self.considered = dict(zip(drives.names, drives.considered.tolist(), strict=True))
        total = sum(self.starts.values())
        if total < self.settings.fewest_starts:
            raise IdentificationError(
                f"too few samples: {total} of {sum(self.considered.values())} starts are faster than "
                f"{self.settings.minimum_speed:g} m/s and below {self.settings.maximum_acceleration:g} m/s^2 over "
                f"{self.settings.points[-1]:g} s; {self.settings.fewest_starts} are needed")
        self.run_of, self.time = (np.repeat(v, len(self.settings.points)) for v in (drives.run_of, drives.time))
        self._limits = np.array([FREE[n].limits(start_value(n, vehicle)) for n in names]).reshape(-1, 2)
        self.start = np.array([start_value(n, vehicle) for n in names])
        self._scale = np.array([FREE[n].step(start_value(n, vehicle)) for n in names])

    @property
    def curvature_square(self) -> float:
        """Mean of curvature^2 [1/m^2] over the residuals, weighted by lateral acceleration^2, as a stiffness is."""
        return self._drives.curvature_square()

    def residuals(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """(m, 2): yaw rate [rad/s] and lateral velocity at the INS [m/s], predicted minus measured."""
        model, car, misalignment = self._apply(values)
        return self._drives.residuals(model, car, misalignment)

    def fit(self, start: Sequence[float] | np.ndarray | None = None, noise: np.ndarray | None = None,
            fixed: Sequence[int] = (), weights: Sequence[float] | None = None) -> Fit:
        """Least squares, again and again: with the residuals at the start's parameters as noise, then with those left
        over, until these stay as they are, so that the start does not decide how yaw rate counts against velocity.

        start: values to begin at. noise: root mean squares to keep. fixed: positions in `names` that stay where they
        start. weights: how often each drive counts; once if not given.
        """
        values = np.array(self.start if start is None else start, float)
        free = np.array([i for i in range(len(self.names)) if i not in fixed], int)
        counted = np.sqrt(np.ones(len(self.starts)) if weights is None else np.asarray(weights, float))[self.run_of]
        rounds = 1 if noise is not None else MOST_ROUNDS
        noise = _size(self.residuals(values)) if noise is None else noise
        for number in range(rounds):
            solution = self._solve(values, free, noise, counted)
            values[free] = solution.x * self._scale[free]
            if number + 1 == rounds:  # also where one channel does not count: its noise is infinite
                break
            left = _size(solution.fun.reshape(-1, 2) * noise)
            if np.abs(left / noise - 1.0).max() < SETTLED:
                break
            noise = left
        lower, upper = self._limits.T
        near = 1e-3 * (upper - lower)
        bound = tuple(n for i, n in enumerate(self.names)
                      if i in free and not lower[i] + near[i] < values[i] < upper[i] - near[i])
        return Fit(self.names, values, solution.fun, solution.jac / self._scale[free], noise,
                   np.repeat(self.run_of, 2), np.repeat(self.time, 2), bound)

    def _solve(self, values: np.ndarray, free: np.ndarray, noise: np.ndarray, counted: np.ndarray) -> OptimizeResult:
        latest: dict[bytes, np.ndarray] = {}

        def weighted(x: np.ndarray) -> np.ndarray:
            key = x.tobytes()
            if key not in latest:
                trial = values.copy()
                trial[free] = x * self._scale[free]
                latest.clear()
                latest[key] = (self.residuals(trial) / noise * counted[:, None]).ravel()
            return latest[key]

        def jacobian(x: np.ndarray) -> np.ndarray:
            # Forward, by a thousandth of a usual change: a dead time is only felt from nanoseconds on.
            steps = np.where(x + DIFFERENCE <= bounds[1], DIFFERENCE, -DIFFERENCE)
            here = weighted(x)
            return np.stack([(weighted(x + step * unit) - here) / step
                             for step, unit in zip(steps, np.eye(len(x)), strict=True)], axis=1)

        start = np.clip(values[free], self._limits[free, 0], self._limits[free, 1]) / self._scale[free]
        bounds = tuple((self._limits[free] / self._scale[free, None]).T)
        inside = np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6)
        return least_squares(weighted, inside, jacobian, bounds=bounds, xtol=1e-4, ftol=1e-6, gtol=1e-8)


class _Drives:
    """All drives on one clock, apart: one batch of predictions, though no filter, interpolation or horizon reaches
    from one into the next. names, considered, used: of each drive, with its starts. run_of, time: of each start used.

    Predicted is from a regular grid of starts, which a batch does fastest, and what is of no use is left out after.
    delays: the steering must be known that much earlier and later [s], so that every fit has the same residuals.
    """

    def __init__(self, logs: Sequence[DriveLog], settings: PredictionErrorSettings, delays: tuple[float, float]):
        self.names = tuple(log.name for log in logs)
        interval = round(settings.interval / NANOSECOND)
        apart, begins = _apart(logs, interval)
        signals = LogSignals(apart, settings.maximum_gap, 5.0, "zero_phase")
        starts = np.arange(0, apart.end_ns, interval, dtype=np.int64)
        horizon = settings.points[-1]
        grid = _grid(0.0, horizon, settings.step)
        speed, yaw_rate, derivative = signals.ins_at(starts[:, None] + grid, "velocity_x", "yaw_rate", "velocity_x_dot")
        angle = signals.road_wheel_angle_at(starts[:, None] + _grid(-delays[1], horizon - delays[0], settings.step))
        known = np.isfinite(angle).all(axis=1) & (np.isfinite(speed) & np.isfinite(derivative)).all(axis=1)
        with np.errstate(invalid="ignore"):
            self._good = known & ((speed >= settings.minimum_speed) & (
                np.abs(speed * yaw_rate) <= settings.maximum_acceleration)).all(axis=1)
        run_of = np.searchsorted(begins, starts, side="right") - 1
        self.considered = np.bincount(run_of[known], minlength=len(logs))
        self.run_of = run_of[self._good]
        self.used = np.bincount(self.run_of, minlength=len(logs))
        self.time = (starts[self._good] - begins[self.run_of]) * NANOSECOND
        self._batch = LogBatch(signals, starts, horizon, settings.step, points=settings.points, substeps=2)
        points = np.round(np.asarray(settings.points) / NANOSECOND).astype(np.int64)
        self._yaw_rate, self._across, self._speed = signals.ins_at(
            starts[self._good, None] + points, "yaw_rate", "velocity_y", "velocity_x")

    def curvature_square(self) -> float:
        weights = np.square(self._speed * self._yaw_rate)
        return float(np.average(np.square(self._yaw_rate / self._speed), weights=weights))

    def residuals(self, model: Model, car: VehicleParameters, misalignment: float) -> np.ndarray:
        with warnings.catch_warnings():
            # Of slow starts, which are not used.
            warnings.simplefilter("ignore", StepTooLongWarning)
            predicted = self._batch.predict(model, car)
        yaw_rate, velocity_y = predicted.yaw_rate[self._good], predicted.velocity_y[self._good]
        across = velocity_y + yaw_rate * car.cg_to_ins_x - misalignment * self._speed
        both = np.stack([yaw_rate - self._yaw_rate, across - self._across], axis=-1).reshape(-1, 2)
        # Values so far off that the car tumbles are the worst of all, not unknown.
        return np.where(np.isfinite(both), both, TUMBLED)


def _apart(logs: Sequence[DriveLog], grid_ns: int) -> tuple[DriveLog, np.ndarray]:
    """(all drives in one log, at least APART seconds between them; where each begins [ns], on a grid)."""
    begins, now = [], 0
    for log in logs:
        begins.append(now)
        length = log.end_ns - log.start_ns + round(APART / NANOSECOND)
        now += -(-length // grid_ns) * grid_ns
    shifts = [begin - log.start_ns for begin, log in zip(begins, logs, strict=True)]

    def together(name: str) -> np.ndarray:
        return np.concatenate([getattr(log, name) for log in logs])

    times = {name: np.concatenate([getattr(log, name) + shift for log, shift in zip(logs, shifts, strict=True)])
             for name in ("ins_time_ns", "steering_time_ns")}
    return (DriveLog("all drives", **times, **{n: together(n) for n in (*INS_SIGNALS, "road_wheel_angle")}),
            np.array(begins, np.int64))


def _grid(begin: float, end: float, step: float) -> np.ndarray:
    return np.round(np.arange(begin, end + 0.5 * step, step) / NANOSECOND).astype(np.int64)


def _size(residuals: np.ndarray) -> np.ndarray:
    return np.maximum(np.sqrt(np.square(residuals).mean(axis=0)), 1e-9)
