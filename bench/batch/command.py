"""Batches of predictions: rates of numba, numpy, Python, C++, CasADi and commonroad, a fit, growth, start of Python.

ST_BATCH=rates, fit, growth or startup runs one part only. Rates: in numba with SIMD ("lanes") and without, in C++ with
SIMD, in Python with scalars ("floats"). Each prediction covers 5 s with RK4 steps of 50 ms (odeint in two of
commonroad); one starts every 100 ms of a ten-minute drive. All except commonroad run alternately on one core. The limit
is the fastest of the C++ variants.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from st_core.augmented import augment
from st_core.backends import numba_lanes, numpy_batch
from st_core.batch import LogBatch, plan_blocks
from st_core.log import DriveLog, LogSignals
from st_core.models import MODELS, get_model
from st_core.palette import FIGURE_STYLE, MODEL_COLOUR
from st_core.prediction import predict
from st_core.types import InputSequence, VehicleState
from st_recordings.paths import project_root

from .._drives import LEAF_FILE, leaf
from .peers import STEP, STEPS, casadi_calls, commonroad_calls, compile_limit, compile_numba_scalar

START_NS = 1_700_000_000_000_000_000
POINTS = (1.0, 2.0, 3.0, 4.0, 5.0)  # s ahead, at which predictions are stored
LAST = np.array([STEPS])
COUNT = 5760  # predictions; a multiple of 48, 32 and 24 lanes
MINUTES, HORIZONS = (1.0, 3.0, 10.0, 30.0), (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
LIVE = """
import sys, time
from pathlib import Path
from st_core.vehicle import VehicleParameters
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState
car = VehicleParameters.from_yaml(Path(sys.argv[1]).read_text())
for model in ("kinematic", "linear", "nonlinear"):
    predict(model, car, VehicleState(0, 0, 10, 0, 0, 0), ControlInput(0.05, 0.0))
print(time.process_time())
"""
BATCH = """
import sys, time
import numpy as np
from pathlib import Path
from st_core.batch import LogBatch
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
car = VehicleParameters.from_yaml(Path(sys.argv[1]).read_text())
log = DriveLog("weaving", **np.load(sys.argv[2]))
batch = LogBatch(log, np.arange(log.start_ns + 10**9, log.end_ns - 5 * 10**9, 10**8), backend=sys.argv[3])
for model in ("kinematic", "linear", "nonlinear"):
    batch.predict(model, car)
