"""The part of a page that a benchmark writes, between two comments."""

from collections.abc import Mapping, Sequence
from pathlib import Path

BEGIN, END = "<!-- {}: written by `./st bench` -->\n", "<!-- end of {} -->\n"


def part(page: Path, name: str) -> str:
    """The present text of the part."""
    return page.read_text(encoding="utf-8").split(BEGIN.format(name))[1].split(END.format(name))[0]


def renew(page: Path, name: str, text: str) -> None:
    """Replace the text of the part."""
    before, rest = page.read_text(encoding="utf-8").split(BEGIN.format(name))
    after = rest.split(END.format(name))[1]
    page.write_text(before + BEGIN.format(name) + text + END.format(name) + after, encoding="utf-8")


def line(cells: Sequence[str]) -> str:
    """A row of a table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def table(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Lines of a table; columns by their titles."""
    return [line(list(rows[0])), "|" + "---|" * len(rows[0]), *(line(list(row.values())) for row in rows)]
