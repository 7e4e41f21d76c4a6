"""`st course`: a map of earlier drives, from which a forecast takes what the driver will do."""

from pathlib import Path
from typing import Literal

import typer

from . import _options as shared


@shared.reads_recordings()
def course(
    what: Literal["build"] = typer.Argument(..., help="build.", show_default=False),
    runs: list[Path] = typer.Argument(
        ..., help="Recordings of drives at one place: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.",
        show_default=False
    ),
    output: Path = typer.Option(Path("course.yaml"), "--output", "-o", help="File of the course; it must not exist."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> None:
    """Build a course: speed and curvature along the way of recorded drives, laps, both directions and branches.

    Use it with `st evaluate --course`. Exit status: 0 all runs used, 1 some not, 2 no course could be built.
    """
    # Imported when it runs: the libraries take a second that `st --help` need not wait.
    from rich.console import Console
    from st_offline.course_command import build_course

    with shared.refusals("course"):
        vehicle, reading = read_options.resolve()
        parameters, _ = shared.load_vehicle_or_default(vehicle)
        status = build_course(runs, parameters, reading, output, Console())
    raise typer.Exit(status)
