"""`st identify`: parameters of the vehicle file from experiments and from driving."""

from pathlib import Path

import typer

from ._options import (
    LEAF,
    CarName,
    Dbc,
    Offset,
    Signals,
    SteeringLatency,
    SteeringSign,
    VehicleFile,
    say_whose,
    whose,
)


def identify(
    what: str | None = typer.Argument(None, help="One of the experiments; without it they are listed."),
    files: list[Path] = typer.Argument(None, help="Data of the experiment: tables (CSV) or recordings."),
    car: CarName = None,
    vehicle: VehicleFile = None,
    model: Path | None = typer.Option(
        None, help="Model file used to predict drives, instead of nonlinear; its effects are not changed.",
        exists=True, dir_okay=False
    ),
    effects: Path | None = typer.Option(
        None, help="Folder of your own effects that --model uses.", exists=True, file_okay=False
    ),
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/identify-<what>-<time>."),
    force: bool = typer.Option(False, "--force", help="Also use drives in which `st check` finds an error."),
    seed: int = typer.Option(0, help="Seed of the bootstrap."),
    offset: Offset = None,
    dbc: Dbc = None,
    signals: Signals = None,
    steering_sign: SteeringSign = None,
    steering_latency: SteeringLatency = None,
) -> None:
    """Identify parameters: value, uncertainty, verdict; a figure, a report, and a vehicle file with provenance.

    The vehicle file given stays as it is; the new one is vehicle.yaml in the output folder. Exit status: 0 something
    was identified, 1 nothing could be, 2 the data cannot be used.
    """
    # Imported when it runs: the drawing libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from rich.table import Table
    from st_core.errors import StCoreError
    from st_core.vehicle import VehicleParameters
    from st_live.fourth_model import known_model
    from st_live.suite import SuiteError
    from st_offline.identification.command import Job, run
    from st_offline.identification.experiment import Setup
    from st_offline.identification.experiments import EXPERIMENTS
    from st_recordings.output import OutputError, new_folder
    from st_recordings.runs import RunError

    console = Console()
    if what is None:
        table = Table("what", "identifies", "from", box=None)
        for one in EXPERIMENTS.values():
            table.add_row(one.name, one.what, one.files)
        console.print(table)
        return
    if what not in EXPERIMENTS:
        typer.echo(f"st identify: no experiment {what!r}; there are {', '.join(EXPERIMENTS)}", err=True)
        raise typer.Exit(2)
    try:
        vehicle, read = whose(car, vehicle, dbc, signals, steering_sign, steering_latency, offset=offset)
        file = vehicle or LEAF
        parameters = VehicleParameters.from_yaml(file.read_text(encoding="utf-8"), str(file))
        folder = new_folder(output, f"identify-{what}", create=False)
        base = known_model(model, effects, parameters, str(file))
        job = Job(EXPERIMENTS[what], tuple(files or ()), Setup(parameters, seed, read, force, base), str(file), folder)
        status = run(job, console)
    except (StCoreError, RunError, OutputError, SuiteError, UnicodeDecodeError) as error:
        typer.echo(f"st identify {what}: {error}", err=True)
        raise typer.Exit(2) from None
    if vehicle is None:
        say_whose("identify", file)
    raise typer.Exit(status)
