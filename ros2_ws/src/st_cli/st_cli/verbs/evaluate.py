"""The command `st evaluate`: makes the table and figures of the paper from recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from . import _options as shared

if TYPE_CHECKING:
    from st_core.prediction import PredictionSettings
    from st_core.vehicle import VehicleParameters
    from st_offline.evaluation.work import Task

MODELS = ["kinematic", "linear", "nonlinear"]


@shared.expand_options(shared.ReadOptions)
def evaluate(
    runs: shared.Runs,
    model: shared.Models = MODELS,
    effects: shared.EffectsOfFile = None,
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/evaluate-<time>."),
    at: str = typer.Option("", help="Starts of the predictions drawn in detail, s: 1,10,19,28; default: four."),
    acceleration: shared.Filtering = "causal",
    inputs: shared.Inputs = "interpolate",
    table: Literal["means", "samples"] = typer.Option(
        "means", help="Error statistics: of the means over each horizon, as in the paper, or of all samples."),
    horizon: shared.Horizon = 5.0,
    step: shared.Step = 0.05,
    interval: float = typer.Option(0.1, help="Time between starts, s."),
    minimum_speed: shared.MinimumSpeed = 0.5,
    figures: str = typer.Option("png,pdf", help="Formats of the figure files; empty: none."),
    bands: Path | None = typer.Option(
        None, help="Bands of `st calibrate` to test on these runs: coverage, scores, reliability.", **shared.FILE),
    adaptive: bool = typer.Option(
        False, "--adaptive", help="Also test bands that adapt to the errors of each run; initially those of --bands, "
        "if given."),
    course: Path | None = typer.Option(
        None, help="Course of `st course build`: also predict with the inputs recorded on this course before.",
        **shared.FILE),
    advise: float | None = typer.Option(
        None, help="Permitted lateral error, m: also report the cheapest model and step that meet it, by speed and "
        "prediction time, with cost, error and band width of each.", min=0.001),
    force: bool = typer.Option(False, "--force", help="Also evaluate runs in which `st check` finds an error."),
    workers: int = typer.Option(1, help="Number of runs evaluated in parallel (Dask).", min=1),
    scheduler: str | None = typer.Option(None, help="Address of a Dask scheduler instead."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Predict every --interval s of each run with each model, score the predictions, and write tables and figures.

    Unusable runs are reported and skipped. Exit status: 0 all runs evaluated, 1 some not, 2 none.
    """
    from st_core.bands import Bands
    from st_core.course import Course
    from st_core.prediction import PredictionSettings
    from st_offline.evaluation.evaluation_command import run_command
    from st_offline.evaluation.work import check_bands, load_models

    with shared.report_errors("evaluate"):
        prediction = PredictionSettings(horizon=horizon, step=step, minimum_speed=minimum_speed)
        parsed_bands, parsed_course = (file and (str(file), kind.from_yaml(file.read_text(encoding="utf-8"), str(file)))
                                       for file, kind in ((bands, Bands), (course, Course)))
        task, vehicle = make_task(
            read_options, model, effects, prediction, acceleration, inputs, interval, over=table, force=force,
            starts=_parse_seconds(at), formats=shared.split_names(figures), bands=parsed_bands, adaptive=adaptive,
            course=parsed_course)
        check_bands(task, load_models(task))
        status = run_command(runs, task, output, workers, scheduler, shared.console, advise)
    shared.report_default_car("evaluate", vehicle, task.vehicle_file)
    raise typer.Exit(status)


def make_task(read_options: shared.ReadOptions, model: Sequence[str], effects: Path | None,
              prediction: "PredictionSettings", acceleration: str, inputs: Literal["interpolate", "hold"],
              interval: float = 0.1, **others: Any) -> "tuple[Task, Path | None]":
    """(task, vehicle file that the user named or None). interval: between the starts [s]. others: fields of Task."""
    from st_core.log_evaluation import EvaluationSettings
    from st_offline.evaluation.work import Task

    filtering: Literal["causal", "zero_phase"] = "zero_phase" if acceleration == "zero-phase" else "causal"
    models = tuple(read_model(name) for name in dict.fromkeys(model))
    vehicle, read_settings = read_options.resolve()
    parameters, vehicle_origin = resolve_vehicle(vehicle, models, effects)
    settings = EvaluationSettings(prediction, interval, filtering, inputs)
    task = Task(parameters, models, settings, read_settings, vehicle_file=vehicle_origin, effects=effects, **others)
    return task, vehicle


def read_model(name: str) -> str | tuple[str, str]:
    """The name of a model, or (file, content), because remote workers may have no access to the file."""
    if not name.endswith((".yaml", ".yml")):
        return name
    try:
        return name, Path(name).read_text()
    except OSError as error:
        raise typer.BadParameter(f"--model {name}: {error.strerror}") from None


def resolve_vehicle(vehicle: Path | None, models: Sequence[str | tuple[str, str]],
                    effects: Path | None = None) -> tuple["VehicleParameters", str]:
    """(vehicle parameters, their file): from the vehicle file, else from a model file, else those of the Leaf.

    effects: folder of user-defined effects in the model files, which is loaded.
    """
    from st_core.effects import load_folder
    from st_core.model_file import ModelFile

    if effects is not None:
        load_folder(str(effects.absolute()))
    if vehicle is None:
        for origin, text in (model for model in models if not isinstance(model, str)):
            embedded = ModelFile.from_yaml(text, origin).vehicle
            if embedded is not None:
                return embedded, origin
    parameters, file = shared.load_vehicle_or_default(vehicle)
    return parameters, str(file)


def _parse_seconds(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in shared.split_names(text))
    except ValueError:
        raise typer.BadParameter(f"--at {text!r}: expected comma-separated seconds") from None
