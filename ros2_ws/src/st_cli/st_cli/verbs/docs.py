"""`st docs`: the pages of docs/ that are made, not written."""

import sys
from pathlib import Path
from typing import Any

import typer

ST = (sys.executable, "-m", "st_cli.cli")


def docs(
    context: typer.Context,
    gallery: bool = typer.Option(
        False, "--gallery", help="Also drive, evaluate and draw the pictures of the gallery anew (minutes)."
    ),
    output: Path | None = typer.Option(None, help="Folder; default docs/.", file_okay=False),
) -> None:
    """Write docs/reference.md, docs/gallery.md and the figure of the packages from the code.

    With --gallery the pictures of the gallery too, from real output.
    """
    # Imported when it runs, see demo.py.
    from rich.console import Console
    from st_offline.documentation import gallery as pictures
    from st_offline.documentation import structure
    from st_offline.documentation.reference import page
    from st_recordings.paths import project_root

    root: Any = context.find_root().command
    console = Console()
    folder = output or project_root() / "docs"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("reference.md", page(root)), ("gallery.md", pictures.page())):
        (folder / name).write_text(text, encoding="utf-8")
        console.print(f"{folder / name}", highlight=False, soft_wrap=True)
    figure = folder / structure.FIGURE
    structure.draw(project_root() / "ros2_ws" / "src", figure)
    console.print(f"{figure}", highlight=False, soft_wrap=True)
    if gallery:
        try:
            pictures.draw(folder / "images", ST, console)
        except pictures.GalleryError as error:
            typer.echo(f"st docs: {error}", err=True)
            raise typer.Exit(1) from None
