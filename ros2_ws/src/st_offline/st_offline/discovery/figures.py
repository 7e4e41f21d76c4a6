"""Figures of a discovery that show numbers: gap before and after, errors by condition, ranking of hypotheses."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator
from st_core.channels import WORDS
from st_core.discovery import Discovery
from st_core.discovery.where import Survey
from st_core.discovery.where_bins import EVERYWHERE, BinExcess
from st_core.log import DriveLog
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_core.vehicle import VehicleParameters

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from . import quantities, report_text

AFTER = MODEL_COLOUR["augmented"]
MOST_CANDIDATES = 14
LEAST_GAIN = 0.005  # share of the error; less is not drawn


@dataclass(frozen=True)
class Scene:
    """What the figures are made from. before, after: surveys of all runs with base and augmented model."""

    found: Discovery
    runs: Sequence[DriveLog]
    vehicle: VehicleParameters
    before: Survey
    after: Survey | None
    place: Place

    @property
    def colour(self) -> str:
        """Of the base model."""
        return MODEL_COLOUR.get(self.found.base.base.name, TEXT)

    @property
    def channel(self) -> str:
        return report_text.worst_channel(self.found, list(self.before.samples.squares))

    def handles(self, marker: str = "o") -> list[Line2D]:
        base = Line2D([], [], color=self.colour, marker=marker, ls="", label=f"{self.found.base.base.name} model")
        return [base] + ([Line2D([], [], color=AFTER, marker=marker, ls="", label="with what was found")]
                         if self.after else [])


def gap(scene: Scene) -> Drawn | None:
    """Held-out error of each channel, base = 100 %."""
    entries = [(n, scene.found.gap[n]) for n in WORDS if n in scene.found.gap and scene.found.gap[n].base > 0]
    if not entries:
        return None
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.2 + 0.42 * len(entries)))
        for row, (_, one) in enumerate(entries):
            percent = 100.0 / one.base
            shown = percent * one.augmented if scene.found.model else 100.0
            axes.plot([100, shown], [row, row], color=TEXT, lw=0.7, alpha=0.5, zorder=1)
            axes.plot(100, row, "o", ms=8, color=scene.colour, zorder=2)
            if scene.found.model:
                ends = [percent * (one.base - edge) for edge in one.interval]
                axes.plot(ends, [row, row], color=AFTER, lw=3, alpha=0.4, solid_capstyle="butt", zorder=2)
                axes.plot(shown, row, "o", ms=8, color=AFTER, zorder=3)
            if one.floor > 0.0:
                axes.plot(percent * one.floor, row, "|", ms=14, mew=2, color=MEASURED_COLOUR, zorder=3)
            text = quantities.size(one.base, one.unit)
            if scene.found.model:
                text += f" → {quantities.size(one.augmented, one.unit)}"
            axes.annotate(text, (1.01, row), xycoords=("axes fraction", "data"), va="center", fontsize=8)
        axes.set_yticks(range(len(entries)), [quantities.channel(n) for n, _ in entries])
        axes.set_ylim(len(entries) - 0.5, -0.5)
        axes.set_xlim(left=0)
        axes.set_xlabel("error on held-out driving, % of the base model's")
        floor = Line2D([], [], color=MEASURED_COLOUR, marker="|", ms=12, mew=2, ls="", label="noise alone")
        figure.legend(handles=[*scene.handles(), floor], loc="outside lower left", ncols=3)
        caption = ("Root mean square errors of predictions from measured starts, of the position after 5 s the mean, "
                   "on driving the values were not fitted to. Band: 95 % interval of the change.")
        return finish(figure, scene.place, "gap", _gap_title(scene.found), caption)


def _gap_title(found: Discovery) -> str:
    if not found.model:
        return "Error of the base model on held-out driving"
    certain = report_text.surely_changed(found.gap)
    if not certain:
        return "No held-out error surely changes with what was found"
    first = certain[0]
    return (f"{len(certain)} of {len(found.gap)} held-out errors surely change, most that of the "
            f"{quantities.channel(first)}: {report_text.before_and_after(found.gap[first])}")


def conditions(scene: Scene) -> Drawn | None:
    """Error of the most affected channel by condition, before and after."""
    channel = scene.channel
    before = [b for b in scene.before.bins if b.channel == channel and b.range.quantity != EVERYWHERE]
    sorts = list(dict.fromkeys(b.range.quantity for b in before))
    if not sorts:
        return None
    after = {b.range: b for b in scene.after.bins if b.channel == channel} if scene.after else {}
    with style():
        figure, panels = plt.subplots(2, 3, figsize=(WIDTH, 5.2), sharey=True)
        for axes, quantity in zip(panels.flat, sorts, strict=False):
            mine = [b for b in before if b.range.quantity == quantity]
            for k, one in enumerate(mine):
                _bar(axes, k - 0.12, one, scene.colour)
                if one.range in after:
                    _bar(axes, k + 0.12, after[one.range], AFTER)
            axes.axhline(1.0, color=TEXT, lw=0.8, ls=":")
            axes.set_xticks(range(len(mine)), [_tick(b) for b in mine], fontsize=7, rotation=30, ha="right",
                            rotation_mode="anchor")
            unit = "" if mine[0].range.low is None else f", {mine[0].range.label.rsplit(' ', 1)[1]}"
            axes.set(xlabel=quantity + unit, yscale="log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
            axes.yaxis.set_minor_formatter(lambda v, _: "")
        for axes in panels.flat[len(sorts):]:
            axes.set_visible(False)
        for axes in panels[:, 0]:
            axes.set_ylabel(f"{quantities.channel(channel)} error,\ntimes the expected")
        figure.legend(handles=scene.handles(), loc="outside lower left", ncols=3)
        said = [w for w in scene.found.where if w.channel == channel and w.condition != EVERYWHERE]
        title = report_text.statement(said[0]) if said else f"{quantities.channel(channel)}: no condition stands out"
        expected = "the reference drives' in the same range" if scene.before.reference else "what noise alone leaves"
        caption = (f"Root mean square over {expected}; 1 = as expected. Filled: significant over all ranges together "
                   "(false discovery rate 5 %). Bars: 95 %, whole blocks of time resampled.")
        return finish(figure, scene.place, "conditions", title[0].upper() + title[1:], caption)


def _bar(axes: plt.Axes, x: float, one: BinExcess, colour: str) -> None:
    low, high = one.interval[0], min(one.interval[1], 20.0 * one.excess)
    axes.plot([x, x], [max(low, 0.05 * one.excess), high], color=colour, lw=1.2)
    axes.plot(x, one.excess, "o", ms=6, color=colour, mfc=colour if one.significant else "none")


def _tick(one: BinExcess) -> str:
    if one.range.low is None or one.range.high is None:
        return one.range.label
    low, high = one.range.low, one.range.high
    if np.isinf(low):
        return f"< {high:g}"
    return f"> {low:g}" if np.isinf(high) else f"{low:g}–{high:g}"


def candidates(scene: Scene) -> Drawn | None:
    """How much of the size of the errors each hypothesis takes away, on top of the answer or as part of it."""
    ranked = sorted((c for c in scene.found.candidates if c.gain > LEAST_GAIN), key=lambda c: -c.gain)
    ranked = ranked[:MOST_CANDIDATES]
    if not ranked:
        return None
    chosen = {e.name for e in scene.found.effects}
    alternatives = {a for e in scene.found.effects for a in e.alternatives}
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.1 + 0.26 * len(ranked)))
        axes.set_axisbelow(True)
        for row, one in enumerate(ranked):
            colour = AFTER if one.name in chosen | alternatives else MEASURED_COLOUR
            axes.barh(row, 100 * one.gain, color=colour, height=0.62, alpha=1.0 if one.name in chosen else 0.55,
                      hatch="///" if one.name in alternatives else None, edgecolor=TEXT, lw=0)
            axes.annotate(one.verdict, (max(100 * one.gain, 0.0), row), xytext=(5, 0), textcoords="offset points",
                          va="center", fontsize=8)
        axes.set_yticks(range(len(ranked)), [quantities.plain(c.name) for c in ranked])
        axes.set_ylim(len(ranked) - 0.5, -0.6)
        top = 100 * max(*(c.gain for c in ranked), 0.01)
        axes.set_xlim(0.0, 1.5 * top)  # room for the words; there is no share above 100 %
        axes.set_xticks([tick for tick in axes.get_xticks() if tick <= 100.0])
        axes.set_xlabel("share of the size of the errors it takes away, %")
        title = f"Of {len(scene.found.candidates)} effects that were tried, {len(chosen)} are stated"
        caption = ("Each effect as part of the answer, or on top of it. Dark: stated. Hatched: cannot be told from it. "
                   f"The {len(scene.found.candidates) - len(ranked)} not shown take away less, or nothing.")
        return finish(figure, scene.place, "candidates", title, caption)
