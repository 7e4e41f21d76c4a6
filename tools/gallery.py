"""Writes docs/gallery.md, and draws its pictures with commands on drives of the virtual Leaf and of a real car."""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from rich.console import Console
from st_core.palette import FIGURE_STYLE, MEASURED_COLOUR, MODEL_COLOUR
from st_core.types import cg_to_ins_position, map_to_body
from st_core.vehicle import VehicleParameters
from st_predictor.map_drawing import Pose, make_car_outline
from st_recordings.car import read_vehicle
from st_recordings.paths import config
from st_recordings.results import Predictions, Results, read_predictions, read_results

ST, VIRTUAL_LEAF = (sys.executable, "-m", "st_cli.cli"), (sys.executable, "-m", "st_sim.run")
INTERVAL = (24.0, 38.0)  # s, part of the drive that the animation shows
FRAMES_PER_SECOND = 5
SIZE, DPI = (8.0, 4.2), 80
GHOST_AGES = (1.0, 2.0, 3.0, 4.0, 5.0)  # s, of the earlier predictions that are drawn
AHEAD, BEHIND, ASIDE = 34.0, 16.0, 30.0  # m, range that is visible around the car


class GalleryError(RuntimeError):
    """A command of the gallery failed; the message contains the end of its output."""


@dataclass(frozen=True)
class Exhibit:
    """A command and the picture it draws.

    command: as a user types it, with {} for the folder of the gallery. picture: file that it draws. preparation:
    commands that write its input.
    """

    title: str
    command: str
    picture: str
    text: str
    preparation: tuple[str, ...] = ()


SIMULATE = "./st shell -- python -m st_sim.run --vehicle config/vehicle/leaf.yaml "
EXHIBITS = (
    Exhibit("A drive through the live nodes", "./st replay {}/bag --fast --output {}/run", "run/paths.png",
            "Measured track, predictions from six starts, and the errors of every start. Hindsight simulates with the "
            "inputs measured afterwards; forecast holds them.",
            (SIMULATE + "--scenario S6 --duration 62 --to-files {}/raw",
             "./st import {}/raw --offset 0 --output {}/bag")),
    Exhibit("Two clocks synchronised", "./st align {}/raw/run.ncom {}/raw/run.log --output {}/align",
            "align/alignment.png", "The same signals from INS and CAN, aligned. The remaining difference is "
            "the uncertainty of the offset."),
    Exhibit("A real drive evaluated offline", "./st evaluate examples/data/rfs_turn_a.csv "
            "--vehicle config/vehicle/hyundai_genesis.yaml --output {}/evaluate",
            "evaluate/**/horizon_means.png", "The error of every start over the drive, as in the paper. The folder "
            "also contains the page report.html with sortable tables."),
    Exhibit("A parameter identified", "./st identify steering-ratio docs/examples/identification/steering_ratio.csv "
            "--vehicle config/vehicle/leaf.yaml --output {}/identify", "identify/steering-ratio.png",
            "Turntable readings, one ratio fitted through all sweeps, and the residuals of the line."),
    Exhibit("What is missing from a vehicle file and the sensors", "./st discover examples/data "
            "--vehicle config/vehicle/hyundai_genesis.yaml --output {}/discover", "discover/figures/waterfall.png",
            "Three recorded drives and a vehicle file, without reference drives. The page report.html states what is "
            "missing, how certain that is, whether it is the same everywhere, and what to do."),
)


def make_gallery_page() -> str:
    """Text of gallery.md."""
    lines = ["# Gallery", "",
             "See what each command draws, for a drive of the virtual Leaf (S6, U-turns) and a short real drive of "
             "another car ([examples/data](../examples/data/README.md)). `./st docs --gallery` regenerates this page.",
             "", "## Live view", "",
             "From the driver's seat: current predictions, predictions made one to five seconds ago, and the "
             "path driven.", "", "![Predicted paths bend with the steering](images/gallery_drive.webp)"]
    for number, exhibit in enumerate(EXHIBITS, 1):
        commands = (f"$ {_format_command(command)}" for command in (*exhibit.preparation, exhibit.command))
        lines += ["", f"## {exhibit.title}", "", "```console", *commands, "```", "", exhibit.text, "",
                  f"![{exhibit.title}](images/gallery_{number}.png)"]
    return "\n".join(lines) + "\n"


