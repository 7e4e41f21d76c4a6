"""`st calibrate`: bands around every prediction, learnt from the errors of recorded drives."""

from pathlib import Path
from typing import Literal

import typer

from . import _options as shared
from .evaluate import MODELS, car_of, model_named


@shared.reads_recordings()
def calibrate(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of one car: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False
    ),
    model: shared.Models = MODELS,
    effects: shared.EffectsOfFile = None,
    output: Path = typer.Option(Path("bands.yaml"), help="File of the bands; it must not exist."),
    level: list[float] = typer.Option(
        [0.5, 0.9], "--level", help="Share of whole paths that shall lie inside; repeatable. n runs allow "
        "at most n/(n + 1): 9 runs for 0.9."
    ),
    together: bool = typer.Option(
        False, "--together", help="Recordings of one argument are alike, of one day or place, and count as one run."
    ),
    acceleration: shared.Filtering = "causal",
    inputs: shared.Inputs = "interpolate",
    horizon: shared.Horizon = 5.0,
    step: shared.Step = 0.05,
    minimum_speed: shared.MinimumSpeed = 0.5,
    force: bool = typer.Option(False, "--force", help="Also use runs in which `st check` finds an error."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Learn how far from its predicted path the car will be: bands that hold on drives that were not among these.

    For every model and two questions, the model alone and the forecast with inputs held. Test them on other drives with
    `st evaluate --bands`. Exit status: 0 all runs used, 1 some not, 2 no bands could be made.
    """
    # Imported when it runs: the libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.log_evaluation import EvaluationSettings
    from st_core.prediction import PredictionSettings
    from st_offline.bands.calibration_command import Job, run_command
    from st_offline.evaluation.work import Task

    with shared.refusals("calibrate"):
        prediction = PredictionSettings(horizon=horizon, step=step, minimum_speed=minimum_speed)
        filtering: Literal["causal", "zero_phase"] = "zero_phase" if acceleration == "zero-phase" else "causal"
        models = tuple(model_named(name) for name in dict.fromkeys(model))
        vehicle, reading = read_options.resolve()
        parameters, car_from = car_of(vehicle, models, effects)
        task = Task(parameters, models, EvaluationSettings(prediction, acceleration=filtering, inputs=inputs), reading,
                    force=force, effects=effects)
        status = run_command(Job(runs, task, output, tuple(sorted(set(level))), together), Console())
    if vehicle is None:
        shared.report_default_car("calibrate", car_from)
    raise typer.Exit(status)
