"""Rows of the benchmark of bands as the table of docs/manual/bands.md: a part measured anew renews its own rows."""

from collections.abc import Mapping
from pathlib import Path

from _markers import line, part, renew
from st_recordings.paths import project_root

PAGE, NAME = project_root() / "docs" / "manual" / "bands.md", "table of held-out runs"


def write(rows: Mapping[str, Mapping[str, str]], page: Path = PAGE) -> None:
    """Rows by their title: those of the same title are replaced, others stay."""
    kept = {cells[0]: cells for cells in map(_cells, part(page, NAME).splitlines()[2:])}
    kept |= {title: [title, *row.values()] for title, row in rows.items()}
    columns = ["held out", *next(iter(rows.values()))]
    lines = [line(columns), "|" + "---|" * len(columns), *map(line, kept.values())]
    renew(page, NAME, "\n".join(lines) + "\n")


def _cells(row: str) -> list[str]:
    cells = row.replace("\\|", "\0").strip("|").split("|")
    return [cell.strip().replace("\0", "|") for cell in cells]
