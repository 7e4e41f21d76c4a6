"""Evaluates 40 logs of ten minutes, one of them truncated, with one worker and with two (Dask)."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from st_recordings.paths import project_root
from st_sim.run import main as virtual_leaf

from ._drives import LEAF_FILE

LOGS, SECONDS, DRIVES = 40, 600.0, ("S1", "S6", "S7", "step")
SAMPLE_PERIOD = 0.5  # s


def run() -> dict:
    """Wall time [s], memory of the largest worker [MB], and speed-up; no figures are drawn."""
    with tempfile.TemporaryDirectory(prefix="st-fleet-") as name:
        folder = Path(name)
        logs = _write_logs(folder)
        single, double = (_evaluate(logs, folder / f"out{workers}", workers) for workers in (1, 2))
    same = single.pop("runs") == double.pop("runs")
    return {"logs": LOGS, "minutes each": SECONDS / 60, "one worker": single, "two workers": double,
            "speed-up": single["wall"] / double["wall"], "same table": same}


def _write_logs(folder: Path) -> Path:
    for drive in DRIVES:
        status = virtual_leaf(["--scenario", drive, "--vehicle", str(LEAF_FILE), "--duration", str(SECONDS),
                               "--to-files", str(folder / "drives" / drive), "--can-format", "mf4"])
        if status:
            raise RuntimeError(f"virtual_leaf --scenario {drive}: exit status {status}")
    for k in range(LOGS):
        own, source = folder / "logs" / f"log{k:02d}", folder / "drives" / DRIVES[k % len(DRIVES)]
        own.mkdir(parents=True)
        for file in (source / "run.ncom", source / "run.mf4"):
            os.link(file, own / file.name)
    truncated = folder / "logs" / "log00" / "run.ncom"
    data = truncated.read_bytes()[:500]
    truncated.unlink()  # a hard link to the complete file
    truncated.write_bytes(data)
    return folder / "logs"


def _evaluate(logs: Path, output: Path, workers: int) -> dict:
    command = [sys.executable, "-m", "st_cli.cli", "evaluate", str(logs), "--figures", "", "--workers",
               str(workers), "--output", str(output)]
    start, largest = time.perf_counter(), 0.0
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=project_root(), **pipe) as st:
        parent = psutil.Process(st.pid)
        while st.poll() is None:
            processes = parent.children(recursive=True) if workers > 1 else [parent]
            for process in processes:
                try:
                    largest = max(largest, process.memory_info().rss / 1e6)
                except psutil.Error:
                    continue
            time.sleep(SAMPLE_PERIOD)
        text = st.stdout.read()
    wall = time.perf_counter() - start
    if st.returncode != 1:
        raise RuntimeError(f"st evaluate: exit status {st.returncode}, expected 1 for one bad log: {text[-500:]}")
    content = json.loads((output / "evaluation.json").read_text())
    rounded = re.sub(r"(\d\.\d{9})\d+", r"\1", json.dumps(content["runs"], sort_keys=True))
    return {"wall": wall, "largest process MB": largest, "evaluated": len(content["runs"]),
            "failed": "; ".join(content["failed"].values())[-120:], "runs": rounded}
