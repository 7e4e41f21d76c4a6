"""The page of `st check`: what is wrong, what to do, and each comparison as a figure."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from st_core.checks import Checked, Finding, Identity, Severity
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR

from ..evaluation.drawing import BAD, TEXT, WARN, WIDTH, Drawn, Place, broken, finish, style, thinned
from ..evaluation.evaluation_report import BUDGET
from ..evaluation.work import slug
from ..pages import template
from . import check_report as words
from .check_report import CheckedRun, FailedRun, residual_rms

HEIGHT = 3.1  # inch
GAP = 1.5  # s; no line across
LEAST_SHADE = 0.004  # of the width: what is shorter must be seen too
SHADE = {Severity.ERROR: BAD, Severity.WARNING: WARN, Severity.NOTE: MEASURED_COLOUR}
DERIVED_COLOUR = MODEL_COLOUR["kinematic"]


def panel(identity: Identity, checked: Checked, place: Place) -> Drawn:
    """The figure of one identity; the stretches of the findings that rest on it are shaded."""
    findings = resting_on(identity, checked)
    with style():
        figure, (upper, lower) = plt.subplots(2, 1, figsize=(WIDTH, HEIGHT), sharex=True, height_ratios=(3, 2))
        time = np.asarray(identity.time, float)
        measured, derived = (np.asarray(v, float) for v in (identity.measured, identity.derived))
        for axes, values, colour, width, label in (
                (upper, measured, MEASURED_COLOUR, 2.6, identity.measured_label),
                (upper, derived, DERIVED_COLOUR, 0.9, identity.derived_label),
                (lower, measured - derived, TEXT, 0.9, None)):
            axes.plot(*thinned(*broken(time, values, GAP)), color=colour, lw=width, label=label)
        _shade((upper, lower), findings)
        lower.axhline(0.0, color=TEXT, lw=0.5)
        lower.set_xlabel("after the first INS measurement, s")
        unit = words.unit(identity.unit) or "1"
        upper.set_ylabel(unit)
        lower.set_ylabel(f"difference\n{unit}")
        figure.align_ylabels()
        figure.legend(loc="outside lower left", ncols=2)
        key = f"identity-{identity.name}"
        return finish(figure, place, key, panel_title(identity, findings), panel_caption(identity, findings))


def resting_on(identity: Identity, checked: Checked) -> list[Finding]:
    """The findings that rest on an identity, the gravest first."""
    return sorted((one for one in checked.findings if one.name in identity.findings), key=words.gravity)


def panel_title(identity: Identity, findings: Sequence[Finding]) -> str:
    """What the panel shows: the gravest finding, or that both agree."""
    what = identity.title[0].upper() + identity.title[1:]
    if findings:
        return f"{what}: {findings[0].text}"
    size = f"{residual_rms(identity):.2g} {words.unit(identity.unit)}".strip()
    return f"{what}: no finding; they differ by {size} (root mean square)"


def panel_caption(identity: Identity, findings: Sequence[Finding]) -> str:
    shaded = ", shaded where a finding has its stretches" if any(one.where for one in findings) else ""
    return f"Grey: {identity.measured_label}; blue: {identity.derived_label}; below, grey minus blue{shaded}."


def _shade(panels: Sequence[plt.Axes], findings: Sequence[Finding]) -> None:
    low, high = panels[0].get_xlim()
    shortest = LEAST_SHADE * (high - low)
    for finding in findings:
        for start, end in finding.where:
            for axes in panels:
                axes.axvspan(start, max(end, start + shortest), color=SHADE[finding.severity], alpha=0.3, lw=0)


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
