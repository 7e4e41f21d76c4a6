"""Calibration of the band of one model and question from runs: the scale of its errors, then the conformal factors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import StCoreError
from .conditions import CalibrationDomain
from .conformal import check_levels, conformal_factors, highest_level
from .samples import Question, RunSamples
from .scale import Scale, fit_scale

LEVELS = (0.5, 0.9)
RELIABILITY = tuple(round(0.05 * k, 2) for k in range(1, 20))
"""Levels for the reliability diagram, as far as the runs can promise them; and of the ratios below."""
FOLDS = 5
FEWEST_RUNS = 3
"""One to be scored, and two for a calibration domain without it."""


@dataclass(frozen=True, eq=False)
class Band:
    """Half-widths are factor times scale. factors: by level, rising with it [1]. ratios: (3, len(RELIABILITY)),
    quantiles of |error| / scale at a single point, by axis: the distribution there, for the CRPS.
    """

    scale: Scale
    factors: dict[float, float]
    ratios: np.ndarray

    def half_widths(self, conditions: np.ndarray, level: float) -> np.ndarray:
        """(n, points, 3) along, across [m] and yaw [rad], without the start, under conditions (n, 4)."""
        return self.factors[level] * self.scale(conditions)

    def scores(self, conditions: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """(n, points): the least factor with which errors (n, points, 3) lie inside at each point, in all axes."""
        return (np.abs(errors) / self.scale(conditions)).max(axis=2)


def calibrate(runs: Sequence[RunSamples], question: Question, time: np.ndarray,
              levels: Sequence[float] = LEVELS) -> Band:
    """The band of one model and question.

        band = { |e_a(t)| <= c s_a(t | z)  for all t and a },       score of a window = max over t, a of |e_a(t)| / s_a

    Scores of a run are made with a scale that was learnt without it (cross-fitting in at most FOLDS groups of runs):
    those of the runs it was learnt from would be too small. Windows under conditions the others have not seen do not
    count, as there would be no band. time: (points,) of the errors [s]. Raises StCoreError, one line, for too few runs
    for a level and for errors that are not finite.
    """
    check_levels(levels, len(runs))
    if len(runs) < FEWEST_RUNS:
        raise StCoreError(f"{len(runs)} run{'' if len(runs) == 1 else 's'}: each run is scored with bands of two "
                          f"others; give {FEWEST_RUNS} or more")
    for run in runs:
        if not np.isfinite(run.errors[question]).all():
            raise StCoreError(f"{run.name}: errors of {question[0]} are not finite; no band is made of such errors")
    scores, ratios = [], []
    for group in np.array_split(np.arange(len(runs)), min(FOLDS, len(runs))):
        others = [run for number, run in enumerate(runs) if number not in group]
        scale, seen = _scale(others, question, time), CalibrationDomain.of([run.conditions for run in others])
        for run in (runs[number] for number in group):
            rows = seen(run.conditions)
            if rows.any():
                ratio = np.abs(run.errors[question][rows]) / scale(run.conditions[rows])
                scores.append(ratio.max(axis=(1, 2)))
                # Neighbouring points are redundant.
                ratios.append(ratio[:, ::5].reshape(-1, ratio.shape[2]))
    if len(scores) < len(runs):
        try:
            check_levels(levels, len(scores))
        except StCoreError as error:
            raise StCoreError(f"{len(runs) - len(scores)} of {len(runs)} runs were driven under conditions that none "
                              f"of the others has; {error}") from None
    stated = sorted({*levels, *(level for level in RELIABILITY if level <= highest_level(len(scores)))})
    factors = dict(zip(stated, conformal_factors(scores, stated).tolist(), strict=True))
    return Band(_scale(runs, question, time), factors, _quantiles(ratios))


def _scale(runs: Sequence[RunSamples], question: Question, time: np.ndarray) -> Scale:
    return fit_scale([run.conditions for run in runs], [run.errors[question] for run in runs], time)


def _quantiles(ratios: Sequence[np.ndarray]) -> np.ndarray:
    """(3, levels), every run weighing the same: the mean of the runs' distribution functions, inverted."""
    found = []
    for axis in range(ratios[0].shape[1]):
        parts = [np.quantile(one[:, axis], np.linspace(0.0, 1.0, 201)) for one in ratios]
        found.append(np.quantile(np.concatenate(parts), RELIABILITY))
    return np.array(found)
