"""Intervals and latency of predictions without a view, with a view, and with a stopped view (SIGSTOP)."""

import contextlib
import os
import time

import numpy as np
import rclpy

from ._suite import run_suite
from ._view import attach_view
from .latency import PERIOD, Listener, collect_ticks, latencies_ms

PHASES = ("no view", "view", "view that hangs")
REPETITIONS = 3
SETTLING_TIME = 3.0  # s after the start of a phase, not measured
MIN_TICK_FRACTION = 0.2  # fraction of the ticks of a phase that must be received


def run() -> dict:
    """Intervals between ticks and latency [ms] over ST_BENCH_SECONDS of each phase, alternately, without a browser."""
    seconds = float(os.environ.get("ST_BENCH_SECONDS", "60"))
    received: dict[str, list[Listener]] = {phase: [] for phase in PHASES}
    duration = REPETITIONS * len(PHASES) * (seconds / REPETITIONS + SETTLING_TIME + 25.0) + 20.0
    with run_suite(duration, ncom_rate=100, can_rate="realistic") as suite:
        rclpy.init()
        for _ in range(REPETITIONS):
            for phase in PHASES:
                attached = contextlib.nullcontext() if phase == "no view" else attach_view(suite,
                                                                                           phase == "view that hangs")
                with attached:
                    time.sleep(SETTLING_TIME)
                    received[phase].append(_listen(seconds / REPETITIONS))
        rclpy.try_shutdown()
    return {phase: _summarise(listeners, seconds) for phase, listeners in received.items()}


def _listen(seconds: float) -> Listener:
    node = Listener()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        node.take()
        time.sleep(PERIOD)
    node.destroy_node()
    return node


def _summarise(listeners: list[Listener], seconds: float) -> dict:
    intervals, repetitions = [], []
    for node in listeners:
        last = sorted(predictions[-1].issued for predictions in node.predictions.values())
        intervals += list(np.diff(last) * 1e-6)
        repetitions.append(latencies_ms(collect_ticks(node)))
    pooled = np.concatenate(repetitions)
    if len(pooled) < MIN_TICK_FRACTION * 10.0 * seconds:
        raise RuntimeError(f"only {len(pooled)} ticks received in {seconds:.0f} s: the machine is too busy")
    return {
        "ticks": len(pooled),
        "interval_std_ms": float(np.std(intervals)),
        "interval_p01_ms": float(np.percentile(intervals, 1)), "interval_p99_ms": float(np.percentile(intervals, 99)),
        "latency_p50_ms": float(np.percentile(pooled, 50)), "latency_p99_ms": float(np.percentile(pooled, 99)),
        "latency_p50_by_round_ms": " ".join(f"{np.percentile(r, 50):.1f}" if r else "-" for r in repetitions),
    }
