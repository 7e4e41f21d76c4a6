"""Each identity as a small panel: what was measured over what it must be, and their difference below."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from st_core.checks import Checked, Finding, Identity, Severity
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR

from ..evaluation.drawing import BAD, TEXT, WARN, WIDTH, Drawn, Place, broken, finish, style, thinned
from . import check_wording as words
from .check_document import residual_rms

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
        return finish(figure, place, key, title(identity, findings), caption(identity, findings))


def resting_on(identity: Identity, checked: Checked) -> list[Finding]:
    """The findings that rest on an identity, the gravest first."""
    return sorted((one for one in checked.findings if one.name in identity.findings), key=words.gravity)


def title(identity: Identity, findings: Sequence[Finding]) -> str:
    """What the panel shows: the gravest finding, or that both agree."""
    what = identity.title[0].upper() + identity.title[1:]
    if findings:
        return f"{what}: {findings[0].text}"
    size = f"{residual_rms(identity):.2g} {words.unit(identity.unit)}".strip()
    return f"{what}: no finding; they differ by {size} (root mean square)"


def caption(identity: Identity, findings: Sequence[Finding]) -> str:
    shaded = ", shaded where a finding has its stretches" if any(one.where for one in findings) else ""
    return f"Grey: {identity.measured_label}; blue: {identity.derived_label}; below, grey minus blue{shaded}."


def _shade(panels: Sequence[plt.Axes], findings: Sequence[Finding]) -> None:
    low, high = panels[0].get_xlim()
    shortest = LEAST_SHADE * (high - low)
    for finding in findings:
        for start, end in finding.where:
            for axes in panels:
                axes.axvspan(start, max(end, start + shortest), color=SHADE[finding.severity], alpha=0.3, lw=0)
