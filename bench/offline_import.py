"""Raw logs to a bag: an hour of 250 Hz NCOM and full CAN traffic read, aligned and written; share of each, peak memory.

The logs are made by the virtual Leaf first, which takes several minutes; ST_BENCH_MINUTES sets another length, and
ST_BENCH_LOGS keeps them in a folder for the next time.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from st_offline.paths import config


def run() -> dict:
    """Every figure of one import, taken in a process of its own so that its peak memory is its own."""
    kept = os.environ.get("ST_BENCH_LOGS")
    with nullcontext(kept) if kept else tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        logs = Path(name) / "logs"
        if not (logs / "run.mf4").exists():
            _drive(logs, 60 * float(os.environ.get("ST_BENCH_MINUTES", "60")))
        with tempfile.TemporaryDirectory(prefix="st-bench-") as output:
            command = [sys.executable, __file__, "--measure", str(logs), str(Path(output) / "bag")]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def _drive(folder: Path, seconds: float) -> None:
    """The logger's clock is 1.7 s off and runs 20 ppm fast."""
    from st_sim.run import main

    main([
        "--scenario", "sweep", "--vehicle", str(config("vehicle/leaf.yaml")), "--duration", str(seconds), "--seed", "1",
        "--plant", "realistic", "--effect", "logger_clock_offset=1.7", "--effect", "logger_clock_drift=2e-5",
        "--ncom-rate", "250", "--can-rate", "realistic", "--to-files", str(folder), "--can-format", "mf4",
    ])


def _measure(logs: Path, output: Path) -> dict:
    from st_core.vehicle import VehicleParameters
    from st_offline.runs import find_runs, load, read, write

    leaf = VehicleParameters.from_yaml(config("vehicle/leaf.yaml").read_text(), "leaf.yaml")
    (source,) = find_runs([logs])
    seconds: dict[str, float] = {}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*given: Any, **named: Any) -> Any:
            start = time.perf_counter()
            result = function(*given, **named)
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
            return result
        return wrapper

    for name, function in (("read_ncom", "read_ncom"), ("read_mf4", "read_can_logs"), ("decode_can", "decode_signals"),
                           ("align", "align_clocks")):
        setattr(load, function, timed(name, getattr(load, function)))
    start = time.perf_counter()
    done = write.import_run(source, leaf, output, load.ReadSettings())
    total = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start = time.perf_counter()
    read(find_runs([output])[0], leaf)
    return {
        "minutes": done.span / 60, "ncom_packets": done.counts["/ins/ncom"], "can_frames": len(done.run.can.frames),
        "verdict": str(done.run.alignment.verdict), "import_s": total, "times_real_time": done.span / total,
        **{f"{name}_s": value for name, value in seconds.items()}, "write_s": total - sum(seconds.values()),
        "peak_memory_mb": peak, "read_the_bag_s": time.perf_counter() - start,
        "bag_mb": sum(f.stat().st_size for f in output.iterdir()) / 2**20,
    }


if __name__ == "__main__":
    if "--measure" in sys.argv:
        print(json.dumps(_measure(Path(sys.argv[-2]), Path(sys.argv[-1]))))
    else:
        print(json.dumps(run(), indent=2))
