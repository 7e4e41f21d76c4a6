"""An hour at full rates with random faults: memory, handles, shared memory, age of predictions, losses.

250 NCOM packets and 1750 CAN frames per second; about every 30 s a fault, including kills and hangs. ST_SOAK_MINUTES
(60) and ST_SOAK_SEED (1) change the run. Draws docs/images/soak.png; reading the recordings takes some more minutes.
"""

import contextlib
import os
import random
import re
import struct
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from faults.catalogue import CAN, HANGING, INS, KILLED, Fault
from faults.rig import Rig, running
from st_core.palette import FIGURE_STYLE
from st_recordings.recovery import recover
from st_recordings.runs.bag_storage import open_bag

FIGURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "soak.png"
MAX_FAULT_DURATION = 12.0  # s; longer faults have rows in the fault table
PAUSE = (15.0, 45.0)  # s between two faults
FINAL_PAUSE = 20.0  # s without a fault at the end
RECOVERY_TIME = 12.0  # s after a fault; losses within it are due to the fault: a node restarts after up to 10 s
SAMPLE_PERIOD = 5.0  # s
SEGMENT = re.compile(r"/dev/shm/(fastrtps_[0-9a-f]+)")
FAULT_WEIGHTS = {"kill": 1, "hang": 1, "wire": 6}


@dataclass
class Samples:
    """One value per sample; for processes: node -> values, NaN while it does not run."""

    minutes: list[float] = field(default_factory=list)
    memory: dict[str, list[float]] = field(default_factory=dict)  # MB resident
    handles: dict[str, list[float]] = field(default_factory=dict)
    segments: list[int] = field(default_factory=list)  # shared-memory segments that a node of the suite maps
    orphaned_segments: list[int] = field(default_factory=list)  # existing segments that no node maps any more
    sender_delays: list[float] = field(default_factory=list)  # s, by which the simulated car sends late
    load: list[float] = field(default_factory=list)  # load average over one minute
    all_segments: set[str] = field(default_factory=set)  # names of all segments mapped so far


def take_sample(rig: Rig, samples: Samples, start: float) -> None:
    samples.minutes.append((time.monotonic() - start) / 60)
    mapped: set[str] = set()
    running_now = {}
    for child in rig.suite.children:
        try:
            process = psutil.Process(child.process.pid)
            running_now[child.name] = process.memory_info().rss / 2**20, process.num_fds()
            mapped |= set(SEGMENT.findall(Path(f"/proc/{process.pid}/maps").read_text()))
        except (psutil.Error, OSError):
            continue
    for name in rig.names:
        memory, handles = running_now.get(name, (float("nan"), float("nan")))
        samples.memory.setdefault(name, []).append(memory)
        samples.handles.setdefault(name, []).append(handles)
    samples.all_segments |= mapped
    samples.segments.append(len(mapped))
    samples.orphaned_segments.append(sum(Path("/dev/shm", name).exists() for name in samples.all_segments - mapped))
    samples.sender_delays.append(rig.car.behind)
    rig.car.behind = 0.0
    samples.load.append(os.getloadavg()[0])


def choose_fault(rng: random.Random) -> Fault:
    kind = rng.choices(list(FAULT_WEIGHTS), list(FAULT_WEIGHTS.values()))[0]
    wire = [f for f in (*INS, *CAN) if f.seconds <= MAX_FAULT_DURATION]
    return rng.choice({"kill": KILLED, "hang": HANGING, "wire": wire}[kind])


