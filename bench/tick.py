"""Duration of a predictor tick with and without bands: start state and predictions of three models in scalar Python."""

import time

import numpy as np
from st_core.bands import CalibratedBands, conditions_now
from st_core.models import MODELS
from st_core.prediction import PredictionSettings, Predictor, Skip
from st_core.types import InsSample
from st_predictor.nodes._bands import BandMessages

from ._drives import leaf
from .bands.methods import random_bands

TICKS = 500
LAST_NS = 1_990_000_000


def run() -> dict:
    """Processor time per tick [ms] at 10 m/s in a gentle turn, alternating between ticks without and with bands.

    With bands, a tick includes the half-widths for both input modes and confidence levels, and their message fields.
    """
    vehicle, models = leaf(), tuple(MODELS)
    predictor, bands = Predictor(vehicle, models, PredictionSettings()), CalibratedBands(random_bands(vehicle), models)
    messages = BandMessages(bands.half_widths)
    for k in range(200):
        time_ns = k * 10_000_000
        predictor.add_ins(InsSample(time_ns, 10 * k * 0.01, 0.0, 0.0, 10.0, 0.05, 0.2))
        predictor.add_steering(time_ns, 0.06)
    times: dict[bool, list[float]] = {False: [], True: []}
    for k in range(2 * TICKS):
        begin = time.thread_time()
        start = predictor.find_start(LAST_NS)
        if isinstance(start, Skip):
            raise RuntimeError(start.reason)
        if with_bands := bool(k % 2):
            if not bands.update(conditions_now(predictor.history, start.time_ns)):
                raise RuntimeError("no band at these conditions")
            messages.fill()
        for model in models:
            predictor.run(start, model)
        times[with_bands].append((time.thread_time() - begin) * 1e3)
    p50, p99 = np.percentile(times[False], (50, 99))
    with_p50, with_p99 = np.percentile(times[True], (50, 99))
    return {
        "ticks": TICKS,
        "ms_p50": float(p50),
        "ms_p99": float(p99),
        "share_of_a_core_at_10_hz": float(p50) / 100,
        "with_bands_ms_p50": float(with_p50),
        "with_bands_ms_p99": float(with_p99),
        "bands_ms_p50": float(with_p50 - p50),
    }
