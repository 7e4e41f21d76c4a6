"""docs/gallery.md and its pictures: a drive of the virtual Leaf through the verbs, each picture beside its command."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from st_recordings.car import read_vehicle
from st_recordings.paths import config

from .animation import animate

LEAF = (sys.executable, "-m", "st_sim.run")
ANIMATED = (24.0, 38.0)  # s of the drive


class GalleryError(RuntimeError):
    """A command of the gallery failed; the text holds its last words."""


@dataclass(frozen=True)
class Exhibit:
    """command: as a user types it, {} for the folder of the gallery. picture: where it leaves the picture shown.

    before: commands that make what it needs.
    """

    title: str
    command: str
    picture: str
    words: str
    before: tuple[str, ...] = ()


SIMULATE = "./st shell -- python -m st_sim.run --vehicle config/vehicle/leaf.yaml "
EXHIBITS = (
    Exhibit("A drive through the live nodes", "./st replay {}/bag --fast --output {}/run", "run/paths.png",
            "Measured track, predictions from six starts, and the errors of every start. Hindsight simulates with the "
            "inputs measured afterwards; forecast holds them.",
            (SIMULATE + "--scenario S6 --duration 62 --to-files {}/raw",
             "./st import {}/raw --offset 0 --output {}/bag")),
    Exhibit("Two clocks synchronised", "./st align {}/raw/run.ncom {}/raw/run.log --output {}/align",
            "align/alignment.png", "The same signals from INS and CAN, before and after. The remaining difference is "
            "the uncertainty of the offset."),
    Exhibit("A real drive evaluated at the desk", "./st evaluate examples/data/rfs_turn_a.csv "
            "--vehicle config/vehicle/hyundai_genesis.yaml --output {}/evaluate",
            "evaluate/**/horizon_means.png", "The error of every start over the drive, as in the paper. The folder "
            "also contains the page report.html with sortable tables."),
    Exhibit("A parameter identified", "./st identify steering-ratio docs/examples/identification/steering_ratio.csv "
            "--vehicle config/vehicle/leaf.yaml --output {}/identify", "identify/steering-ratio.png",
            "Turntable readings, one ratio fitted through all sweeps, and the residuals of the line."),
    Exhibit("What is missing from a vehicle file and the sensors", "./st discover examples/data "
            "--vehicle config/vehicle/hyundai_genesis.yaml --output {}/discover", "discover/figures/waterfall.png",
            "Two recorded drives and a vehicle file, without reference drives. The page report.html says what is "
            "missing, how certain that is, whether it is the same everywhere, and what to do."),
)


def page() -> str:
    """The text of gallery.md."""
    lines = ["# Gallery", "",
             "See what each command draws, for a drive of the virtual Leaf (S6, U-turns) and a short real drive of "
             "another car ([examples/data](../examples/data/README.md)). `./st docs --gallery` renews this page.",
             "", "## Seen live", "",
             "From the driver's seat: current predictions, predictions made one to five seconds ago, and the "
             "path driven.", "", "![Predicted paths bend with the steering](images/gallery_drive.webp)"]
    for number, exhibit in enumerate(EXHIBITS, 1):
        commands = (f"$ {_shown(command)}" for command in (*exhibit.before, exhibit.command))
        lines += ["", f"## {exhibit.title}", "", "```console", *commands, "```", "", exhibit.words, "",
                  f"![{exhibit.title}](images/gallery_{number}.png)"]
    return "\n".join(lines) + "\n"


def draw(folder: Path, st: Sequence[str], console: Console) -> None:
    """Drive, run the commands, and write their pictures and the animation into `folder`.

    st: how the command is called. Raises GalleryError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="st-gallery-") as name:
        for number, exhibit in enumerate(EXHIBITS, 1):
            for command in (*exhibit.before, exhibit.command):
                _run(command, name, st, console)
            found = sorted(Path(name).glob(exhibit.picture))
            if not found:
                raise GalleryError(f"{exhibit.command} left no {exhibit.picture}")
            shutil.copyfile(found[0], folder / f"gallery_{number}.png")
        animate(Path(name, "run"), read_vehicle(config("vehicle/leaf.yaml")), folder / "gallery_drive.webp", *ANIMATED)


def _shown(command: str) -> str:
    return command.replace("{}", "runs/gallery")


def _run(command: str, folder: str, st: Sequence[str], console: Console) -> None:
    console.print(f"$ {_shown(command)}", highlight=False, soft_wrap=True)
    words = command.replace("{}", folder).split()
    program = LEAF if words[1] == "shell" else st
    rest = words[6:] if words[1] == "shell" else words[1:]
    done = subprocess.run([*program, *rest], capture_output=True, text=True, check=False)
    if done.returncode:
        raise GalleryError(f"{command}: status {done.returncode}: {(done.stderr or done.stdout).strip()[-500:]}")
