"""The commands `st evaluate`, `st calibrate` and `st course`: score predictions, calibrate bands, build courses."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from . import _options as shared

if TYPE_CHECKING:
    from st_offline.evaluation.work import Task

MODELS: Any = ("kinematic", "linear", "nonlinear")


@dataclass(frozen=True)
class PredictionOptions:
    """Options for predictions from recordings, as given by the user; one field per option."""

    model: Annotated[list[str], typer.Option(
        help="kinematic, linear, nonlinear, or a model file (.yaml); repeatable.")] = MODELS
    effects: shared.ModelEffects = None
    acceleration: Annotated[Literal["causal", "zero-phase"], typer.Option(
        help="Filter of the forward speed before it is differentiated; live, only causal is possible.")] = "causal"
    inputs: Annotated[Literal["interpolate", "hold"], typer.Option(
        help="Measured inputs within an integration step: interpolated, or held over it.")] = "interpolate"
    horizon: Annotated[float, typer.Option(help="Length of a prediction, s; a whole number of steps.")] = 5.0
    step: Annotated[float, typer.Option(help="Integration step, s.")] = 0.05
    minimum_speed: Annotated[float, typer.Option(help="No prediction starts below this speed, m/s.")] = 0.5

    def make_task(self, read_options: shared.ReadOptions, interval: float = 0.1,
                  **others: Any) -> "tuple[Task, Path | None]":
        """The task, and the vehicle file of the options, if any. interval: between starts [s]. others: as for Task."""
        from st_core.effects import load_folder
        from st_core.log_evaluation import EvaluationSettings
        from st_core.prediction import PredictionSettings
        from st_offline.evaluation.work import Task
        from st_recordings.car import read_model_file

        prediction = PredictionSettings(horizon=self.horizon, step=self.step, minimum_speed=self.minimum_speed)
        filtering: Literal["causal", "zero_phase"] = "zero_phase" if self.acceleration == "zero-phase" else "causal"
        settings = EvaluationSettings(prediction, interval, filtering, self.inputs)
        if self.effects is not None:
            load_folder(str(self.effects.absolute()))
        models = {name: read_model_file(name) if name.endswith((".yaml", ".yml")) else None for name in self.model}
        vehicle, read_settings = read_options.resolve()
        embedded = [(file.vehicle, name) for name, file in models.items() if file and file.vehicle]
        parameters, vehicle_file = embedded[0] if embedded and not vehicle else shared.load_vehicle_or_default(vehicle)
        task = Task(parameters, models, settings, read_settings, vehicle_file=str(vehicle_file), effects=self.effects,
                    **others)
        return task, vehicle


@shared.expand_options(shared.ReadOptions)
@shared.expand_options(PredictionOptions)
def evaluate(
    runs: shared.Runs,
    prediction_options: PredictionOptions = PredictionOptions(),
    output: Path | None = typer.Option(None, help="Folder for the results; default runs/evaluate-<time>."),
    at: str = typer.Option("", help="Starts of the predictions to draw in detail, s, such as 1,10,19; default: four."),
    table: Literal["means", "samples"] = typer.Option(
        "means", help="Error statistics over the mean errors of the predictions, or over all samples."),
    interval: float = typer.Option(0.1, help="Time between the starts of predictions, s."),
    figures: str = typer.Option("png,pdf", help="Formats of the figure files; empty: none."),
    bands: Path | None = typer.Option(
        None, help="Bands of `st calibrate` to test on these runs: coverage, scores, reliability.", **shared.FILE),
    adaptive: bool = typer.Option(
        False, "--adaptive", help="Also test bands that adapt to the errors of each run; initially those of --bands, "
        "if given."),
    course: Path | None = typer.Option(
        None, help="Course of `st course build`: also predict with its curvature and speed.", **shared.FILE),
    advise: float | None = typer.Option(
        None, help="Permitted lateral error, m: also report the cheapest model and step that meet it, by speed and "
        "prediction time, with cost, error and band width of each.", callback=shared.in_range(0.001, "m", 100.0)),
    force: bool = typer.Option(False, "--force", help="Also evaluate runs in which `st check` finds an error."),
    workers: int = typer.Option(1, help="Number of runs evaluated in parallel (Dask).", min=1),
    scheduler: str | None = typer.Option(None, help="Address of a Dask scheduler to use instead of --workers."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Predict with each model every --interval seconds, score the predictions, and write tables and figures.

    Unusable runs are reported and skipped. Exit status: 0 all runs evaluated, 1 some runs skipped, 2 no run evaluated.
    """
    from st_core.bands import Bands
    from st_core.course import Course
    from st_offline.evaluation.evaluation_command import run_command
    from st_offline.evaluation.work import check_bands, load_models
    from st_recordings.car import read_text

    try:
        starts = tuple(map(float, shared.split_names(at)))
    except ValueError:
        raise typer.BadParameter(f"--at {at!r}: expected comma-separated seconds") from None
    parsed_bands, parsed_course = (file and (str(file), kind.from_yaml(read_text(file), str(file)))
                                   for file, kind in ((bands, Bands), (course, Course)))
    task, vehicle = prediction_options.make_task(
        read_options, interval, over=table, force=force, starts=starts,
        formats=shared.split_names(figures), bands=parsed_bands, adaptive=adaptive, course=parsed_course)
    check_bands(task, load_models(task))
    status = run_command(runs, task, output, workers, scheduler, advise)
    shared.report_default_car("evaluate", vehicle, task.vehicle_file)
    return status


@shared.expand_options(shared.ReadOptions)
@shared.expand_options(PredictionOptions)
def calibrate(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of one car: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False),
    prediction_options: PredictionOptions = PredictionOptions(),
    output: Path = typer.Option(Path("bands.yaml"), help="File for the bands; it must not exist."),
    level: list[float] = typer.Option(
        [0.5, 0.9], "--level", help="Fraction of measured paths entirely inside the band; repeatable. n runs allow at "
        "most n/(n + 1): 9 runs for 0.9."),
    together: bool = typer.Option(
        False, "--together", help="Count the recordings of one argument, for example of one day, as one run, because "
        "they are dependent."),
    force: bool = typer.Option(False, "--force", help="Also use runs in which `st check` finds an error."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Calibrate bands around the predicted path that contain the measured path of a new drive with a given probability.

    Each model gets bands for measured inputs (hindsight) and held inputs (forecast). Test them on other drives with
    `st evaluate --bands`. Exit status: 0 all runs used, 1 some runs not used, 2 no bands could be calibrated.
    """
    from st_offline.bands.calibration_command import run_command

    task, vehicle = prediction_options.make_task(read_options, force=force)
    status = run_command(runs, task, output, sorted(set(level)), together)
    shared.report_default_car("calibrate", vehicle, task.vehicle_file)
    return status


@shared.expand_options(shared.ReadOptions)
def course(
    action: Literal["build"] = typer.Argument(..., help="The action: build.", show_default=False),
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of drives at one site: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False),
    output: Path = typer.Option(Path("course.yaml"), "--output", "-o", help="File for the course; it must not exist."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Build a course: speed and curvature along recorded paths, which may contain laps, both directions and branches.

    Use it with `st evaluate --course`. Exit status: 0 all runs used, 1 some runs not used, 2 no course could be built.
    """
    from st_offline.course_command import build_course

    vehicle, read_settings = read_options.resolve()
    parameters, _ = shared.load_vehicle_or_default(vehicle)
    return build_course(runs, parameters, read_settings, output)
