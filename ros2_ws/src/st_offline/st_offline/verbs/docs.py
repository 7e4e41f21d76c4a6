"""`st docs`: the pages of docs/ that are made, not written."""

from pathlib import Path

import typer


def docs(
    gallery: bool = typer.Option(
        False, "--gallery", help="Also drive, evaluate and draw the gallery and the animation anew (minutes)."
    ),
    output: Path | None = typer.Option(None, help="Folder; default docs/.", file_okay=False),
) -> None:
    """Write docs/reference.md from the code, and with --gallery docs/gallery.md from real output."""
    # Imported when it runs, see demo.py.
    from rich.console import Console

    from ..cli import app
    from ..documentation.reference import page
    from ..paths import project_root

    console = Console()
    folder = output or project_root() / "docs"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "reference.md").write_text(page(app), encoding="utf-8")
    console.print(f"{folder / 'reference.md'}", highlight=False, soft_wrap=True)
    if gallery:
        from ..documentation.gallery import GalleryError, make

        try:
            make(folder, console)
        except GalleryError as error:
            typer.echo(f"st docs: {error}", err=True)
            raise typer.Exit(1) from None
