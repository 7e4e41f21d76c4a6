"""The discovery as one page: the answer first, then what it rests on. Nothing is loaded, every name is escaped."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from st_core.discovery import Discovery

from ..evaluation.drawing import Drawn
from ..pages import template
from . import words


def write_page(file: Path, found: Discovery, content: dict[str, Any], figures: Sequence[Drawn]) -> None:
    """content: of discovery.json."""
    about = content["provenance"]
    refused = {name: {"findings": findings} for name, findings in about["refused"].items()}
    text = template("discovery", "discovery.html.jinja", plain=words.plain, channel=words.channel).render(
        title=words.title(found), found=found, verdict=words.verdict(found), content=content, figures=figures,
        size=words.size, value=words.value, condition=words.condition,
        recordings={**refused, **about["runs"], **about["reference"]})
    file.write_text(text, encoding="utf-8")
