"""The report as one page: nothing is loaded from anywhere, every name is escaped, light and dark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from ..style import MODEL_COLOUR
from . import tables
from .drawing import Drawn
from .work import RunReport, slug

BUDGET = 4_500_000  # bytes of figures, so that the page stays below 5 MB
# The house colours are made for white paper; these are lighter twins for a dark page.
DARK = {"kinematic": "#6cb4ee", "linear": "#ffa657", "nonlinear": "#d08be0", "augmented": "#3fd0a4"}


def write_page(file: Path, title: str, reports: Sequence[RunReport], content: dict[str, Any],
               settings: dict[str, str], overview: Drawn | None, over: str) -> None:
    """content: of evaluation.json."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    environment.globals.update(shown=tables.shown, best=tables.best, values=tables.values, slug=slug)
    environment.filters["drawing"] = Markup
    good = [r for r in reports if not r.problem]
    text = environment.get_template("page.html.jinja").render(
        title=title, reports=good, failed=[r for r in reports if r.problem], content=content, settings=settings,
        overview=overview, over=over, what=tables.WHAT[over], axes=tables.SHOWN_AXES, kinds=tables.KINDS,
        figures=_within_budget(good), colours=MODEL_COLOUR, dark=DARK)
    file.write_text(text, encoding="utf-8")


def _within_budget(reports: Sequence[RunReport]) -> dict[str, list[Drawn]]:
    """The figures shown on the page by run: of the first runs, as many as there is room for."""
    room, shown = BUDGET, {}
    for report in reports:
        size = sum(len(figure.svg.encode()) for figure in report.figures)
        if size > room:
            break
        room -= size
        shown[report.name] = report.figures
    return shown
