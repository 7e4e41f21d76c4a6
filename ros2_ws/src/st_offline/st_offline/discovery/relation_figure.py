"""Figure of a relation: the curve with its band, and the density of driving."""

import textwrap

import matplotlib.pyplot as plt
from st_core.palette import MEASURED_COLOUR
from st_core.relations import Relation
from st_core.relations.candidates import QUANTITIES

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from . import quantities, relation_wording, report_text
from .figures import AFTER
from .relation_files import title_of


def relation_figure(one: Relation, place: Place) -> Drawn:
    """Curve and 95 % band above, share of the driving below; angles in degrees, shares in per cent."""
    c = one.candidate
    (up, unit), (across, across_unit) = shown(c.unit), shown(QUANTITIES[c.quantity])
    at, value, band = across * one.at, up * one.value, up * report_text.SURE * one.deviation
    with style():
        figure, (curve, driven) = plt.subplots(2, 1, figsize=(WIDTH, 3.6), sharex=True, height_ratios=(3.0, 1.0))
        curve.axhline(0.0, color=TEXT, lw=0.8, ls=":")
        curve.fill_between(at, value - band, value + band, color=AFTER, alpha=0.25, lw=0, label="95 % interval")
        curve.plot(at, value, color=AFTER, label="proposed relation")
        for k, (low, high) in enumerate(one.drives.thin):
            for axes in (curve, driven):
                axes.axvspan(across * low, across * high, color=MEASURED_COLOUR, alpha=0.12, lw=0,
                             label="sparsely driven" if axes is curve and not k else None)
        curve.set_ylabel(f"{textwrap.fill(relation_wording.axis(c), 28)}, {unit}")
        curve.legend(loc="best")
        driven.set_axisbelow(True)
        driven.bar(at, 100.0 * one.density, width=at[1] - at[0], color=MEASURED_COLOUR)
        # Most driving is straight at constant speed; a linear scale would hide the other bins.
        driven.set(yscale="log", ylim=(0.02, 100.0), yticks=(0.1, 1.0, 10.0, 100.0))
        driven.yaxis.set_major_formatter("{x:g}")
        driven.set(ylabel="share of the\ndriving, %", xlabel=f"{relation_wording.quantity(c)}, {across_unit}")
        before, after = one.position_5s
        title = (f"PROPOSAL: {title_of(one)}; held-out position error after 5 s: "
                 f"{before:.3f} m without it, {after:.3f} m with it")
        units = f"y in {c.unit}, u in {QUANTITIES[c.quantity]}".replace("^2", "²")
        first = f"As a formula: {one.formulas[0].text}, {units}. " if one.formulas else ""
        caption = (f"{first}Dotted, zero: the model without the relation. Fitted by simulation together with all that "
                   "was found; constant beyond the driven range. Grey: sparsely driven; there the curve is "
                   "interpolated, and its interval holds only if the true relation is as smooth. The other figures do "
                   "not contain the relation.")
        return finish(figure, place, "law", title, caption)


def shown(unit: str) -> tuple[float, str]:
    """(factor, unit) in which a curve is drawn."""
    return (100.0, "%") if unit == "1" else (quantities.factor(unit), quantities.shown_unit(unit))
