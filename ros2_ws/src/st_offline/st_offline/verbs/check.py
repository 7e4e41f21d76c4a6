"""`st check`: what is wrong with a recording, before a model is blamed for it."""

from pathlib import Path

import typer

from ..paths import config


def check(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.", show_default=False
    ),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default the one in the recording, else config/vehicle/leaf.yaml.", exists=True,
        dir_okay=False
    ),
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/check-<time>."),
    json: Path | None = typer.Option(None, "--json", help="File of the numbers; default check.json in that folder.",
                                     dir_okay=False),
    propose_cure: Path | None = typer.Option(
        None, help="Write a run.yaml that corrects what was found, of one run.", dir_okay=False
    ),
    offset: float | None = typer.Option(None, help="INS minus CAN clock, s, by hand; default: found in the signals."),
    ins_can_latency: tuple[float, float] | None = typer.Option(
        None, help="Of the INS's own CAN frames, and its deviation, s; assumed 0.002 0.002."
    ),
    dbc: Path | None = typer.Option(None, help="DBC of the CAN logs.", exists=True, dir_okay=False),
    signals: Path | None = typer.Option(None, help="Signal table of the CAN logs.", exists=True, dir_okay=False),
    steering_sign: int = typer.Option(1, help="CAN logs: +1 where the decoded sensor is left positive; -1: right."),
    steering_latency: float = typer.Option(0.0, help="s, from the turn of the wheel to the frame in the log."),
) -> None:
    """Find what is wrong with recordings: units, signs, clocks, axes, projections, reference points, sensors.

    Nothing is corrected; each finding says what cures it. Exit status: 0 no error was found, 1 one was, or a run could
    not be read, 2 nothing could be read.
    """
    # Imported when it runs: the drawing libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.errors import StCoreError
    from st_core.vehicle import VehicleParameters

    from ..checking.command import CommandError, Job, run_command
    from ..output import OutputError
    from ..runs import ReadSettings

    file = vehicle or config("vehicle/leaf.yaml")
    if steering_sign not in (1, -1):
        typer.echo(f"st check: --steering-sign: {steering_sign} is neither 1 nor -1", err=True)
        raise typer.Exit(2)
    try:
        job = Job(
            runs, VehicleParameters.from_yaml(file.read_text(encoding="utf-8"), str(file)), str(file),
            vehicle is not None,
            ReadSettings(dbc=dbc, signals=signals, steering_sign=steering_sign, steering_latency=steering_latency,
                         offset=offset, ins_can_latency=ins_can_latency),
            output, json, propose_cure)
        status = run_command(job, Console())
    except (StCoreError, CommandError, OutputError, UnicodeDecodeError) as error:
        typer.echo(f"st check: {error}", err=True)
        raise typer.Exit(2) from None
    raise typer.Exit(status)
