"""Other methods, for comparison: fit of the tyres, parameters of openpilot's paramsd, regression of residuals.

The regression is a sequentially thresholded least squares (STLSQ, SINDy, Brunton et al. 2016) with a library of
physical terms, applied to measured minus modelled accelerations; it is short enough not to require PySINDy.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from st_core.augmented import AugmentedModel, augment, set_effects_to_null
from st_core.batch import LogBatch
from st_core.log import DriveLog
from st_core.timeseries import filtered_derivative
from st_core.vehicle import VehicleParameters

from .cases import Case
from .drives import Drives, settings_of
from .oracle import HeldOutErrors, Oracle, Point, null_model

TYRES = ("front_stiffness", "rear_stiffness", "friction")
PARAMSD_EFFECTS = {"steering_ratio": "factor", "tyre_stiffness": "factor", "steering_offset": "angle"}
PARAMSD_SCALES = (0.05, 0.1, 0.005)
RATIO, STIFFNESS, OFFSET = (0.5, 2.0), (0.3, 3.0), (-0.1, 0.1)
"""Bounds of the fit. Those of paramsd are the same for the ratio, and 0.2 to 5 for the stiffness."""
START_INTERVAL, HORIZON, POINT_INTERVAL = 1.0, 3.0, 0.1
"""Interval of the starts, horizon, and interval of the compared yaw rates [s]."""
THRESHOLD = 0.1  # terms with a smaller contribution, in standard deviations of the residual, are removed
ITERATIONS = 10
STRIDE = 5  # samples; 20 Hz suffices after the 5 Hz low-pass filter
EQUATIONS = ("velocity_y", "yaw_rate", "acceleration_y")
TERMS = ("1", "angle", "angle rate", "slip front", "slip rear", "slip front^3", "slip rear^3", "r vx", "ay abs(ay)",
         "vx^2", "ax")
# Largest standardised term -> effects that an engineer would infer from it.
SUGGESTED_EFFECTS = {
    "1": ("steering_offset", "road_bank", "crosswind", "lateral_acceleration_bias", "heading_misalignment"),
    "angle": ("steering_ratio", "front_stiffness", "steering_compliance", "roll_steer", "mass"),
    "angle rate": ("steering_lag", "steering_delay", "tyre_relaxation", "yaw_inertia", "steering_backlash"),
    "slip front": ("front_stiffness", "steering_compliance", "roll_steer", "mass", "cg_position", "steering_ratio"),
    "slip rear": ("rear_stiffness", "cg_position", "mass"),
    "slip front^3": ("friction", "lateral_load_transfer"), "slip rear^3": ("friction", "lateral_load_transfer"),
    "r vx": ("yaw_rate_scale", "speed_scale", "mass"), "ay abs(ay)": ("lateral_load_transfer", "friction"),
    "vx^2": ("speed_scale",), "ax": ("longitudinal_load_transfer", "combined_slip"),
}


def compare_methods(case: Case, drives: Drives) -> dict[str, Any]:
    """Held-out position error after 5 s [m] for each method, and the residuals before and after the regression."""
    settings = settings_of(case)
    held_out = HeldOutErrors(drives.held_out, drives.vehicle, settings)
    tyres = Oracle(drives.suspect, drives.vehicle, TYRES, {}, settings).best
    identified = Point(null_model().with_values(fit_paramsd(drives.suspect, drives.vehicle)), tyres.gain)
    result: dict[str, Any] = {name: round(held_out.position(point), 4)
                              for name, point in (("tyres", tyres), ("paramsd", identified))}
    if case.with_vy:
        regression = Regression(drives.suspect, drives.vehicle, null_model())
        before, after = regression.normalised_mean_squares(drives.held_out)
        result["regression"] = {"names": list(regression.suggested_effects), "before": round(before, 4),
                                "after": round(after, 4)}
    return result


def fit_paramsd(runs: Sequence[DriveLog], vehicle: VehicleParameters) -> dict[str, dict[str, float]]:
    """Steering ratio, stiffness of both axles and steering offset from the yaw rate of the linear single-track model.

        minimise sum of (r measured - r of the linear model with measured steering and speed)^2

    These are the equations and the three parameters of openpilot, which estimates them with a Kalman filter; here they
    are fitted by least squares to whole drives. Source: openpilot, selfdrive/locationd/paramsd.py.
    """
    batches = [_batch(run) for run in runs]

    def residuals(x: np.ndarray) -> np.ndarray:
        model = _linear().with_values(_as_values(x))
        rows = [measured - batch.predict(model, vehicle)[:, :, 5] for batch, measured in batches]
        return np.clip(np.nan_to_num(np.concatenate(rows).ravel(), nan=1.0), -1.0, 1.0)

    low, high = zip(RATIO, STIFFNESS, OFFSET, strict=True)
    found = least_squares(residuals, [1.0, 1.0, 0.0], bounds=(low, high), x_scale=PARAMSD_SCALES, diff_step=1e-3)
    return _as_values(found.x)


def _as_values(x: np.ndarray) -> dict[str, dict[str, float]]:
    return {name: {p: float(v)} for (name, p), v in zip(PARAMSD_EFFECTS.items(), x, strict=True)}


@cache
def _linear() -> AugmentedModel:
    return set_effects_to_null(augment("linear", tuple(PARAMSD_EFFECTS)))


def _batch(log: DriveLog) -> tuple[LogBatch, np.ndarray]:
    """Predictions of a drive, and the measured yaw rates at their points (n, k) [rad/s]."""
    margin = round(0.2e9)
    starts = np.arange(log.start_ns + margin, log.end_ns - round(HORIZON * 1e9) - margin, round(START_INTERVAL * 1e9))
    points = np.round(np.arange(POINT_INTERVAL, HORIZON + POINT_INTERVAL / 2, POINT_INTERVAL), 6)
    batch = LogBatch(log, starts, HORIZON, 0.05, points=points, substeps="auto")
    measured, = batch.signals.ins_at(starts[:, None] + np.round(points * 1e9).astype(np.int64), "yaw_rate")
    return batch, measured


def make_library(car: VehicleParameters, velocities: tuple[np.ndarray, np.ndarray, np.ndarray], angle: np.ndarray,
                 angle_rate: np.ndarray, a_y: np.ndarray, a_x: np.ndarray) -> np.ndarray:
    """Values of TERMS (n, terms). velocities: v_x, v_y, yaw rate at the CG."""
    vx, vy, r = velocities
    front = (vy + car.cg_to_front_axle * r) / np.maximum(vx, 3.0) - angle
    rear = (vy - car.cg_to_rear_axle * r) / np.maximum(vx, 3.0)
    return np.stack([np.ones_like(vx), angle, angle_rate, front, rear, front**3, rear**3, r * vx, a_y * np.abs(a_y),
                     vx**2, a_x], axis=1)


def fit_sparse(library: np.ndarray, target: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """Coefficients of STLSQ: least squares without the terms below the threshold, repeated until none is below it.

    library: (n, terms), target: (n,), both standardised.
    """
    kept = np.ones(library.shape[1], bool)
    coefficients = np.zeros(library.shape[1])
    for _ in range(ITERATIONS):
        coefficients[:] = 0.0
        if not kept.any():
            break
        coefficients[kept] = np.linalg.lstsq(library[:, kept], target, rcond=None)[0]
        smaller = kept & (np.abs(coefficients) < threshold)
        if not smaller.any():
            break
        kept &= ~smaller
    return coefficients


class Regression:
    """A regression fitted to drives. coefficients: (equations, terms), per standard deviation of term and residual."""

    def __init__(self, drives: Sequence[DriveLog], vehicle: VehicleParameters, base: AugmentedModel):
        self._vehicle, self._base = vehicle, base
        library, target = self.make_rows(drives)
        self.mean, self.deviation = library.mean(axis=0), library.std(axis=0) + 1e-12
        self.deviation[0], self.mean[0] = 1.0, 0.0
        self.target_deviation = target.std(axis=0)
        self.coefficients = np.stack([fit_sparse(self._standardise(library), target[:, i] / self.target_deviation[i])
                                      for i in range(len(EQUATIONS))])

    @property
    def suggested_effects(self) -> tuple[str, ...]:
        """Effects that the term with the largest coefficient suggests; empty without terms."""
        if not self.coefficients.any():
            return ()
        return SUGGESTED_EFFECTS[TERMS[int(np.argmax(np.abs(self.coefficients).max(axis=0)))]]

    def normalised_mean_squares(self, runs: Sequence[DriveLog]) -> tuple[float, float]:
        """Mean squares of the residual accelerations of other drives before and after the regression, divided by the
        variances in the fitted drives."""
        library, target = self.make_rows(runs)
        before = target / self.target_deviation
        after = before - self._standardise(library) @ self.coefficients.T
        return float(np.mean(before**2)), float(np.mean(after**2))

    def _standardise(self, library: np.ndarray) -> np.ndarray:
        return (library - self.mean) / self.deviation

    def make_rows(self, runs: Sequence[DriveLog]) -> tuple[np.ndarray, np.ndarray]:
        parts = [self._run_rows(run) for run in runs]
        return np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])

    def _run_rows(self, log: DriveLog) -> tuple[np.ndarray, np.ndarray]:
        """(library, measured minus modelled accelerations) of one drive."""
        car = self._base.effective_vehicle(self._vehicle)
        time = log.ins_time_ns
        signals = {}
        for name in ("velocity_x", "velocity_y", "yaw_rate"):
            signals[name], signals[f"{name}_dot"] = _filter(time, getattr(log, name))
        angle = np.interp(time, log.steering_time_ns, log.road_wheel_angle)
        angle, angle_rate = _filter(time, angle)
        a_y, _ = _filter(time, log.acceleration_y)
        vx, r = signals["velocity_x"], signals["yaw_rate"]
        vy, vy_dot = (signals["velocity_y"] - r * car.cg_to_ins_x,
                      signals["velocity_y_dot"] - signals["yaw_rate_dot"] * car.cg_to_ins_x)
        p = self._base.parameters(self._vehicle)
        w = self._base.inputs(angle, signals["velocity_x_dot"], p)
        state = self._base.start_state((0.0 * vx, 0.0 * vx, vx, vy, 0.0 * vx, r), w, p)
        rates = self._base.rhs(state, w, p)
        specific_force = rates[3] + vx * rates[4] + rates[5] * car.cg_to_ins_x
        target = np.stack([vy_dot - rates[3], signals["yaw_rate_dot"] - rates[5], a_y - specific_force], axis=1)
        library = make_library(car, (vx, vy, r), angle, angle_rate, a_y, signals["velocity_x_dot"])
        inside = slice(100, -100, STRIDE)
        return library[inside], target[inside]


def _filter(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Filtered signal and its derivative, without delay."""
    return filtered_derivative(time, values, 5.0, 0.1, "zero_phase")
