"""Other methods, for comparison: fit of the tyres, parameters of openpilot's paramsd, regression of residuals."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from st_core.augmented import AugmentedModel, augment, set_effects_to_null
from st_core.batch import LogBatch
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

from .cases import Case
from .drives import Drives, settings_of
from .oracle import HeldOutErrors, Oracle, Point, null_model
from .regression import Regression

TYRES = ("front_stiffness", "rear_stiffness", "friction")
PARAMSD_EFFECTS = {"steering_ratio": "factor", "tyre_stiffness": "factor", "steering_offset": "angle"}
PARAMSD_SCALES = (0.05, 0.1, 0.005)
RATIO, STIFFNESS, OFFSET = (0.5, 2.0), (0.3, 3.0), (-0.1, 0.1)
"""Bounds of the fit. Those of paramsd are the same for the ratio, and 0.2 to 5 for the stiffness."""
START_INTERVAL, HORIZON, POINT_INTERVAL = 1.0, 3.0, 0.1
"""Interval of the starts, horizon, and interval of the compared yaw rates [s]."""


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
