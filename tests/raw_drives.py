"""Drives of the virtual Leaf as raw files, run.ncom and run.log, as its INS and CAN logger would have written them."""

import contextlib
import io
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path

from st_sim.run import main
from support import ROOT

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
# What each run is driven for: content in frequency, forces along the car, both directions.
PROGRAMME = (("sweep", 26.0), ("brake_in_turn", 20.0), ("lane_change", 18.0))


def write_drives(folder: Path, effects: Mapping[str, float], seed: int,
                 programme: Sequence[tuple[str, float]] = PROGRAMME, plant: str = "realistic") -> Path:
    """One run for each (scenario, seconds), in folder/<scenario>/; the seeds count on from `seed`."""
    for number, (scenario, seconds) in enumerate(programme):
        words = ["--vehicle", str(LEAF), "--scenario", scenario, "--duration", str(seconds), "--plant", plant, "--seed",
                 str(seed + number), "--to-files", str(folder / Path(scenario).stem)]
        words += [word for name, value in effects.items() for word in ("--effect", f"{name}={value}")]
        said, wrong = io.StringIO(), io.StringIO()
        # The command takes Ctrl-C for itself, and would keep it.
        before = {kind: signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)}
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = main(words)
        for kind, handler in before.items():
            signal.signal(kind, handler)
        assert status == 0, wrong.getvalue()
    return folder
