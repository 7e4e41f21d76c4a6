"""Loads the templates of the self-contained report pages; all inserted text except drawings is escaped."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape
from st_core.palette import MODEL_COLOUR

from .checking import check_report

# The colours of the models suit white paper; a dark page needs lighter ones.
DARK_COLOURS = {"kinematic": "#6cb4ee", "linear": "#ffa657", "nonlinear": "#d08be0", "augmented": "#3fd0a4"}
MAX_UNWRAPPED = 30  # characters; a column with a longer text wraps


@dataclass(frozen=True)
class Table:
    """A collapsible table. about: text next to the title. note: text above the rows. rows: one text for each column."""

    title: str
    note: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    about: str = ""


def make_columns(head: Sequence[str], rows: Iterable[Sequence[Any]],
                 text_columns: int) -> list[tuple[str, str, tuple[Any, ...]]]:
    """(title, CSS class, cells) of each column that is not empty. text_columns: number of leading text columns."""
    result = []
    for k, (title, cells) in enumerate(zip(head, [*zip(*rows, strict=True)] or [()] * len(head), strict=True)):
        texts = [str(cell) for cell in cells]
        if any(text not in ("", "-") for text in texts):
            is_text = k < text_columns or any(text[:1].isalpha() for text in texts)
            css_class = "words" if max(map(len, texts)) > MAX_UNWRAPPED else "name" if is_text else ""
            result.append((title, css_class, cells))
    return result


def _mark_commands(value: Any) -> Any:
    """A text with `commands` as HTML; other values unchanged."""
    if isinstance(value, Markup) or not isinstance(value, str):
        return value
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(value))))


def load_template(name: str) -> jinja2.Template:
    """Load a template by its path in this package. Text in backquotes becomes <code>. Filters: `drawing` inserts an SVG
    unescaped, `cells` returns the values of a row."""
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True,
                                     undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
                                     finalize=_mark_commands)
    environment.filters.update(drawing=Markup, cells=lambda row: list(row.values()))
    environment.globals.update(checking=check_report, columns=make_columns, colours=MODEL_COLOUR, dark=DARK_COLOURS)
    return environment.get_template(name)