def run_with_faults(rig: Rig, minutes: float, seed: int) -> tuple[Samples, Counter, list[tuple[float, float]]]:
    """Runs the suite with faults; returns samples, count of each fault, and start and end of each fault [minutes]."""
    rng, samples, faults, fault_times = random.Random(seed), Samples(), Counter(), []
    start = time.monotonic()
    end, due, next_fault = start + 60 * minutes, start, start + PAUSE[0]
    undo, until = None, 0.0
    while (now := time.monotonic()) < end:
        rig.run(0.5)
        if now >= due:
            due = now + SAMPLE_PERIOD
            take_sample(rig, samples, start)
        if undo and now >= until:
            with contextlib.suppress(ProcessLookupError):
                undo()
            undo, next_fault = None, now + rng.uniform(*PAUSE)
        elif not undo and now >= next_fault and now < end - MAX_FAULT_DURATION - FINAL_PAUSE:
            fault = choose_fault(rng)
            try:
                undo, until = fault.inject(rig), now + fault.seconds
                faults[fault.name] += 1
                fault_times.append(((now - start) / 60, (until - start) / 60))
            except (StopIteration, ProcessLookupError):  # the node is already being restarted
                next_fault = now + PAUSE[0]
    return samples, faults, fault_times


def read_recordings(folder: Path) -> dict[str, np.ndarray]:
    """Start times and ages of the predictions, stamps of the NCOM packets, and number of CAN frames, in all bags."""
    starts, ages, packets, frames = [], [], [], 0
    for bag in sorted(folder.glob("bag*")):
        recover(bag)
        storage = open_bag(bag)
        for raw in storage.messages("/predictor/linear/prediction"):
            begin, issued = (s * 10**9 + n for s, n in (struct.unpack_from("<iI", raw, at) for at in (4, 20)))
            starts.append(begin)
            ages.append((issued - begin) * 1e-6)
        packets += [s * 10**9 + n for s, n in (struct.unpack_from("<iI", r, 4) for r in storage.messages("/ins/ncom"))]
        for raw in storage.messages("/can/frames"):
            length = struct.unpack_from("<I", raw, 12)[0]
            frames += struct.unpack_from("<I", raw, 16 + (length + 3) // 4 * 4)[0]
    return {"start_ns": np.array(starts), "age_ms": np.array(ages), "packet_ns": np.array(packets), "frames": frames}


def count_unexplained_losses(sent_ns: np.ndarray, recorded_ns: np.ndarray, start_ns: int, fault_times: list,
                             minutes: float) -> int:
    """Number of packets that were sent but not recorded, outside faults and the RECOVERY_TIME after them.

    One or two packets missing between two faults are not counted, because they may be losses of these faults.
    """
    edges = start_ns + np.arange(0, int(60 * minutes) + 1) * 10**9
    missing = np.histogram(sent_ns, edges)[0] - np.histogram(recorded_ns, edges)[0]
    second, calm = np.arange(len(missing)), np.ones(len(missing), bool)
    for begin, end in fault_times:
        calm &= (second < 60 * begin - 2) | (second > 60 * end + RECOVERY_TIME)
    stretches = np.split(np.where(calm, missing, 0), np.flatnonzero(np.diff(calm)) + 1)
    return int(sum(lost for s in stretches if (lost := s.sum()) > 2))


def growth_per_hour(minutes: list[float], values: list[float]) -> float:
    """Growth per hour in the longest time of a node without a restart, after its first minute."""
    t, v = np.array(minutes), np.array(values)
    cuts = np.flatnonzero(np.isnan(v) | (np.diff(v, prepend=v[0]) < -0.3 * np.nanmax(v)))
    rows = max(np.split(np.arange(len(v)), cuts), key=len)
    rows = rows[(t[rows] > t[rows][0] + 1.0) & ~np.isnan(v[rows])]
    return float(np.polyfit(t[rows], v[rows], 1)[0] * 60) if len(rows) > 12 else float("nan")


def draw(samples: Samples, series: dict, fault_times: list[tuple[float, float]], start_ns: int) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(FIGURE_STYLE):
        figure, axes = plt.subplots(5, 1, figsize=(8, 10), sharex=True)
        for name, values in samples.memory.items():
            axes[0].plot(samples.minutes, values, label=name)
            axes[1].plot(samples.minutes, samples.handles[name])
        axes[0].set(ylabel="resident memory, MB", ylim=(0, None))
        axes[0].legend(ncols=5, loc="lower left", fontsize=8)
        axes[1].set(ylabel="open handles", ylim=(0, None))
        axes[2].plot(samples.minutes, samples.segments, label="mapped by a node")
        axes[2].plot(samples.minutes, samples.orphaned_segments, label="left by a killed node")
        axes[2].set(ylabel="shared-memory segments", ylim=(0, None))
        axes[2].legend(loc="upper left", fontsize=8)
        at = (series["start_ns"] - start_ns) / 60e9
        for percent, label in ((50, "median"), (99, "99 %")):
            edges = np.arange(0, samples.minutes[-1], 1.0)
            inside = [series["age_ms"][(at >= e) & (at < e + 1)] for e in edges]
            axes[3].plot(edges + 0.5, [np.percentile(x, percent) if len(x) else np.nan for x in inside], label=label)
        axes[3].set(ylabel="measured to published, ms", yscale="log")
        axes[3].legend(loc="upper left", fontsize=8)
        axes[4].plot(samples.minutes, samples.load, color="#888888")
        axes[4].set(ylabel="load average", xlabel="minutes", ylim=(0, None))
        for axis in axes:
            for minute, _ in fault_times:
                axis.axvline(minute, color="#dddddd", linewidth=0.5, zorder=0)
        axes[0].set_title("Soak at 250 NCOM packets/s and 1750 CAN frames/s; thin lines: injected faults")
        figure.savefig(FIGURE)


def run() -> dict:
    minutes, seed = float(os.environ.get("ST_SOAK_MINUTES", "60")), int(os.environ.get("ST_SOAK_SEED", "1"))
    with tempfile.TemporaryDirectory(prefix="st-soak-") as name:
        folder = Path(name)
        with running(folder, 250, full_bus=True) as rig:
            start_ns = time.time_ns()
            samples, faults, fault_times = run_with_faults(rig, minutes, seed)
            problems, restarts = rig.problems(), rig.supervisor.restarts
            rig.car.ins.change = rig.car.can.change = lambda data: ()  # stop sending, so that all sent data can arrive
            rig.run(2.0)
            sent, frames_sent = np.array(rig.car.ins.sent_ns), len(rig.car.can.sent_ns)
        statuses = rig.statuses
        series = read_recordings(folder)
        size = sum(f.stat().st_size for f in folder.rglob("*.mcap"))
    draw(samples, series, fault_times, start_ns)
    ages = series["age_ms"]
    half = len(ages) // 2
    return {
        "minutes": samples.minutes[-1], "faults": sum(faults.values()), "kinds": len(faults), "restarts": restarts,
        "statuses at the end": {k: v for k, v in statuses.items() if v}, "problems at the end": problems,
        "ncom sent": len(sent), "ncom recorded": len(series["packet_ns"]),
        "ncom lost without a fault": count_unexplained_losses(sent, series["packet_ns"], start_ns, fault_times,
                                                               samples.minutes[-1]),
        "longest silence in the recording, s": float(np.diff(np.sort(series["packet_ns"])).max(initial=0)) * 1e-9,
        "can sent": frames_sent, "can recorded": int(series["frames"]),
        "predictions": len(ages), "predictions due": round(samples.minutes[-1] * 600),
        "age ms, first half": dict(zip(("p50", "p99"), np.percentile(ages[:half], (50, 99)).tolist(), strict=True)),
        "age ms, second half": dict(zip(("p50", "p99"), np.percentile(ages[half:], (50, 99)).tolist(), strict=True)),
        "memory MB per hour": {name: growth_per_hour(samples.minutes, v) for name, v in samples.memory.items()},
        "handles per hour": {name: growth_per_hour(samples.minutes, v) for name, v in samples.handles.items()},
        "segments left behind": samples.orphaned_segments[-1], "sender behind, worst s": max(samples.sender_delays),
        "load of the machine, mean": float(np.mean(samples.load)), "recorded MB": size / 1e6,
    }
