"""`st course`: a map of earlier drives, from which a forecast takes what the driver will do."""

from pathlib import Path
from typing import Literal

import typer

from . import _options as shared


def course(
    what: Literal["build"] = typer.Argument(..., help="build.", show_default=False),
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of drives at one place: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False
    ),
    car: shared.CarName = None,
    vehicle: shared.VehicleFile = None,
    output: Path = typer.Option(Path("course.yaml"), "--output", "-o", help="File of the course; it must not exist."),
    dbc: shared.Dbc = None,
    signals: shared.Signals = None,
    steering_sign: shared.SteeringSign = None,
    steering_latency: shared.SteeringLatency = None,
    offset: shared.Offset = None,
) -> None:
    """Build a course: speed and curvature along the way of recorded drives, laps, both directions and branches.

    Use it with `st evaluate --course`. Exit status: 0 all runs used, 1 some not, 2 no course could be built.
    """
    # Imported when it runs: the libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_offline.course_command import build_course

    with shared.refusals("course"):
        named, reading = shared.whose(car, vehicle, dbc, signals, steering_sign, steering_latency, offset=offset)
        parameters, _ = shared.leaf_or(named)
        status = build_course(runs, parameters, reading, output, Console())
    raise typer.Exit(status)
