"""`st calibrate`: bands around every prediction, learnt from the errors of recorded drives."""

from pathlib import Path
from typing import Literal

import typer

from ._options import CarName, Dbc, Offset, Signals, SteeringLatency, SteeringSign, VehicleFile, say_whose, whose
from .evaluate import MODELS, car_of, model_named


def calibrate(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of one car: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False
    ),
    model: list[str] = typer.Option(
        MODELS, "--model", help="kinematic, linear, nonlinear, or a model file (augmented); repeatable."
    ),
    effects: Path | None = typer.Option(
        None, help="Folder of your own effects that a model file uses.", exists=True, file_okay=False
    ),
    car: CarName = None,
    vehicle: VehicleFile = None,
    output: Path = typer.Option(Path("bands.yaml"), help="File of the bands; it must not exist."),
    level: list[float] = typer.Option(
        [0.5, 0.9], "--level", help="Share of whole paths that shall lie inside; repeatable. n runs allow "
        "at most n/(n + 1): 9 runs for 0.9."
    ),
    together: bool = typer.Option(
        False, "--together", help="Recordings of one argument are alike, of one day or place, and count as one run."
    ),
    acceleration: Literal["causal", "zero-phase"] = typer.Option(
        "causal", help="Filter of the forward speed before its derivative; live, only causal is possible."
    ),
    inputs: Literal["interpolate", "hold"] = typer.Option(
        "interpolate", help="Measured inputs within an integration step: interpolated, or held over it."
    ),
    horizon: float = typer.Option(5.0, help="Length of a prediction, s; a whole number of steps."),
    step: float = typer.Option(0.05, help="Integration step, s."),
    minimum_speed: float = typer.Option(0.5, help="No prediction starts below this speed, m/s."),
    offset: Offset = None,
    dbc: Dbc = None,
    signals: Signals = None,
    steering_sign: SteeringSign = None,
    steering_latency: SteeringLatency = None,
    force: bool = typer.Option(False, "--force", help="Also use runs in which `st check` finds an error."),
) -> None:
    """Learn how far from its predicted path the car will be: bands that hold on drives that were not among these.

    For every model and two questions, the model alone and the forecast with inputs held. Test them on other drives with
    `st evaluate --bands`. Exit status: 0 all runs used, 1 some not, 2 no bands could be made.
    """
    # Imported when it runs: the libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.errors import StCoreError
    from st_core.log_evaluation import EvaluationSettings
    from st_core.prediction import PredictionSettings
    from st_offline.bands.command import Job, run_command
    from st_offline.evaluation.work import Task
    from st_recordings.output import OutputError
    from st_recordings.runs import RunError

    try:
        prediction = PredictionSettings(horizon=horizon, step=step, minimum_speed=minimum_speed)
        filtering: Literal["causal", "zero_phase"] = "zero_phase" if acceleration == "zero-phase" else "causal"
        models = tuple(model_named(name) for name in dict.fromkeys(model))
        vehicle, reading = whose(car, vehicle, dbc, signals, steering_sign, steering_latency, offset=offset)
        parameters, car_from = car_of(vehicle, models, effects)
        task = Task(parameters, models, EvaluationSettings(prediction, acceleration=filtering, inputs=inputs), reading,
                    force=force, effects=effects)
        status = run_command(Job(runs, task, output, tuple(sorted(set(level))), together), Console())
    except (StCoreError, RunError, OutputError, UnicodeDecodeError) as error:
        typer.echo(f"st calibrate: {error}", err=True)
        raise typer.Exit(2) from None
    if vehicle is None:
        say_whose("calibrate", car_from)
    raise typer.Exit(status)
