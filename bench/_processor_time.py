"""Synthetic drive, and measurement of processor time, for the benchmarks of batch predictions."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from st_core.log import DriveLog

START_NS = 1_700_000_000_000_000_000
POINTS = (1.0, 2.0, 3.0, 4.0, 5.0)  # s ahead, at which predictions are stored


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