def draw_gallery(folder: Path, console: Console) -> None:
    """Run the commands and write their pictures and the animation into `folder`. Raises GalleryError."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="st-gallery-") as name:
        for number, exhibit in enumerate(EXHIBITS, 1):
            for command in (*exhibit.preparation, exhibit.command):
                _run_command(command, name, console)
            pictures = sorted(Path(name).glob(exhibit.picture))
            if not pictures:
                raise GalleryError(f"{exhibit.command} wrote no {exhibit.picture}")
            shutil.copyfile(pictures[0], folder / f"gallery_{number}.png")
        animate(Path(name, "run"), read_vehicle(config("vehicle/leaf.yaml")), folder / "gallery_drive.webp", *INTERVAL)


def _format_command(command: str) -> str:
    return command.replace("{}", "runs/gallery")


def _run_command(command: str, folder: str, console: Console) -> None:
    console.print(f"$ {_format_command(command)}", highlight=False, soft_wrap=True)
    words = command.replace("{}", folder).split()
    program = VIRTUAL_LEAF if words[1] == "shell" else ST
    rest = words[6:] if words[1] == "shell" else words[1:]
    result = subprocess.run([*program, *rest], capture_output=True, text=True, check=False)
    if result.returncode:
        raise GalleryError(f"{command}: status {result.returncode}: {(result.stderr or result.stdout).strip()[-500:]}")


def animate(run: Path, car: VehicleParameters, file: Path, first: float, last: float) -> int:
    """Write seconds `first` to `last` of a run folder as WebP or GIF, and return the number of frames."""
    results, predictions = read_results(run), read_predictions(run / "bag")
    run_start_ns = int(results.track.time_ns[0])
    frames = []
    with plt.rc_context(FIGURE_STYLE):
        for seconds in np.arange(first, last, 1.0 / FRAMES_PER_SECOND):
            frames.append(_draw_frame(results, predictions, car, run_start_ns, seconds, first, last))
    duration = round(1000 / FRAMES_PER_SECOND)
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=60, method=2)
    return len(frames)


def _draw_frame(results: Results, predictions: dict[str, Predictions], car: VehicleParameters, run_start_ns: int,
                seconds: float, first: float, last: float) -> Image.Image:
    figure, (scene, errors) = plt.subplots(1, 2, figsize=SIZE, dpi=DPI, width_ratios=(1.0, 1.0))
    now_ns = run_start_ns + round(seconds * 1e9)
    track = results.track
    here_x, here_y, yaw = (float(np.interp(now_ns, track.time_ns, v)) for v in (track.x, track.y, track.yaw))

    def draw(x: np.ndarray, y: np.ndarray, **style: object) -> None:
        forward, left = map_to_body(np.asarray(x) - here_x, np.asarray(y) - here_y, yaw)
        scene.plot(-left, forward, **style)

    is_past = (track.time_ns <= now_ns) & (track.time_ns > now_ns - 20e9)
    draw(track.x[is_past][::10], track.y[is_past][::10], color=MEASURED_COLOUR, lw=5, alpha=0.5, solid_capstyle="round")
    for model, forecasts in predictions.items():
        for age in (*reversed(GHOST_AGES), 0.0):
            path = _find_path(forecasts, car, now_ns - round(age * 1e9))
            if path is not None:
                draw(*path, color=MODEL_COLOUR[model], lw=2.2 if age == 0 else 0.8, alpha=1.0 if age == 0 else 0.35,
                     label=model if age == 0 else None)
    draw(*make_car_outline(Pose(here_x, here_y, yaw), car), color="k", lw=1.6)
    scene.set(xlim=(-ASIDE, ASIDE), ylim=(-BEHIND, AHEAD), aspect="equal", xlabel="to the right, m", ylabel="ahead, m")
    scene.set_title("predicted 5 s ahead; thin: 1 to 5 s ago; grey: driven")
    if scene.get_legend_handles_labels()[0]:
        scene.legend(loc="upper left", fontsize=8)
    for (model, mode), scores in results.scores.items():
        end = (scores.start_ns - run_start_ns) * 1e-9 + 5.0
        is_known = scores.complete & (end <= seconds)
        if mode == "hindsight":
            errors.plot(end[is_known], scores.lateral[is_known], color=MODEL_COLOUR[model])
    errors.axhline(0.0, color="k", lw=0.6)
    errors.set(xlim=(first, last), ylim=(-0.7, 0.7), xlabel="time, s", ylabel="error, m (+ = predicted left)")
    errors.set_title("mean lateral error over the last 5 s\n(hindsight: measured inputs)")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    plt.close(figure)
    return image


def _find_path(forecasts: Predictions, car: VehicleParameters, start_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Path of the INS point in the prediction nearest to an instant; None if no prediction is within 150 ms."""
    nearest = int(np.argmin(np.abs(forecasts.starts_ns - start_ns)))
    if abs(int(forecasts.starts_ns[nearest]) - start_ns) > 150_000_000:
        return None
    x, y, yaw = forecasts.states[nearest][:, [0, 1, 4]].T
    return cg_to_ins_position(x, y, yaw, car.cg_to_ins_x, car.cg_to_ins_y)
