"""Shared parts of the report pages: style, colours, the table of findings. Nothing is loaded, every name is escaped."""

from collections.abc import Callable
from pathlib import Path

import jinja2
from markupsafe import Markup
from st_core.palette import MODEL_COLOUR

from .checking import check_report as checking_words
from .checking.check_report import findings_in

# The house colours are made for white paper; these are lighter twins for a dark page.
DARK = {"kinematic": "#6cb4ee", "linear": "#ffa657", "nonlinear": "#d08be0", "augmented": "#3fd0a4"}
_HERE = Path(__file__).parent


def template(folder: str, name: str, **filters: Callable) -> jinja2.Template:
    """A template in a folder of this package; it may include those of evaluation/ and checking/.

    filters: further ones of it; `drawing`, which inserts an SVG unescaped, is always available.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([_HERE / one for one in (folder, "evaluation", "checking")]), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(drawing=Markup, **filters)
    environment.globals.update(checking=checking_words, findings_in=findings_in, colours=MODEL_COLOUR, dark=DARK)
    return environment.get_template(name)
