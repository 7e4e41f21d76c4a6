"""Fits two stiffness factors of the nonlinear model to a ten-minute drive: processor time, evaluations, result."""

import time

import numpy as np
from scipy.optimize import least_squares
from st_core.augmented import augment
from st_core.batch import LogBatch

from ._drives import leaf
from ._processor_time import POINTS, pin_to_core, start_times, weaving_drive


def run() -> dict:
    """Processor time [s] after warm-up, for 60 000 residuals: positions at 1 to 5 s with 5 cm of noise."""
    car, log = leaf(), weaving_drive(600.0)
    batch = LogBatch(log, start_times(log), points=POINTS)

    def positions(factors):
        model = augment("nonlinear", {"front_stiffness": {"factor": float(factors[0])},
                                      "rear_stiffness": {"factor": float(factors[1])}})
        return batch.predict(model, car)[:, :, :2]

    truth = (0.8, 1.1)
    measured = positions(truth)
    measured = measured + np.random.default_rng(0).normal(0.0, 0.05, measured.shape)
    with pin_to_core():
        begin = time.process_time()
        fit = least_squares(lambda f: (positions(f) - measured).ravel(), [1.0, 1.0])
        seconds = time.process_time() - begin
    return {"residuals": measured.size, "cpu_s": seconds, "evaluations": int(fit.nfev + 2 * fit.njev),
            "true": str(truth), "found": str([round(float(x), 4) for x in fit.x])}
