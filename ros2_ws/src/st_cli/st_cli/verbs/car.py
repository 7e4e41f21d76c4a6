"""The command `st car`: writes or checks the folder of a car."""

from pathlib import Path
from typing import Literal

import typer

from ._options import report_errors


def car(
    what: Literal["new", "check"] = typer.Argument(..., help="new, or check.", show_default=False),
    folder: str = typer.Argument(..., help="Folder of the car; check: also a name in config/car.", show_default=False),
) -> None:
    """Write the folder of a new car for you to fill in, or check the folder of a car.

    new: vehicle.yaml, signals.yaml, can.dbc, rt.dbc (of an OxTS RT on the same bus, to append to can.dbc) and car.yaml.
    check: one line for each mistake and each missing entry; if there are none, what is unusual for a road car, and the
    uncertainty used for each quantity. Exit status: 0 written, or no mistake; 1 mistakes were found; 2 the folder to
    check does not exist, or the folder to write does.
    """
    from st_recordings.car_skeleton import find_problems, list_remarks, write_skeleton

    with report_errors("car"):
        if what == "new":
            for file in write_skeleton(Path(folder)):
                typer.echo(file)
            return
        mistakes = find_problems(folder)
        remarks = [] if mistakes else list_remarks(folder)
    for line in mistakes:
        typer.echo(f"st car: {line}", err=True)
    if not mistakes:
        typer.echo("\n".join([f"{folder}: no mistake found", *remarks]))
    raise typer.Exit(int(bool(mistakes)))
