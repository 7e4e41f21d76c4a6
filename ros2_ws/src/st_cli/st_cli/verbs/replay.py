"""`st replay`: a recording through the real nodes."""

from pathlib import Path

import typer

from ._options import (
    CarName,
    SteeringIs,
    SteeringPath,
    SteeringTopic,
    foreign_steering,
    say_whose_bag,
    whose,
)


def replay(
    bag: Path = typer.Argument(..., help="A recording with odometry and steering (rosbag2).", exists=True),
    steering_topic: SteeringTopic = None,
    steering_field: SteeringPath = "data",
    steering_is: SteeringIs = "road",
    rate: float = typer.Option(1.0, help="Times as fast as it was recorded.", min=0.05, max=100.0),
    fast: bool = typer.Option(False, "--fast", help="As fast as predictor and evaluator follow."),
    car: CarName = None,
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default that of --car, else the one in the recording, else the Leaf's.", exists=True,
        dir_okay=False
    ),
    force: bool = typer.Option(False, "--force", help="Also where `st check` finds an error in the recording."),
    bands: Path | None = typer.Option(
        None, help="Bands around every prediction (bands.yaml of `st calibrate`).", exists=True, dir_okay=False
    ),
    view: bool = typer.Option(False, "--view", help="Show it live in the browser, served on this machine only."),
    view_save: Path | None = typer.Option(None, help="Write the live view to this file (.rrd), for `st view`."),
    output: Path | None = typer.Option(None, help="Folder of the run; default runs/replay-<time>."),
) -> None:
    """Play a recording through predictor, evaluator and recorder on its own clock; record what they say now."""
    # Imported when it runs: the ROS libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.errors import StCoreError
    from st_live.report import conclude
    from st_live.suite import SuiteError
    from st_live.verification import replay_bag
    from st_live.view.window import finish, window
    from st_offline.checking.document import documents
    from st_offline.checking.gate import passed_bag
    from st_offline.checking.shown import say
    from st_recordings.output import OutputError, new_folder
    from st_recordings.runs import RunError

    console = Console()
    try:
        vehicle = whose(car, vehicle)[0]
        shown = window(view, view_save)
        steering = foreign_steering(steering_topic, steering_field, steering_is)
        findings = passed_bag(bag, vehicle, force, steering)
        say(bag.name, findings, console)
        say_whose_bag("replay", bag, vehicle)
        folder = new_folder(output, f"replay-{bag.stem}")
        outcome, name = replay_bag(bag, folder, vehicle, 0.0 if fast else rate, console, shown, bands, steering)
    except (RunError, StCoreError, SuiteError, OutputError) as error:
        typer.echo(f"st replay: {error}", err=True)
        raise typer.Exit(2) from None
    about = {"what": f"replay of {bag.name}", "source": str(bag), "vehicle": name,
             "findings": documents(findings)}
    status = conclude(folder, outcome, about, console)
    finish(shown, console)
    raise typer.Exit(status)
