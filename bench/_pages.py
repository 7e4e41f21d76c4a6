"""Tables for pages in docs/, and the parts of these pages that benchmarks write; each part is between two comments."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

BEGIN, END = "<!-- st bench: {} -->\n", "<!-- end of {} -->\n"


def read_part(page: Path, name: str) -> str:
    """The current text of a part. Raises ValueError if the page has no such part."""
    _, opened, rest = page.read_text(encoding="utf-8").partition(BEGIN.format(name))
    text, closed, _ = rest.partition(END.format(name))
    if not opened or not closed:
        raise ValueError(f"{page}: the comments with `{name}` at begin and end of this part are missing")
    return text


def replace_part(page: Path, name: str, text: str) -> None:
    """Replaces the text of a part; a line break is added at its end. Raises ValueError if the page has no such part."""
    old = BEGIN.format(name) + read_part(page, name) + END.format(name)
    new = BEGIN.format(name) + text + "\n" + END.format(name)
    page.write_text(page.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


def format_row(cells: Iterable[object]) -> str:
    """Formats a row of a Markdown table."""
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def format_table(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Formats a Markdown table; no line break at its end."""
    return "\n".join([format_row(head), "|" + "---|" * len(head), *map(format_row, rows)])


def format_records(records: Sequence[Mapping[str, object]]) -> str:
    """Formats a Markdown table with a row for each record; the keys, the same in all records, are its head."""
    return format_table(list(records[0]), [record.values() for record in records])
