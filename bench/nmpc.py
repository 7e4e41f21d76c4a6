"""Tracking error of a model predictive controller by model and horizon, from examples/mpc/nmpc.py.

Writes the table and the figures of docs/measurements/mpc.md; it takes a minute of processor time.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from st_recordings.paths import project_root

from ._pages import format_records, replace_part

PAGE = project_root() / "docs" / "measurements" / "mpc.md"
EXAMPLE = project_root() / "examples" / "mpc"


def run() -> dict:
    """Lateral deviation [m] and processor time [ms] of the real-time iteration, by road and horizon."""
    with tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        folder = Path(name) / "out"
        subprocess.run([sys.executable, EXAMPLE / "nmpc.py", "--output", folder], check=True,
                       env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
        drives = json.loads((folder / "drives.json").read_text(encoding="utf-8"))["drives"]
        for figure in ("trade_off", "paths"):
            shutil.copyfile(folder / f"{figure}.png", project_root() / "docs" / "images" / f"mpc_{figure}.png")
    rows = tabulate([drive for drive in drives if drive["solver"] == "rti"])
    times = [drive["cpu_median"] for drive in drives if drive["solver"] == "ipopt" and drive["horizon"] == 2.0]
    replace_part(PAGE, "models in a controller", f"{format_records(rows)}\n\n"
                 f"Full solution by IPOPT, at 2 s: {min(times):.1f} to {max(times):.1f} ms.")
    return {"models": {f"{row['road']}, {row['horizon, s']} s": row for row in rows}}


def tabulate(drives: Sequence[Mapping]) -> list[dict[str, str]]:
    """A row for each road and horizon, with two columns for each model."""
    rows: dict[tuple[str, float], dict[str, str]] = {}
    for drive in drives:
        row = rows.setdefault((drive["road"], drive["horizon"]), {
            "road": drive["road"].replace("_", " "), "horizon, s": f"{drive['horizon']:g}"})
        left = "" if drive["finished"] else f"left at {drive['duration']:.0f} s"
        row[f"{drive['model']}, m"] = left or f"{drive['error_rms']:.3f}"
        row[f"{drive['model']}, ms"] = f"{drive['cpu_median']:.2f}"
    return list(rows.values())
