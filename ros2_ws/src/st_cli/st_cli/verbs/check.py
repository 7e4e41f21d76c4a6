"""The commands `st check` and `st car`: find errors in recordings, and mistakes in the folder of a car."""

from pathlib import Path
from typing import Literal

import typer

from . import _options as shared


@shared.expand_options(shared.ReadOptions)
def check(
    runs: shared.Runs,
    output: Path | None = typer.Option(None, help="Folder for the results; default runs/check-<time>."),
    json: Path | None = typer.Option(None, "--json", help="JSON file of the results; default check.json in --output.",
                                     dir_okay=False),
    propose_correction: Path | None = typer.Option(
        None, "--propose-correction", "--propose-cure", dir_okay=False,
        help="Write a run.yaml with corrections for the findings; single run only."),
    read_options: shared.ReadOptions = shared.ReadOptions(),
) -> int:
    """Find errors in recordings: units, signs, clocks, axes, projections, reference points, sensors.

    Nothing is corrected; each finding states how to correct it. Exit status: 0 no error found, 1 an error was found or
    a run could not be read, 2 nothing was checked.
    """
    from st_offline.checking.check_command import CheckJob, run_command

    vehicle, read_settings = read_options.resolve()
    parameters, file = shared.load_vehicle_or_default(vehicle)
    job = CheckJob(runs, parameters, str(file), vehicle is not None, read_settings, output, json, propose_correction)
    return run_command(job, lambda used: shared.report_default_car("check", None, used))


def car(
    action: Literal["new", "check"] = typer.Argument(..., help="new, or check.", show_default=False),
    folder: str = typer.Argument(..., help="Folder of a car, or for check a name in config/car.", show_default=False),
) -> None:
    """Write the folder of a new car for you to fill in, or check the folder of a car.

    new: vehicle.yaml, signals.yaml, can.dbc, rt.dbc (of an OxTS RT on the same bus, to append to can.dbc) and car.yaml.
    check: one line for each mistake and each missing entry; if there are none, values unusual for a road car, doubtful
    CAN signals, and the uncertainty used for each quantity. Exit status: 0 written, or no mistake; 1 mistakes were
    found; 2 no car was found to check, or the folder to write is not empty.
    """
    from st_recordings.car_skeleton import find_problems, list_remarks, write_skeleton

    with shared.report_errors("car"):
        if action == "new":
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
