"""`st recover`: make a recording that was cut off readable again."""

from pathlib import Path

import typer


def recover(
    path: Path = typer.Argument(..., help="A bag directory or an .mcap file that was not closed.", exists=True),
    output: Path | None = typer.Option(
        None, "--output", help="Path of the repaired recording; default: in place, the cut file is kept."
    ),
) -> None:
    """Repair a recording cut off by a crash or power loss; complete ones are left as they are."""
    from st_recordings import mcap

    try:
        report = mcap.recover(path, output)
    except (OSError, ValueError) as error:
        typer.echo(f"st recover: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(str(report))
