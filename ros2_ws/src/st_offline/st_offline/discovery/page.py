"""The discovery as one page: the answer first, then what it rests on. Nothing is loaded, every name is escaped."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from st_core.discovery import Discovery

from ..evaluation.drawing import Drawn
from ..pages import template
from . import quantities, words
from .law_told import Told
from .mending import Mended

VERDICTS = ("stated", "alternative", "bound")  # first in the table of all effects


def write_page(file: Path, found: Discovery, mended: Mended | None, content: dict[str, Any],
               figures: Sequence[Drawn], law: Told | None = None) -> None:
    """content: of discovery.json. law: what is proposed beyond the library."""
    about = content["provenance"]
    refused = {name: {"findings": findings} for name, findings in about["refused"].items()}
    order = {verdict: place for place, verdict in enumerate(VERDICTS)}
    ranked = sorted(found.candidates, key=lambda c: (order.get(c.verdict, len(order)), -c.gain))
    text = template("discovery", "discovery.html.jinja", plain=quantities.plain, channel=quantities.channel).render(
        title=words.title(found), found=found, verdict=words.verdict(found, mended), content=content, figures=figures,
        candidates=ranked, words=words, law=law, quantities=quantities, size=quantities.size,
        recordings={**refused, **about["runs"], **about["reference"]})
    file.write_text(text, encoding="utf-8")
