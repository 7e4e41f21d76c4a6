"""The figures of what is the same everywhere and what is not: shares by run, site, time, place and condition."""

import re
import textwrap
from collections import Counter
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.gridspec import GridSpec
from st_core.discovery.result import BoundEffect, FoundEffect, Value
from st_core.palette import MEASURED_COLOUR

from ..evaluation.drawing import TEXT, WIDTH, Drawn, finish, style
from . import quantities, report_text
from .figures import AFTER, Scene

MOST_SITES = 4
MOST_PANELS = 6
MOST_ROWS = 14  # of a level
WIDEST = 3.0  # share; intervals beyond are cut off
NEAR = 75.0  # m, from the track: places of another site are not drawn here
PLACE = re.compile(r"east (-?[\d.]+) m, north (-?[\d.]+) m")


def agreement(scene: Scene) -> Drawn | None:
    """What each part of the driving shows of each effect: 1 is the value stated, 0 none of it."""
    effects = [e for e in scene.found.effects if any(e.agreement.values())]
    if not effects:
        return None
    effects = sorted(effects, key=lambda e: -e.position_5s)[:MOST_PANELS]
    every = {e.name: [(level, v) for level, entries in e.agreement.items() for v in entries] for e in effects}
    met = dict.fromkeys((level, v.where) for entries in every.values() for level, v in entries)
    count = Counter(level for level, _ in met)
    crowded = {level for level in count if level == "place" or count[level] > MOST_ROWS}
    names = {(level, where): (level, f"{count[level]} {level}s") if level in crowded else (level, where)
             for level, where in met}
    labels = sorted(dict.fromkeys(names.values()), key=lambda label: list(count).index(label[0]))
    rows = {key: labels.index(label) for key, label in names.items()}
    with style():
        figure, panels = plt.subplots(1, len(effects), figsize=(WIDTH, 1.3 + 0.2 * len(labels)), sharey=True,
                                      squeeze=False)
        for axes, effect in zip(panels[0], effects, strict=True):
            shares = [(level, rows[level, v.where], v) for level, v in every[effect.name]]
            _shares(axes, [(row, v) for level, row, v in shares if level not in crowded])
            for _, row, v in (one for one in shares if one[0] in crowded):
                axes.plot(np.clip(v.share, *axes.get_xlim()), row, "|", ms=7, color=AFTER, alpha=0.6)
            heading = [quantities.plain(effect.name), quantities.short_values(effect.parameters)]
            axes.set_title("\n".join(line for text in heading for line in textwrap.wrap(text, 90 // len(effects))),
                           fontsize=8)
            axes.set_xlabel("share of the value")
        for row in (row for row in range(1, len(labels)) if labels[row - 1][0] != labels[row][0]):
            for axes in panels[0]:
                axes.axhline(row - 0.5, color=TEXT, lw=0.5)
        panels[0][0].set_yticks(range(len(labels)), [where for _, where in labels], fontsize=7)
        panels[0][0].set_ylim(len(labels) - 0.5, -0.5)
        caption = ("Point: share of the value stated that each part of the driving shows by itself, the other effects "
                   "held. Bar: 95 %, filled where that leaves out zero. Solid line: just that value; dotted: none of "
                   "it. A property of the car is the same everywhere.")
        return finish(figure, scene.place, "agreement", _agreed(effects), caption)


def _agreed(effects: Sequence[FoundEffect]) -> str:
    """Which effects show in every run, and which do not."""
    by_name = {quantities.plain(e.name): e.agreement["run"] for e in effects if e.agreement.get("run")}
    counts = {name: (report_text.showing(shares), len(shares)) for name, shares in by_name.items()}
    every = [name for name, (shown, of) in counts.items() if shown == of]
    some = [f"{name} in {shown} of {of}" for name, (shown, of) in counts.items() if shown < of]
    sentences = [f"in every run that can tell by itself: {', '.join(every)}"] if every else []
    sentences += [f"{', '.join(some)} runs that can tell"] if some else []
    text = "; ".join(sentences) or "what each part of the driving shows by itself"
    return text[0].upper() + text[1:]


def _shares(axes: plt.Axes, shares: Sequence[tuple[int, Value]]) -> None:
    axes.axvline(0.0, color=TEXT, lw=0.8, ls=":")
    axes.axvline(1.0, color=TEXT, lw=0.8)
    for row, one in shares:
        low, high = one.share - report_text.SURE * one.deviation, one.share + report_text.SURE * one.deviation
        clear = low > 0.0 or high < 0.0
        axes.plot(np.clip([low, high], -WIDEST, WIDEST), [row, row], color=AFTER, lw=1.2)
        axes.plot(np.clip(one.share, -WIDEST, WIDEST), row, "o", ms=4.5, color=AFTER, mfc=AFTER if clear else "none")
    ends = [v.share + side * report_text.SURE * v.deviation for _, v in shares for side in (-1.0, 1.0)]
    axes.set_xlim(max(min([-0.2, *ends]), -WIDEST) - 0.05, min(max([1.2, *ends]), WIDEST) + 0.05)


def bound(scene: Scene) -> Drawn | None:
    """What is tied to run, site, time, place or condition: its shares, and where on the map."""
    if not scene.found.bound:
        return None
    one = max(scene.found.bound, key=lambda b: b.position_5s)
    groups = _sites(scene)
    shown = _map_levels(scene, one)
    count = len(groups) if shown else 0
    with style():
        sentences = report_text.clearest(one.values, MOST_ROWS)
        height = max(2.6 if count else 0.0, 1.2 + 0.2 * len(sentences))
        figure = plt.figure(figsize=(WIDTH, height))
        grid = GridSpec(1, 1 + count, figure, width_ratios=[1.2, *[1.0] * count])
        axes = figure.add_subplot(grid[0])
        _shares(axes, list(enumerate(sentences)))
        axes.set_yticks(range(len(sentences)), [v.where for v in sentences], fontsize=7)
        axes.set(ylim=(len(sentences) - 0.5, -0.5), xlabel="share")
        if count:
            _maps(figure, [figure.add_subplot(grid[k + 1]) for k in range(count)], groups, shown, scene)
        title = (f"Tied to {one.to}, and not named: something like {quantities.plain(one.resembles)} "
                 f"({quantities.metres(one.position_5s)} after 5 s)")
        others = [quantities.plain(b.resembles) for b in scene.found.bound if b is not one]
        caption = ("Share of the fitted value that each part shows, the clearest ones; a property of the car would be "
                   "the same in all.") + (f" Not drawn: {', '.join(others)}." if others else "")
        return finish(figure, scene.place, "bound", title, caption)


def _sites(scene: Scene) -> list[list[int]]:
    """Numbers of the runs by site, the largest sites first."""
    sites = {run.name: run.site for run in scene.found.runs}
    groups: dict[int, list[int]] = {}
    for number, log in enumerate(scene.runs):
        groups.setdefault(sites.get(log.name, 0), []).append(number)
    return sorted(groups.values(), key=lambda g: -sum(scene.runs[n].duration for n in g))[:MOST_SITES]


def _map_levels(scene: Scene, one: BoundEffect) -> dict:
    """Share by run name, or by (east, north); empty where it is tied to neither."""
    places = {(float(m[1]), float(m[2])): v.share for v in one.values if (m := PLACE.search(v.where))}
    if places:
        return places
    sites = {run.name: run.site for run in scene.found.runs}
    shares = {v.where: v.share for v in one.values}
    if one.to == "run":
        return {name: shares[name] for name in sites if name in shares}
    first = min(sites.values(), default=1)
    numbers = {int(m[0]) - 1 + first: share for where, share in shares.items() if (m := re.search(r"\d+", where))}
    return {name: numbers[site] for name, site in sites.items() if site in numbers} if one.to == "site" else {}


def _maps(figure: plt.Figure, panels: Sequence[plt.Axes], groups: Sequence[Sequence[int]], shown: dict,
          scene: Scene) -> None:
    colours = plt.get_cmap("cividis")
    scale = Normalize(min(0.0, *shown.values()), max(1.0, *shown.values()))
    for axes, group in zip(panels, groups, strict=True):
        for number in group:
            log = scene.runs[number]
            every = max(1, len(log.x) // 600)
            known = log.name in shown
            axes.plot(log.x[::every], log.y[::every], lw=1.8 if known else 0.7,
                      color=colours(scale(shown[log.name])) if known else MEASURED_COLOUR)
        x, y = (np.concatenate([getattr(scene.runs[n], axis) for n in group]) for axis in ("x", "y"))
        near = [(e, n, s) for (e, n), s in ((k, v) for k, v in shown.items() if isinstance(k, tuple))
                if np.hypot(x - e, y - n).min() < NEAR]
        if near:
            east, north, share = np.array(near).T
            axes.scatter(east, north, c=share, cmap=colours, norm=scale, s=26, zorder=3)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("east, m")
    panels[0].set_ylabel("north, m")
    figure.colorbar(plt.cm.ScalarMappable(scale, colours), ax=list(panels), label="share", pad=0.02)
