"""Report pages: one template for all of them. Nothing is loaded, every name is escaped."""

from collections.abc import Callable
from pathlib import Path

import jinja2
from markupsafe import Markup
from st_core.palette import MODEL_COLOUR

from .checking import check_report

# The colours of the models are made for white paper; these are lighter ones for a dark page.
DARK = {"kinematic": "#6cb4ee", "linear": "#ffa657", "nonlinear": "#d08be0", "augmented": "#3fd0a4"}


def template(name: str, **filters: Callable) -> jinja2.Template:
    """A template by its path in this package; it extends page.jinja and imports macros.jinja.

    filters: in addition to `drawing`, an SVG unescaped, and `cells`, the values of a row.
    """
    environment = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True,
                                     undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(drawing=Markup, cells=lambda row: list(row.values()), **filters)
    environment.globals.update(checking=check_report, findings_in=check_report.findings_in, colours=MODEL_COLOUR,
                               dark=DARK)
    return environment.get_template(name)
