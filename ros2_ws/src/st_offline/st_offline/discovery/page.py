"""The discovery as one page: the answer first, then what it rests on. Nothing is loaded, every name is escaped."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup
from st_core.discovery import Discovery

from .. import evaluation
from ..evaluation.drawing import Drawn
from ..evaluation.page import DARK
from ..style import MODEL_COLOUR
from . import words


def write_page(file: Path, found: Discovery, content: dict[str, Any], figures: Sequence[Drawn]) -> None:
    """content: of discovery.json."""
    folders = [Path(__file__).parent, Path(evaluation.__file__).parent]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(drawing=Markup, plain=words.plain, channel=words.channel)
    text = environment.get_template("discovery.html.jinja").render(
        title=words.title(found), found=found, verdict=words.verdict(found), content=content, figures=figures,
        size=words.size, value=words.value, condition=words.condition, colours=MODEL_COLOUR, dark=DARK)
    file.write_text(text, encoding="utf-8")
