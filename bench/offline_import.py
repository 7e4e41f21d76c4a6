"""Time to import an hour of 250 Hz NCOM and full CAN traffic, and to evaluate it from the bag and from the raw files.

The virtual Leaf first writes the logs, which takes several minutes. ST_BENCH_MINUTES sets another duration;
ST_BENCH_LOGS names a folder in which the logs are kept for the next run.
"""

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ._drives import LEAF_FILE, leaf


def run() -> dict:
    """Time and memory of `st import`, and of `st evaluate` for bag and raw files, each in a separate process."""
    kept = os.environ.get("ST_BENCH_LOGS")
    with nullcontext(kept) if kept else tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        logs = Path(name) / "logs"
        if not (logs / "run.mf4").exists():
            _drive(logs, 60 * float(os.environ.get("ST_BENCH_MINUTES", "60")))
        with tempfile.TemporaryDirectory(prefix="st-bench-") as output:
            bag = Path(output) / "bag"
            return {
                "import": _run_separately("import", logs, bag),
                "evaluate_imported": _run_separately("evaluate", bag, Path(output) / "from_bag"),
                "raw_to_report": _run_separately("evaluate", logs, Path(output) / "from_raw"),
            }


def _run_separately(command: str, source: Path, output: Path) -> dict:
    arguments = [command, str(source.resolve()), str(output)]
    done = subprocess.run([sys.executable, "-m", "bench.offline_import", *arguments], check=True, text=True,
                          stdout=subprocess.PIPE, cwd=Path(__file__).parents[1])
    return json.loads(done.stdout.splitlines()[-1])


def _drive(folder: Path, seconds: float) -> None:
    """Writes the files of a drive; the clock of the logger has an offset of 1.7 s and is 20 ppm fast."""
    from st_sim.run import main

    main([
        "--scenario", "sweep", "--vehicle", str(LEAF_FILE), "--duration", str(seconds), "--seed", "1",
        "--plant", "realistic", "--effect", "logger_clock_offset=1.7", "--effect", "logger_clock_drift=2e-5",
        "--ncom-rate", "250", "--can-rate", "realistic", "--to-files", str(folder), "--can-format", "mf4",
    ])


def _time_functions(parts: dict[str, tuple[Any, str]]) -> dict[str, float]:
    """Adds up the time spent in functions: name -> [s], updated by each call. parts: name -> (module, function)."""
    seconds = dict.fromkeys(parts, 0.0)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            result = function(*arguments, **options)
            seconds[name] += time.perf_counter() - start
            return result
        return wrapper

    for name, (module, function) in parts.items():
        setattr(module, function, timed(name, getattr(module, function)))
    return seconds


def _reading_functions() -> dict[str, tuple[Any, str]]:
    from st_recordings.runs import ncom, raw

    return {"read_ncom": (ncom, "read_ncom"), "read_mf4": (raw, "read_can_logs"),
            "decode_can": (raw, "decode_signals"), "align": (raw, "align_clocks")}


def _time_parts(seconds: dict[str, float], wall: float) -> dict[str, float]:
    """Wall time and its parts, processor time of this process and its children [s], and their largest peak memory."""
    # The peak memory in the resource usage of this process would include that of its parent.
    own = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    peak = max(int(own[1]), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    parts = {f"{name}_s": value for name, value in seconds.items() if value}
    return {"wall_s": wall, **parts, "rest_s": wall - sum(seconds.values()), "processor_s": sum(os.times()[:4]),
            "peak_memory_mb": peak / 1024}


def measure_import(logs: Path, output: Path) -> dict:
    from st_offline.checking.gate import check_before_use
    from st_recordings.runs import ReadSettings, find_runs, write

    (source,), vehicle = find_runs([logs]), leaf()
    seconds = _time_functions(_reading_functions())
    start = time.perf_counter()
    done = write.import_run(source, vehicle, output, ReadSettings(),
                            lambda run: check_before_use(source.path, run, vehicle, False))
    total = time.perf_counter() - start
    return {"minutes": done.span / 60, "ncom_packets": done.counts["/ins/ncom"], "can_frames": len(done.run.can.frames),
            "verdict": str(done.run.alignment.verdict), "times_real_time": done.span / total,
            **_time_parts(seconds, total), "bag_mb": sum(f.stat().st_size for f in output.iterdir()) / 2**20}


def measure_evaluate(source: Path, output: Path) -> dict:
    """Runs the command as a user does, but in this process."""
    import psutil
    from st_cli.__main__ import main
    from st_offline.evaluation import evaluation_command, work
    from st_recordings.runs import bag, load

    reading = {"read_bag": (bag, "read_bag")} if (source / "metadata.yaml").exists() else _reading_functions()
    parts = {**reading, "hash": (load, "hash_files"), "predict": (work, "evaluate_log"),
             "starts_csv": (work, "write_starts"), "draw": (work, "draw_run"),
             "report": (evaluation_command, "write_results")}
    seconds = _time_functions(parts)
    status: object = 0
    sys.argv = ["st", "evaluate", str(source), "--output", str(output)]
    try:
        main()
    except SystemExit as exit_request:
        status = exit_request.code
    wall = time.time() - psutil.Process().create_time()
    return {"exit_status": status or 0, **_time_parts(seconds, wall)}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure = {"import": measure_import, "evaluate": measure_evaluate}[sys.argv[1]]
        print(json.dumps(measure(Path(sys.argv[2]), Path(sys.argv[3]))))
    else:
        print(json.dumps(run(), indent=2))
