"""The curve of a proposed law, with its band and how often each value was driven."""

import textwrap

import matplotlib.pyplot as plt
from st_core.proposals import Proposal
from st_core.proposals.places import QUANTITIES, WHERE
from st_predictor.palette import MEASURED_COLOUR

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from . import law_words, words
from .figures import AFTER
from .law_file import law_in_words


def law_figure(one: Proposal, place: Place) -> Drawn:
    """Curve and 95 % band above, share of the driving below."""
    c = one.candidate
    with style():
        figure, (curve, driven) = plt.subplots(2, 1, figsize=(WIDTH, 3.6), sharex=True, height_ratios=(3.0, 1.0))
        band = words.SURE * one.deviation
        curve.axhline(0.0, color=TEXT, lw=0.8, ls=":")
        curve.fill_between(one.at, one.value - band, one.value + band, color=AFTER, alpha=0.25, lw=0, label="95 %")
        curve.plot(one.at, one.value, color=AFTER, label="proposed law")
        curve.set_ylabel(textwrap.fill(f"{law_words.place(c)}, {c.unit}", 28))
        curve.legend(loc="best")
        driven.bar(one.at, 100.0 * one.density, width=one.at[1] - one.at[0], color=MEASURED_COLOUR)
        driven.set(ylabel="driven, %", xlabel=f"{law_words.quantity(c)}, {QUANTITIES[c.quantity]}")
        before, after = one.position_5s
        title = (f"PROPOSAL: {law_in_words(one)}; 5 s position error "
                 f"{before:.2f} m → {after:.2f} m on held-out driving")
        first = f"First reading: {one.readings[0].text}. " if one.readings else ""
        caption = (f"{first}y: {WHERE[c.place][1]}. Fitted through the simulator beside everything that was found and "
                   "every parameter of the vehicle file; constant beyond the range driven. Bars: share of the driving.")
        return finish(figure, place, "law", title, caption[0].upper() + caption[1:])
