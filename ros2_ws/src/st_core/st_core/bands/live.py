"""Bands while driving: half-widths for all models and both questions, from what is known when a prediction starts."""

from collections.abc import Iterable

import numpy as np

from ..alignment import DERIVATIVE, VELOCITY_X, YAW_RATE, MeasurementHistory
from ..log_evaluation import MODES
from .band import LEVELS
from .conditions import activity_instants, conditions, steering_activity
from .file import Bands
from .scale import features, floor_at, interpolation

Stated = dict[tuple[str, float], np.ndarray]
"""By mode and level: half-widths (points + 1, 3), float32 as in messages, along, across [m] and yaw [rad], 0 at the
start."""


def conditions_now(history: MeasurementHistory, time_ns: int) -> np.ndarray:
    """(4,) as `conditions.CONDITIONS` at an instant [ns], as `conditions_at` has them of the recorded drive; NaN where
    not known.
    """
    row = history.ins.at(time_ns)
    activity = steering_activity(history.steering.sample(activity_instants(time_ns))[:, 0])
    if row is None:
        return conditions(np.nan, np.nan, np.nan, activity)
    return conditions(row[VELOCITY_X], row[YAW_RATE], row[DERIVATIVE], activity)


class LiveBands:
    """The same half-widths as `Bands.half_widths`, of all models at once: one pass a tick instead of twelve.

    models: those that predict; each must be in the bands (see `Bands.check`). Levels: those of LEVELS that the file
    states.
    """

    def __init__(self, bands: Bands, models: Iterable[str]):
        self._seen = bands.seen
        self._questions = [(model, mode) for model in models for mode in MODES if (model, mode) in bands.bands]
        chosen = [bands.bands[question] for question in self._questions]
        self.levels = tuple(level for level in LEVELS if all(level in band.factors for band in chosen))
        knots = chosen[0].scale.knots
        self._coefficients = np.concatenate([band.scale.coefficients.reshape(-1, band.scale.coefficients.shape[-1])
                                             for band in chosen])
        self._shape = len(chosen), 3, len(knots)
        self._between = interpolation(knots, chosen[0].scale.time).T
        self._floor = np.square([floor_at(band.scale.floor, band.scale.time).T for band in chosen])
        self._factors = np.array([[band.factors[level] for level in self.levels] for band in chosen])[:, :, None, None]

    def why_not(self, condition: np.ndarray) -> str:
        """For conditions (4,) without a band: why, in one line; empty where there is one."""
        return self._seen.why_not(condition)

    def __call__(self, condition: np.ndarray) -> dict[str, Stated]:
        """By model, under conditions (4,); empty where they were never calibrated."""
        if not self._seen(condition[None])[0]:
            return {}
        logs = (self._coefficients @ features(condition)).reshape(self._shape) @ self._between
        scale = np.sqrt(np.exp(np.clip(2.0 * logs, -60.0, 60.0)) + self._floor)
        widths = np.zeros((*self._factors.shape[:2], 3, scale.shape[2] + 1), np.float32)
        np.multiply(self._factors, scale[:, None], out=widths[..., 1:], casting="same_kind")
        found: dict[str, Stated] = {}
        for (model, mode), of_question in zip(self._questions, widths, strict=True):
            stated = found.setdefault(model, {})
            for level, one in zip(self.levels, of_question, strict=True):
                stated[mode, level] = one.T
        return found