print(time.process_time())
"""


def run() -> dict:
    """Results of all parts, or of the part chosen by ST_BATCH."""
    parts = {"rates": measure_rates, "fit": measure_fit, "growth": measure_growth, "startup": measure_startup}
    chosen = os.environ.get("ST_BATCH")
    return {key: value for name, part in parts.items() if chosen in (None, name) for key, value in part().items()}


def measure_rates() -> dict:
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


def measure_fit() -> dict:
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


def measure_growth() -> dict:
    """Processor time [ms] by length of the log [min] and by horizon [s]; draws docs/images/performance_growth.png."""
    car = leaf()
    logs = {minutes: weaving_drive(60.0 * minutes) for minutes in MINUTES}
    by_length, by_horizon = {}, {}
    with pin_to_core():
        for model in MODELS:
            batches = {str(m): LogBatch(log, start_times(log), points=POINTS) for m, log in logs.items()}
            by_length[model] = _measure_growth(batches, model, car)
            log = logs[10.0]
            batches = {str(h): LogBatch(log, start_times(log, 10.0), h, points=(h,)) for h in HORIZONS}
            by_horizon[model] = _measure_growth(batches, model, car)
    _plot(by_length, by_horizon, project_root() / "docs" / "images" / "performance_growth.png")
    return {"ms_by_minutes": by_length, "ms_by_horizon": by_horizon}


def _measure_growth(batches, model, car) -> dict:
    seconds = measure_alternately({name: lambda b=b: b.predict(model, car) for name, b in batches.items()},
                                  repetitions=3)
    return {name: value * 1e3 for name, value in seconds.items()}


def _plot(by_length: dict, by_horizon: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(FIGURE_STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(7.5, 3.0))
        for axis, results, label in zip(axes, (by_length, by_horizon), ("log [min]", "horizon [s]"), strict=True):
            for model, values in results.items():
                x = np.array([float(name) for name in values])
                axis.plot(x, list(values.values()), "o-", color=MODEL_COLOUR[model], label=model, markersize=3)
            axis.set(xlabel=label, ylabel="CPU time [ms]", xlim=(0, None), ylim=(0, None))
        axes[0].set_title("5 s horizons, a start every 100 ms")
        axes[1].set_title("ten-minute log")
        axes[0].legend()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)


def measure_startup() -> dict:
    """Processor time [s] of the whole process, including the start of Python and the import of numpy: live in scalar
    Python, and a batch with new and with cached kernels."""
    with tempfile.TemporaryDirectory(prefix="st-bench-") as cache:
        log, file = weaving_drive(20.0), str(Path(cache, "log.npz"))
        np.savez(file, **{name: value for name, value in vars(log).items() if isinstance(value, np.ndarray)})

        def seconds(code: str, backend: str = "") -> float:
            result = subprocess.run([sys.executable, "-c", code, str(LEAF_FILE), file, backend], check=True, text=True,
                                    env={**os.environ, "NUMBA_CACHE_DIR": cache}, capture_output=True)
            return float(result.stdout)

        return {"live_floats_s": seconds(LIVE), "batch_numpy_s": seconds(BATCH, "numpy"),
                "batch_lanes_cold_s": seconds(BATCH, "lanes"), "batch_lanes_cached_s": seconds(BATCH, "lanes")}


def weaving_drive(seconds: float) -> DriveLog:
    """A drive of `seconds` at 6 to 14 m/s with up to 3 m/s^2 lateral acceleration; INS at 100 Hz, steering at 50 Hz."""
    time, steering = np.arange(0.0, seconds, 0.01), np.arange(0.003, seconds, 0.02)

    def angle(t):
        return 0.05 * np.sin(0.3 * t) + 0.02 * np.sin(1.1 * t + 1.0)

    speed = 10.0 + 4.0 * np.sin(0.05 * time)
    yaw_rate = speed * angle(time) / (2.7 * (1.0 + 0.003 * speed**2))
    yaw = np.cumsum(yaw_rate) * 0.01
    return DriveLog("weaving", START_NS + np.round(time * 1e9).astype(np.int64), np.cumsum(speed * np.cos(yaw)) * 0.01,
                    np.cumsum(speed * np.sin(yaw)) * 0.01, yaw, speed, 0.3 * yaw_rate, yaw_rate,
                    START_NS + np.round(steering * 1e9).astype(np.int64), angle(steering))


def start_times(log: DriveLog, horizon: float = 5.0) -> np.ndarray:
    """Start times [ns] every 100 ms, from 1 s after the start of the log to one horizon before its end."""
    return np.arange(log.start_ns + 10**9, log.end_ns - round(horizon * 1e9), 10**8)


@contextmanager
def pin_to_core() -> Iterator[None]:
    """Context in which this process runs on one core only, the one with the highest number."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def measure_alternately(calls: dict[str, Callable[[], object]], repetitions: int = 5,
                        min_time: float = 0.05) -> dict[str, float]:
    """Median processor time of each call [s]. Each repetition makes all calls in turn, each for at least `min_time`."""
    durations: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(repetitions):
        for name, call in calls.items():
            count, begin = 0, time.process_time()
            while not count or time.process_time() - begin < min_time:
                call()
                count += 1
            durations[name].append((time.process_time() - begin) / count)
    return {name: float(np.median(values)) for name, values in durations.items()}
