"""One predictor tick: the start state and the three models' 5 s trajectories on Python floats."""

import time

import numpy as np
from st_core.prediction import PredictionSettings, Predictor, Skip
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_recordings.paths import config

TICKS = 500
MODELS = ("kinematic", "linear", "nonlinear")


def run() -> dict:
    """ms per tick, at 10 m/s in a gentle turn."""
    path = config("vehicle/leaf.yaml")
    predictor = Predictor(VehicleParameters.from_yaml(path.read_text(), origin=str(path)), MODELS, PredictionSettings())
    for k in range(200):
        time_ns = k * 10_000_000
        predictor.add_ins(InsSample(time_ns, 10 * k * 0.01, 0.0, 0.0, 10.0, 0.05, 0.2))
        predictor.add_steering(time_ns, 0.06)
    times = []
    for _ in range(TICKS):
        begin = time.perf_counter()
        start = predictor.start(1_990_000_000)
        if isinstance(start, Skip):
            raise RuntimeError(start.reason)
        for model in MODELS:
            predictor.run(start, model)
        times.append((time.perf_counter() - begin) * 1e3)
    p50, p99 = np.percentile(times, (50, 99))
    return {
        "ticks": TICKS,
        "ms_p50": float(p50),
        "ms_p99": float(p99),
        "share_of_a_core_at_10_hz": float(p50) / 100,
    }


if __name__ == "__main__":
    print(run())
