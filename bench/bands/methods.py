"""Bands of the benchmark: conformal, parametric, scaled to nominal coverage of the calibration runs, and random."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats
from st_core.bands import Band, Bands, CalibrationDomain, ErrorSamples, calibrate
from st_core.bands.file import hash_configuration
from st_core.bands.scale import Scale, compute_features, make_knots, select_evenly
from st_core.log_evaluation import MODES, EvaluationSettings
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters

SETTINGS = EvaluationSettings()
TIME = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
RANDOM_RUNS, RANDOM_STARTS = 12, 4000
LARGEST_CONDITIONS = (26.0, 8.0, 6.0, 1.0)  # speed, accelerations, steering activity [m/s, m/s^2, m/s^2, rad/s]
LEVELS = (0.5, 0.9)
SEED = 21

ModelMode = tuple[str, str]
Method = Callable[[Band, Sequence[ErrorSamples], ModelMode], Band]
"""Computes a band from the calibrated band, which has the same scale, and from the calibration runs."""


def parametric_band(band: Band, runs: Sequence[ErrorSamples], model_mode: ModelMode,
                    by_condition: bool = True, heavy_tails: bool = False) -> Band:
    """Band of a normal or, if `heavy_tails`, Student t process: quantiles of its maximum over all points and axes.

    The quantiles are computed from random draws. The covariance is estimated from the scaled errors of all runs
    together, without calibration on held-out runs. The degrees of freedom are the maximum-likelihood estimate for
    single points. by_condition: whether the scale depends on the conditions.
    """
    scale = band.scale if by_condition else _average_scale(band.scale, runs, model_mode)
    selections = [select_evenly(len(run.conditions), 100) for run in runs]
    z = np.concatenate([run.errors[model_mode][rows] / scale(run.conditions[rows])
                        for run, rows in zip(runs, selections, strict=True)])
    points = z[:, 4::5].reshape(len(z), -1)
    generator = np.random.default_rng(SEED)
    drawn = generator.multivariate_normal(np.zeros(points.shape[1]), np.cov(points.T) + 1e-9 * np.eye(points.shape[1]),
                                          4000, method="eigh")
    marginal = stats.norm(scale=points.std())
    if heavy_tails:
        sample = generator.choice(points.ravel(), 5000)
        degrees_of_freedom = max(2.5, stats.t.fit(sample, floc=0.0)[0])
        # The tails become heavier with the same covariance.
        drawn *= np.sqrt((degrees_of_freedom - 2.0) / generator.chisquare(degrees_of_freedom, (len(drawn), 1)))
        marginal = stats.t(degrees_of_freedom,
                           scale=points.std() * np.sqrt((degrees_of_freedom - 2.0) / degrees_of_freedom))
    highest = np.abs(drawn).max(axis=1)
    ratios = np.tile(marginal.ppf(0.5 + 0.5 * 0.05 * np.arange(1, 20)), (3, 1))
    return Band(scale, {level: float(np.quantile(highest, level)) for level in LEVELS}, ratios)


def scale_to_level(band: Band, runs: Sequence[ErrorSamples], model_mode: ModelMode) -> Band:
    """The band with factors for nominal coverage of the calibration runs, which have equal weights."""
    grid = np.linspace(0.0, 1.0, 201)
    parts = [np.quantile((np.abs(run.errors[model_mode]) / band.scale(run.conditions)).max(axis=(1, 2)), grid)
             for run in runs]
    return replace(band, factors={level: float(np.quantile(np.concatenate(parts), level)) for level in LEVELS})


def _average_scale(scale: Scale, runs: Sequence[ErrorSamples], model_mode: ModelMode) -> Scale:
    """Scale independent of the conditions: the root mean square error at each knot."""
    time = scale.time
    squares = np.mean([np.square(run.errors[model_mode].astype(float)).mean(axis=0) for run in runs], axis=0)
    rows = [int(np.abs(time - knot).argmin()) for knot in make_knots(float(time[-1]))]
    coefficients = np.zeros((3, len(rows), compute_features(np.zeros((1, 4))).shape[1]))
    coefficients[:, :, 0] = 0.5 * np.log(squares[rows].T)
    return Scale(coefficients, scale.floor, time)


def _unconditional_band(band: Band, runs: Sequence[ErrorSamples], model_mode: ModelMode) -> Band:
    return parametric_band(band, runs, model_mode, by_condition=False)


METHODS: dict[str, Method] = {
    "conformal": lambda band, runs, model_mode: band,
    "normal by condition": parametric_band,
    "Student t by condition": lambda band, runs, model_mode: parametric_band(band, runs, model_mode, heavy_tails=True),
    "normal, same everywhere": _unconditional_band,
    "by condition, scaled to nominal coverage": scale_to_level,
    "same everywhere, scaled to nominal coverage": lambda band, runs, model_mode: scale_to_level(
        _unconditional_band(band, runs, model_mode), runs, model_mode),
}


def random_bands(vehicle: VehicleParameters) -> Bands:
    """Bands calibrated with random errors under random conditions, to measure the cost of bands."""
    model_mode, runs = ("random", "hindsight"), []
    for number in range(RANDOM_RUNS):
        generator = np.random.default_rng([21, number])
        errors = (0.1 * generator.standard_normal((RANDOM_STARTS, 1, 3)) * TIME[:, None]).astype(np.float32)
        runs.append(ErrorSamples(f"run {number}", generator.uniform(0.0, LARGEST_CONDITIONS, (RANDOM_STARTS, 4)),
                                 {model_mode: errors}))
    band, settings = calibrate(runs, model_mode, TIME), SETTINGS.as_dict()
    domain = CalibrationDomain.from_runs([run.conditions for run in runs])
    return Bands(vehicle.name, vehicle.hash, settings, {"random": "0" * 64}, RANDOM_RUNS, domain,
                 {(model, mode): band for model in MODELS for mode in MODES},
                 {model: hash_configuration(vehicle, settings, "") for model in MODELS})
