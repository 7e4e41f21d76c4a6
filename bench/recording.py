"""Cost of syncing a recording to the disk twice a second, from alternate recordings with and without it.

The messages have the sizes and rates of a drive with raw CAN frames. ST_BENCH_FOLDER: folder for the recordings,
default the current one. ST_BENCH_SECONDS: duration of each of the four recordings.
"""

import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from st_recordings.mcap import BagWriter

# (rate [Hz], size [byte]): packets, odometry, imu, steering, wheel speeds, raw frames, predictions, paths.
TOPICS = ((250, 100), (250, 740), (250, 340), (100, 60), (50, 80), (10, 12_000), (30, 7_500), (30, 9_000))
WORK_PERIOD = 0.05  # s, as in the recorder
TURNS = ("without", "with") * 2
DEFINITION = ("uint8[] data", "RIHS01_" + "0" * 64)


def write_bag(folder: Path, seconds: float, synced: bool) -> dict:
    """Writes a bag; returns processor load, data rate, lost messages, and the writing time of each WORK_PERIOD [ms]."""
    content = _make_content()
    bag = BagWriter(folder, {"recording": {"recorder": "bench"}}, synced=synced)
    topics = [bag.add_topic(f"/{k}", "bench_msgs/msg/Bytes", (), *DEFINITION) for k in range(len(TOPICS))]
    written, busy, at = [0] * len(TOPICS), [], 0
    start, processor = time.monotonic(), time.process_time()
    while (now := time.monotonic()) < start + seconds:
        for k, (rate, size) in enumerate(TOPICS):
            while written[k] < (now - start) * rate:
                bag.write(topics[k], content[at : at + size], int(now * 1e9))
                at = at + size if at < len(content) - 50_000 else 0
                written[k] += 1
        bag.flush_when_due()
        busy.append(time.monotonic() - now)
        time.sleep(max(0.0, WORK_PERIOD - busy[-1]))
    load = (time.process_time() - processor) / (time.monotonic() - start)
    syncer = bag.syncer
    bag.close()
    result = {"cpu_percent": 100.0 * load, "bytes_per_s": bag.path.stat().st_size / seconds, "lost": bag.lost_count,
              "busy_ms": np.array(busy) * 1e3}
    return result | ({"syncs": syncer.call_count, "slowest_sync_ms": syncer.longest_call * 1e3} if syncer else {})


def _make_content() -> bytes:
    """Random bytes with a zero after each, so that messages differ but are compressible like signals."""
    random = np.random.default_rng(0)
    return (random.integers(0, 256, (2**21, 2)) * (0, 1)).astype(np.uint8).tobytes()


def run() -> dict:
    seconds = float(os.environ.get("ST_BENCH_SECONDS", "60"))
    base = Path(tempfile.mkdtemp(prefix="st-bench-", dir=os.environ.get("ST_BENCH_FOLDER", ".")))
    turns: dict[str, list[dict]] = {name: [] for name in TURNS}
    try:
        for number, name in enumerate(TURNS):
            turns[name].append(write_bag(base / f"bag_{number}", seconds, name == "with"))
        return {"file_system": _file_system(base)} | {name: _average(results) for name, results in turns.items()}
    finally:
        shutil.rmtree(base)


def _average(results: list[dict]) -> dict:
    busy = np.concatenate([result.pop("busy_ms") for result in results])
    means = {key: float(np.mean([result[key] for result in results])) for key in results[0]}
    if "slowest_sync_ms" in means:
        means["slowest_sync_ms"] = max(result["slowest_sync_ms"] for result in results)
    return means | {"writer_busy_ms": {f"p{q}": float(np.percentile(busy, q)) for q in (50, 99)}
                    | {"max": float(busy.max())}}


def _file_system(folder: Path) -> str:
    """Type and device of the file system of the folder."""
    mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    parents = [m for m in mounts if folder.resolve().is_relative_to(m[1])]
    device, _, kind, *_ = max(parents, key=lambda m: len(m[1]))
    return f"{kind} on {device}"
