"""Drives of the virtual Leaf as files of its INS and CAN logger, run.ncom and run.log."""

import contextlib
import io
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path

from st_sim.run import main
from support import LEAF

# The runs provide high frequencies, longitudinal forces, and turns to both sides.
PROGRAMME = (("sweep", 26.0), ("brake_in_turn", 20.0), ("lane_change", 18.0))


def write_drives(folder: Path, effects: Mapping[str, float], seed: int,
                 programme: Sequence[tuple[str, float]] = PROGRAMME, plant: str = "realistic") -> Path:
    """Writes one run per (scenario, seconds) to folder/<scenario>/, with consecutive seeds from `seed` on."""
    for number, (scenario, seconds) in enumerate(programme):
        words = ["--vehicle", str(LEAF), "--scenario", scenario, "--duration", str(seconds), "--plant", plant, "--seed",
                 str(seed + number), "--to-files", str(folder / Path(scenario).stem)]
        words += [word for name, value in effects.items() for word in ("--effect", f"{name}={value}")]
        output, errors = io.StringIO(), io.StringIO()
        # The command installs signal handlers and does not restore the previous ones.
        before = {kind: signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)}
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            status = main(words)
        for kind, handler in before.items():
            signal.signal(kind, handler)
        assert status == 0, errors.getvalue()
    return folder
