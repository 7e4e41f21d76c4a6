"""`st discover`: name the physical effect that the model lacks."""

from pathlib import Path

import typer

from ..paths import config


def discover(
    runs: list[Path] = typer.Argument(
        ..., help="Recordings: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.", show_default=False
    ),
    reference: list[Path] = typer.Option(
        [], "--reference", help="Drives of the healthy car; a folder, or repeat the option for several."
    ),
    base: str = typer.Option("nonlinear", help="kinematic, linear, nonlinear, or a model file (.yaml)."),
    vehicle: Path | None = typer.Option(
        None, help="Vehicle file; default config/vehicle/leaf.yaml.", exists=True, dir_okay=False
    ),
    output: Path | None = typer.Option(None, help="Folder of the results; default runs/discover-<time>."),
    channels: str = typer.Option(
        "velocity_y,yaw_rate,acceleration_y,yaw,position", help="Measurements to use, with commas between."
    ),
    effects: Path | None = typer.Option(
        None, help="Folder of own effects that take part.", exists=True, file_okay=False
    ),
    seed: int = typer.Option(0, help="Of the resampling."),
    jobs: int = typer.Option(1, help="Runs read side by side.", min=1),
    figures: str = typer.Option("png,pdf", help="Formats of the figure files; an empty text for none."),
    report: bool = typer.Option(True, help="Draw the figures and the page; without, numbers and model file only."),
    offset: float | None = typer.Option(None, help="INS minus CAN clock, s, by hand; default: found in the signals."),
    dbc: Path | None = typer.Option(None, help="DBC of the CAN logs.", exists=True, dir_okay=False),
    signals: Path | None = typer.Option(None, help="Signal table of the CAN logs.", exists=True, dir_okay=False),
    steering_latency: float = typer.Option(0.0, help="s, from the turn of the wheel to the frame in the log."),
    force: bool = typer.Option(False, "--force", help="Use also runs in which `st check` finds an error."),
    fresh: bool = typer.Option(False, "--fresh", help="Read all files anew, not what is kept of an earlier start."),
) -> None:
    """Find where model and measurement disagree, name the missing effect, add it, show the gap shrink.

    Exit status: 0 answered from all runs, 1 some could not be used, 2 nothing could be started.
    """
    # Imported when it runs: the drawing libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_core.discovery import DiscoverySettings
    from st_core.errors import StCoreError
    from st_core.vehicle import VehicleParameters

    from ..discovery.command import CommandError, Job, run_command
    from ..output import OutputError
    from ..runs import ReadSettings

    file = vehicle or config("vehicle/leaf.yaml")
    try:
        job = Job(
            runs, reference, base, VehicleParameters.from_yaml(file.read_text(encoding="utf-8"), str(file)), str(file),
            DiscoverySettings(channels=tuple(_parts(channels)), seed=seed),
            ReadSettings(dbc=dbc, signals=signals, steering_latency=steering_latency, offset=offset),
            effects, output, jobs, tuple(_parts(figures)), report, not fresh, force)
        status = run_command(job, Console())
    except (StCoreError, CommandError, OutputError, UnicodeDecodeError) as error:
        typer.echo(f"st discover: {error}", err=True)
        raise typer.Exit(2) from None
    raise typer.Exit(status)


def _parts(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]
