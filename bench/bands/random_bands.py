"""Bands calibrated with random errors under random conditions, to measure the cost of bands."""

import numpy as np
from st_core.bands import Bands, CalibrationDomain, ErrorSamples, calibrate
from st_core.bands.file import hash_configuration
from st_core.log_evaluation import MODES, EvaluationSettings
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters

SETTINGS = EvaluationSettings()
TIME = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
RUNS, STARTS = 12, 4000
LARGEST_CONDITIONS = (26.0, 8.0, 6.0, 1.0)  # speed, accelerations, steering activity [m/s, m/s^2, m/s^2, rad/s]


def random_bands(vehicle: VehicleParameters) -> Bands:
    model_mode, runs = ("random", "hindsight"), []
    for number in range(RUNS):
        generator = np.random.default_rng([21, number])
        errors = (0.1 * generator.standard_normal((STARTS, 1, 3)) * TIME[:, None]).astype(np.float32)
        runs.append(ErrorSamples(f"run {number}", generator.uniform(0.0, LARGEST_CONDITIONS, (STARTS, 4)),
                                 {model_mode: errors}))
    band, settings = calibrate(runs, model_mode, TIME), SETTINGS.as_dict()
    domain = CalibrationDomain.from_runs([run.conditions for run in runs])
    return Bands(vehicle.name, vehicle.hash, settings, {"random": "0" * 64}, RUNS, domain,
                 {(model, mode): band for model in MODELS for mode in MODES},
                 {model: hash_configuration(vehicle, settings, "") for model in MODELS})
