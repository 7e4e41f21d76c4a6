"""Writes recordings of the virtual Leaf with the command virtual_leaf, and reads the drives in them."""

import contextlib
import io
from pathlib import Path

from _cars import LEAF_FILE
from st_core.vehicle import VehicleParameters
from st_recordings.runs import find_runs, read
from st_sim.run import main as virtual_leaf

SCENARIOS = ("S1", "S2", "S3", "S4", "S5", "S6", "S7")
SECONDS = 60.0


def write_scenarios(folder: Path, seed: int = 1) -> Path:
    """S1 to S7 with the realistic plant, each SECONDS long: folder/<name>/run.ncom and run.mf4."""
    for name in SCENARIOS:
        with contextlib.redirect_stdout(io.StringIO()):
            status = virtual_leaf(["--scenario", name, "--vehicle", str(LEAF_FILE), "--duration", str(SECONDS),
                                   "--seed", str(seed), "--plant", "realistic", "--to-files", str(folder / name),
                                   "--can-format", "mf4"])
        if status:
            raise RuntimeError(f"virtual_leaf --scenario {name}: exit status {status}")
    return folder


def read_runs(path: Path, vehicle: VehicleParameters) -> dict:
    """Name -> log of each run in a folder."""
    return {source.name: read(source, vehicle).log for source in find_runs([path])}
