"""Methods for a band: the calibrated one, parametric alternatives, and these scaled to the same coverage."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats
from st_core.bands import Band, ErrorSamples
from st_core.bands.scale import Scale, evenly_spaced, features

LEVELS = (0.5, 0.9)
SEED = 21

ModelMode = tuple[str, str]
Way = Callable[[Band, Sequence[ErrorSamples], ModelMode], Band]
"""Band from the calibrated one, the scale of which the alternatives share, and from the calibration runs."""


def normal(band: Band, runs: Sequence[ErrorSamples], question: ModelMode, by_condition: bool = True,
           heavy: bool = False) -> Band:
    """A normal (or Student t) process: the quantile of the largest of its points and axes, by drawing from it.

    Its covariance is that of the errors divided by their scale, all windows of all runs together; nothing is held out
    and nothing calibrated. Degrees of freedom: maximum likelihood at single points.
    """
    scale = band.scale if by_condition else _same_everywhere(band.scale, runs, question)
    picked = [evenly_spaced(len(one.conditions), 100) for one in runs]
    z = np.concatenate([one.errors[question][rows] / scale(one.conditions[rows])
                        for one, rows in zip(runs, picked, strict=True)])
    points = z[:, 4::5].reshape(len(z), -1)
    generator = np.random.default_rng(SEED)
    drawn = generator.multivariate_normal(np.zeros(points.shape[1]), np.cov(points.T) + 1e-9 * np.eye(points.shape[1]),
                                          4000, method="eigh")
    marginal = stats.norm(scale=points.std())
    if heavy:
        sample = generator.choice(points.ravel(), 5000)
        freedom = max(2.5, stats.t.fit(sample, floc=0.0)[0])
        # The same covariance, heavier tails.
        drawn *= np.sqrt((freedom - 2.0) / generator.chisquare(freedom, (len(drawn), 1)))
        marginal = stats.t(freedom, scale=points.std() * np.sqrt((freedom - 2.0) / freedom))
    highest = np.abs(drawn).max(axis=1)
    ratios = np.tile(marginal.ppf(0.5 + 0.5 * 0.05 * np.arange(1, 20)), (3, 1))
    return Band(scale, {level: float(np.quantile(highest, level)) for level in LEVELS}, ratios)


def scaled(band: Band, runs: Sequence[ErrorSamples], question: ModelMode) -> Band:
    """The band with factors for exactly the stated coverage on the calibration runs, with equal weights, which compares
    the shapes at equal coverage."""
    parts = [np.quantile(band.scores(one.conditions, one.errors[question]).max(axis=1), np.linspace(0.0, 1.0, 201))
             for one in runs]
    return replace(band, factors={level: float(np.quantile(np.concatenate(parts), level)) for level in LEVELS})


def _same_everywhere(scale: Scale, runs: Sequence[ErrorSamples], question: ModelMode) -> Scale:
    """Root mean square at each knot, the same for all conditions."""
    time = scale.time
    squares = np.mean([np.square(one.errors[question].astype(float)).mean(axis=0) for one in runs], axis=0)
    near = [int(np.abs(time - knot).argmin()) for knot in scale.knots]
    coefficients = np.zeros((3, len(near), features(np.zeros((1, 4))).shape[1]))
    coefficients[:, :, 0] = 0.5 * np.log(squares[near].T)
    return Scale(coefficients, scale.floor, time, scale.knots)


def _everywhere(band: Band, runs: Sequence[ErrorSamples], question: ModelMode) -> Band:
    return normal(band, runs, question, by_condition=False)


WAYS: dict[str, Way] = {
    "conformal": lambda band, runs, question: band,
    "normal by condition": normal,
    "Student t by condition": lambda band, runs, question: normal(band, runs, question, heavy=True),
    "normal, same everywhere": _everywhere,
    "by condition, scaled to its level": scaled,
    "same everywhere, scaled to its level": lambda band, runs, question: scaled(
        _everywhere(band, runs, question), runs, question),
}
