"""Adds `test`, `shell`, `bench` and `docs` to the commands of `./st`; they exist only in a checkout."""

from pathlib import Path

import typer
from rich.console import Console
from st_cli.cli import app as product
from st_recordings.paths import project_root
from typer.core import TyperGroup
from typer.main import get_command

from .bench import bench
from .develop import shell, test

app = typer.Typer(name="st", no_args_is_help=True, add_completion=False, pretty_exceptions_show_locals=False)
FORWARD_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True}
for command in (test, shell, bench):
    app.command(context_settings=FORWARD_ARGUMENTS)(command)


def collect_commands() -> TyperGroup:
    """All commands of `./st`: those of the product and those of this package."""
    group = get_command(product)
    assert isinstance(group, TyperGroup)
    developer = get_command(app)
    assert isinstance(developer, TyperGroup)
    group.commands |= developer.commands
    return group


@app.command()
def docs(
    gallery: bool = typer.Option(False, "--gallery", help="Also regenerate the pictures of the gallery (minutes)."),
    output: Path | None = typer.Option(None, help="Folder; default docs/.", file_okay=False),
) -> None:
    """Write docs/reference.md, docs/gallery.md and the figure of the packages from the code.

    With --gallery, also regenerate the pictures of the gallery from real output.
    """
    from . import gallery as pictures
    from . import structure
    from .reference import make_reference_page

    console = Console()
    folder = output or project_root() / "docs"
    folder.mkdir(parents=True, exist_ok=True)
    pages = {"reference.md": make_reference_page(collect_commands()), "gallery.md": pictures.make_gallery_page()}
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")
        console.print(f"{folder / name}", highlight=False, soft_wrap=True)
    figure = folder / structure.FIGURE
    structure.draw_structure(project_root() / "ros2_ws" / "src", figure)
    console.print(f"{figure}", highlight=False, soft_wrap=True)
    if gallery:
        try:
            pictures.draw_gallery(folder / "images", console)
        except pictures.GalleryError as error:
            typer.echo(f"st docs: {error}", err=True)
            raise typer.Exit(1) from None


if __name__ == "__main__":
    app(prog_name="st")
