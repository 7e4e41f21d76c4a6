"""Replaces the parts of pages in docs/ that benchmarks write; each part is between two comments."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

BEGIN, END = "<!-- {}: written by `./st bench` -->\n", "<!-- end of {} -->\n"


def read_part(page: Path, name: str) -> str:
    """The current text of a part."""
    return page.read_text(encoding="utf-8").split(BEGIN.format(name))[1].split(END.format(name))[0]


def replace_part(page: Path, name: str, text: str, begin: str = BEGIN, end: str = END) -> None:
    """Replaces the text of a part; a line break is added at its end. Raises ValueError if the page has no such part."""
    opening, closing = begin.format(name), end.format(name)
    before, opened, rest = page.read_text(encoding="utf-8").partition(opening)
    _, closed, after = rest.partition(closing)
    if not opened or not closed:
        raise ValueError(f"{page}: the comments {opening.strip()} and {closing.strip()} are missing")
    page.write_text(before + opening + text + "\n" + closing + after, encoding="utf-8")


def format_row(cells: Iterable[object]) -> str:
    """Formats a row of a Markdown table."""
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def format_table(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Formats a Markdown table; no line break at its end."""
    return "\n".join([format_row(head), "|" + "---|" * len(head), *map(format_row, rows)])


def format_records(records: Sequence[Mapping[str, object]]) -> str:
    """Formats a Markdown table with a row for each record; the keys, the same in all records, are its head."""
    return format_table(list(records[0]), [record.values() for record in records])
