"""The commands `st calibrate` and `st course`: make bands and courses from recorded drives."""

from pathlib import Path
from typing import Literal

import typer

from . import _options as shared
from .evaluate import PredictionOptions


@shared.expand_options(shared.ReadOptions)
@shared.expand_options(PredictionOptions)
def calibrate(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of one car: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False),
    prediction_options: PredictionOptions = PredictionOptions(),
    output: Path = typer.Option(Path("bands.yaml"), help="File of the bands; it must not exist."),
    level: list[float] = typer.Option(
        [0.5, 0.9], "--level", help="Fraction of paths entirely inside the band; repeatable. n runs allow at most "
        "n/(n + 1): 9 runs for 0.9."),
    together: bool = typer.Option(
        False, "--together", help="Recordings of one argument (one day or site) are dependent and count as one run."),
    force: bool = typer.Option(False, "--force", help="Also use runs in which `st check` finds an error."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Calibrate bands around the predicted path that contain the measured path of a new drive with a given probability.

    For every model, with measured inputs (hindsight) and with held inputs (forecast). Test them on other drives with
    `st evaluate --bands`. Exit status: 0 all runs used, 1 some not, 2 no bands could be calibrated.
    """
    from st_offline.bands.calibration_command import run_command

    with shared.report_errors("calibrate"):
        task, vehicle = prediction_options.make_task(read_options, force=force)
        status = run_command(runs, task, output, sorted(set(level)), together, shared.console)
    shared.report_default_car("calibrate", vehicle, task.vehicle_file)
    raise typer.Exit(status)


@shared.expand_options(shared.ReadOptions)
def course(
    what: Literal["build"] = typer.Argument(..., help="The action: build.", show_default=False),
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of drives at one site: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False),
    output: Path = typer.Option(Path("course.yaml"), "--output", "-o", help="File of the course; it must not exist."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Build a course: speed and curvature along recorded paths, which may contain laps, both directions and branches.

    Use it with `st evaluate --course`. Exit status: 0 all runs used, 1 some not, 2 no course could be built.
    """
    from st_offline.course_command import build_course

    with shared.report_errors("course"):
        vehicle, read_settings = read_options.resolve()
        parameters, _ = shared.load_vehicle_or_default(vehicle)
        status = build_course(runs, parameters, read_settings, output, shared.console)
    raise typer.Exit(status)
