"""`st check`: what is wrong with a recording, before a model is blamed for it."""

from pathlib import Path

import typer
from st_recordings.paths import config

from ._options import (
    CarName,
    Dbc,
    InsCanLatency,
    Offset,
    Signals,
    SteeringLatency,
    SteeringSign,
    VehicleFile,
    say_whose,
    whose,
)


def check(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.", show_default=False
    ),
    car: CarName = None,
    vehicle: VehicleFile = None,
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/check-<time>."),
    json: Path | None = typer.Option(None, "--json", help="File of the numbers; default check.json in that folder.",
                                     dir_okay=False),
    propose_cure: Path | None = typer.Option(
        None, help="Write a run.yaml that corrects the findings; for a single run.", dir_okay=False
    ),
    offset: Offset = None,
    ins_can_latency: InsCanLatency = None,
    dbc: Dbc = None,
    signals: Signals = None,
    steering_sign: SteeringSign = None,
    steering_latency: SteeringLatency = None,
) -> None:
    """Find what is wrong with recordings: units, signs, clocks, axes, projections, reference points, sensors.

    Nothing is corrected; each finding says what cures it. Exit status: 0 no error was found, 1 one was, or a run could
    not be read, 2 nothing could be read.
    """
    # Imported when it runs: the drawing libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.errors import StCoreError
    from st_core.vehicle import VehicleParameters
    from st_offline.checking.command import CommandError, Job, run_command
    from st_recordings.output import OutputError
    from st_recordings.runs import RunError

    try:
        vehicle, read = whose(car, vehicle, dbc, signals, steering_sign, steering_latency, offset=offset,
                              ins_can_latency=ins_can_latency)
        file = vehicle or config("car/leaf/vehicle.yaml")
        job = Job(
            runs, VehicleParameters.from_yaml(file.read_text(encoding="utf-8"), str(file)), str(file),
            vehicle is not None,
            read, output, json, propose_cure)
        status = run_command(job, Console(), lambda file: say_whose("check", file))
    except (StCoreError, CommandError, OutputError, RunError, UnicodeDecodeError) as error:
        typer.echo(f"st check: {error}", err=True)
        raise typer.Exit(2) from None
    raise typer.Exit(status)
