"""The report as one page: nothing is loaded from anywhere, every name is escaped, light and dark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..bands.shares import share_rows
from ..bands.shown import band_rows
from ..pages import template
from . import tables
from .drawing import Drawn
from .work import RunReport, slug

BUDGET = 4_500_000  # bytes of figures, so that the page stays below 5 MB


def write_page(file: Path, title: str, reports: Sequence[RunReport], content: dict[str, Any],
               settings: dict[str, str], overview: Drawn | None, bands: Sequence[Drawn], over: str) -> None:
    """content: of evaluation.json. bands: figures of the bands that were tested."""
    good = [r for r in reports if not r.problem]
    text = template("evaluation", "page.html.jinja").render(
        title=title, reports=good, failed=[r for r in reports if r.problem], content=content, settings=settings,
        about={r.name: r.about for r in reports},
        overview=overview, band_figures=bands, band_rows=band_rows(content.get("bands_all_runs")),
        share_rows=share_rows(content.get("bands_all_runs", {}).get("shares", {})),
        over=over, what=tables.WHAT[over], axes=tables.SHOWN_AXES, kinds=tables.KINDS,
        figures=_within_budget(good), shown=tables.shown, best=tables.best, values=tables.values, slug=slug)
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
