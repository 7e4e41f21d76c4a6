"""`st verify`: live equals offline."""

from pathlib import Path

import typer

from ._options import BAG_INPUTS, ReadOptions, VehicleOfBag, reads_recordings, refusals, report_default_car_of_bag

TOLERANCE = 0.001  # m


@reads_recordings(*BAG_INPUTS, vehicle=VehicleOfBag)
def verify(
    bag: Path = typer.Argument(..., help="A recording, or the folder of a run of st.", exists=True),
    tolerance: float = typer.Option(TOLERANCE, help="m; the largest difference that passes.", min=0.0),
    replayed: bool = typer.Option(False, "--replay", help="Play it through the nodes and compare the result."),
    force: bool = typer.Option(False, "--force", help="Also where `st check` finds an error in the recording."),
    output: Path | None = typer.Option(None, help="Folder of that replay; default runs/verify-<time>."),
    read_options: ReadOptions = ReadOptions(),
) -> None:
    """Compare every prediction and score of the nodes with the library on the same measurements, start by start.

    A recording without predictions is played through the nodes first. Exit status: 0 all within the tolerance, 1 not,
    2 nothing to compare.
    """
    from rich.console import Console
    from st_live.configuration import recordings_of
    from st_live.suite import SuiteError
    from st_live.verification import verify_command
    from st_offline.checking.check_report import print_findings
    from st_offline.checking.gate import passed_bag

    with refusals("verify", SuiteError):
        vehicle, read = read_options.resolve()
        report_default_car_of_bag("verify", bag, vehicle)
        console = Console()
        print_findings({bag.name: passed_bag(recordings_of(bag)[0], vehicle, force, read)}, console)
        status = verify_command(bag, vehicle, tolerance, replayed, output, console, read)
    raise typer.Exit(status)
