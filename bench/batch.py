"""Predictions per second of processor time in numba, numpy, Python, C++, CasADi and commonroad.

In numba with SIMD ("lanes") and without, in C++ with SIMD, in Python with scalars ("floats"). Each prediction covers
5 s with RK4 steps of 50 ms (odeint in two of commonroad); one starts every 100 ms of a ten-minute drive. All except
commonroad run alternately on one core. The limit is the fastest of the C++ variants.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from st_core.backends import numba_lanes, numpy_batch
from st_core.batch import LogBatch, plan_blocks
from st_core.log import LogSignals
from st_core.models import MODELS, get_model
from st_core.prediction import predict
from st_core.types import InputSequence, VehicleState

from ._drives import leaf
from ._peers import STEP, STEPS, casadi_calls, commonroad_calls, compile_limit, compile_numba_scalar
from ._processor_time import POINTS, measure_alternately, pin_to_core, start_times, weaving_drive

LAST = np.array([STEPS])
COUNT = 5760  # predictions; a multiple of 48, 32 and 24 lanes


def run() -> dict:
    """Rates, their ratios to the limit, largest difference of end states, and processor time of a whole log [s]."""
    car, log = leaf(), weaving_drive(600.0)
    with pin_to_core(), tempfile.TemporaryDirectory(prefix="st-bench-") as folder:
        results = {name: _measure_model(name, car, log, Path(folder)) for name in MODELS}
        seconds = measure_alternately(commonroad_calls(), repetitions=2, min_time=0.0)
        results["commonroad_per_s"] = {k: 1.0 / s for k, s in seconds.items()}

        def predict_log():
            batch = LogBatch(log, start_times(log), points=POINTS)
            return [batch.predict(name, car) for name in MODELS]

        predict_log()
        times = []
        for _ in range(5):
            begin = time.process_time()
            predict_log()
            times.append(time.process_time() - begin)
    return {**results, "ten_minutes_three_models_cpu_s": float(np.median(times))}


def _measure_model(name: str, car, log, folder: Path) -> dict:
    model = get_model(name)
    p, signals = model.parameters(car), LogSignals(log, 0.1, 5.0)
    times = start_times(log)[:COUNT]
    block, = plan_blocks(times, 25_000_000 * np.arange(2 * STEPS + 1), numba_lanes.LANES)
    instants_ns = np.sort(block.times_ns)
    angle = signals.road_wheel_angle_at(instants_ns)
    acceleration, = signals.ins_at(instants_ns, "velocity_x_dot")
    # The inputs are constant before and after the drive, so that no kernel receives NaN.
    angle, acceleration = (np.interp(instants_ns, instants_ns[np.isfinite(a)], a[np.isfinite(a)])
                           for a in (angle, acceleration))
    w = block.tabulate(model.inputs(angle, acceleration, p))
    start = np.ascontiguousarray(signals.states_at(times, car).T)
    inputs = [InputSequence(angle[4 * i:4 * i + 201], acceleration[4 * i:4 * i + 201]) for i in (0, 1000)]
    subset = start[:, :240].copy()

    def floats():
        return [predict(name, car, VehicleState(*start[:, i]), seq) for i, seq in zip((0, 1000), inputs, strict=True)]

    cpp = compile_limit(folder, name, p, start, w, block.offsets)
    reference = next(iter(cpp.values()))().copy()
    calls = {
        **cpp,
        "lanes": lambda: numba_lanes.advance(model, p, start, w, block.offsets, STEP, LAST)[0],
        "numpy batch": lambda: numpy_batch.advance(model, p, start, w, block.offsets, STEP, LAST)[0],
        "numba scalar": compile_numba_scalar(model, p, subset, w, block.offsets), "floats": floats,
        **casadi_calls(folder, name, car, 50),
    }
    counts = {key: start.shape[1] for key in (*cpp, "lanes", "numpy batch")}
    counts |= {"numba scalar": 240, "floats": 2, "casadi map": 50, "casadi generated C": 50}
    difference = float(np.abs(calls["lanes"]() - reference).max())
    rates = {key: counts[key] / seconds for key, seconds in measure_alternately(calls).items()}
    best = max(rates[key] for key in cpp)
    return {"per_s": rates, "of_limit": {key: rate / best for key, rate in rates.items() if key not in cpp},
            "lanes_over_numba_scalar": rates["lanes"] / rates["numba scalar"], "lanes_minus_limit": difference}
