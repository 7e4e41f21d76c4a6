"""The check as one page: what is wrong first, then what it rests on. Nothing is loaded, every name is escaped."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..evaluation.drawing import Drawn, Place
from ..evaluation.evaluation_report import BUDGET
from ..evaluation.work import slug
from ..pages import template
from . import check_wording as words
from .check_document import CheckedRun, FailedRun
from .check_figures import panel


def title(good: Sequence[CheckedRun]) -> str:
    """Verdict over all runs in one sentence."""
    if len(good) == 1:
        return f"{good[0].name}: {words.answer(good[0].checked)}"
    worst = {severity: [run.name for run in good if run.checked.of(severity)] for severity in words.GRAVITY[:2]}
    if not any(worst.values()):
        return f"{len(good)} runs: no error and no warning"
    counts = [f"{severity.value}s in {len(names)} of {len(good)} runs ({', '.join(names)})"
            for severity, names in worst.items() if names]
    sentence = "; ".join(counts)
    return sentence[0].upper() + sentence[1:]


def write_page(file: Path, good: Sequence[CheckedRun], failed: Sequence[FailedRun], content: dict[str, Any]) -> None:
    """content: of check.json."""
    text = template("checking", "check.html.jinja").render(
        title=title(good), runs=good, failed=failed, content=content, figures=_within_budget(good))
    file.write_text(text, encoding="utf-8")


def _within_budget(runs: Sequence[CheckedRun]) -> dict[str, list[Drawn]]:
    """The panels of each run: all, as long as there is room on the page; then those with findings; then none."""
    room = BUDGET
    shown: dict[str, list[Drawn]] = {run.name: [] for run in runs}
    for run in runs:
        for identity in run.checked.identities:
            concerned = any(one.name in identity.findings for one in run.checked.findings)
            if room < (0 if concerned else BUDGET // 2):
                continue
            drawn = panel(identity, run.checked, Place(None, (), f"{slug(run.name)}-"))
            room -= len(drawn.svg.encode())
            shown[run.name].append(drawn)
    return shown
