"""Profile likelihood of a fit: how much worse the predictions become when one parameter is held beside its estimate."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from .prediction_error import Fit, PredictionError

LIMIT = float(chi2.ppf(0.95, 1))
"""Rise of the deviance at the ends of a 95 % interval: 3.84."""


@dataclass(frozen=True, eq=False)
class Profile:
    """values (n,) of one parameter, and deviance (n,): 2 (log likelihood at the estimate minus there), all other
    parameters fitted anew. interval95: where it crosses 3.84, infinite where it does not within the values.
    """

    parameter: str
    values: np.ndarray
    deviance: np.ndarray
    interval95: tuple[float, float]


def profile(problem: PredictionError, fit: Fit, parameter: str, uncertainty: float, span: float = 3.0,
            points: int = 3) -> Profile:
    """Profile of one parameter from `points` values on each side, up to `span` uncertainties away.

    Residuals of neighbouring predictions go together, so they count as fewer than there are: the sum of squares is
    divided by what makes its curvature at the estimate that of the bootstrap, 1 / uncertainty^2. What the profile
    then adds is its shape: lopsided, or flat where the data cannot tell.
    """
    index = fit.names.index(parameter)
    value = fit.values[index]
    offsets = np.linspace(0.0, span, points + 1)[1:] * uncertainty
    least = float(fit.residuals @ fit.residuals)
    sides = []
    for side in (-1.0, 1.0):
        start, found = fit.values.copy(), []
        for offset in side * offsets:
            start[index] = value + offset
            there = problem.fit(start, fit.noise, fixed=(index,))
            start = there.values.copy()
            found.append((value + offset, float(there.residuals @ there.residuals) - least))
        sides.append(found)
    at, rise = (np.array(row) for row in zip(*sides[0][::-1], (value, 0.0), *sides[1], strict=True))
    curvature = float(np.linalg.lstsq((at - value)[:, None] ** 2, rise, rcond=None)[0][0])
    deviance = rise / max(curvature, 1e-300) / uncertainty**2
    return Profile(parameter, at, deviance, _interval(at, deviance, points))


def _interval(at: np.ndarray, deviance: np.ndarray, middle: int) -> tuple[float, float]:
    ends = []
    for part in (slice(middle, None, -1), slice(middle, None)):
        values, heights = at[part], np.maximum.accumulate(deviance[part])
        ends.append(float(np.interp(LIMIT, heights, values)) if heights[-1] >= LIMIT
                    else float(np.copysign(np.inf, values[-1] - values[0])))
    return ends[0], ends[1]
