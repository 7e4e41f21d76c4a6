"""`st ncom`: data of the unit as CSV."""

from pathlib import Path

import typer


def ncom(
    file: Path = typer.Argument(..., help="NCOM recording.", exists=True, dir_okay=False),
    csv: Path = typer.Option(..., "--csv", help="Navigation values, one row per packet."),
    status: Path | None = typer.Option(None, "--status", help="Status fields, one row per change."),
) -> None:
    """Write an NCOM file as CSV: time, acceleration, rates, position, velocity, attitude and what follows from them."""
    from oxts_bridge.export import write_csv

    for option, path in (("--csv", csv), ("--status", status)):
        if path is not None and path.exists() and path.samefile(file):
            typer.echo(f"st ncom: {option} {path} is the recording itself: name another file", err=True)
            raise typer.Exit(2)
    if status is not None and status.absolute() == csv.absolute():
        typer.echo(f"st ncom: --csv and --status are both {csv}: name two files", err=True)
        raise typer.Exit(2)
    try:
        write_csv(file, csv, status)
    except (OSError, ValueError) as error:
        typer.echo(f"st ncom: {error}", err=True)
        raise typer.Exit(2) from None
