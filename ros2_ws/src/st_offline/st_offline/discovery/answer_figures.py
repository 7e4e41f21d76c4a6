"""The figures of the answer itself: waterfall, parts of the gap, runs before and after, what the drives can show."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from st_core.palette import MEASURED_COLOUR

from ..evaluation.drawing import BAD, TEXT, WIDTH, Drawn, finish, style
from . import quantities, report_text
from .figures import AFTER, Scene

UNEXPLAINED = "unexplained"
SIZES = ("small", "medium", "large")


def waterfall(scene: Scene) -> Drawn | None:
    """Held-out 5 s position error from the base model to the last step."""
    steps = scene.found.steps
    if not steps or not all(np.isfinite((s.position_5s.base, s.position_5s.augmented)).all() for s in steps):
        return None  # without the position there is no such error
    floor = scene.found.gap["position_5s"].floor if "position_5s" in scene.found.gap else 0.0
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.2 + 0.36 * (len(steps) + 2)))
        axes.set_axisbelow(True)
        first, last = steps[0].position_5s.base, steps[-1].position_5s.augmented
        rows = [f"{scene.found.base.base.name} model, {scene.found.start}"]
        axes.barh(0, first, color=scene.colour, height=0.62)
        _label(axes, first, 0, quantities.metres(first))
        for row, step in enumerate(steps, 1):
            before, after = step.position_5s.base, step.position_5s.augmented
            axes.plot([before, before], [row - 0.7, row + 0.31], color=TEXT, lw=0.6, alpha=0.5)
            axes.barh(row, before - after, left=after, color=AFTER if after <= before else BAD, height=0.62, alpha=0.65)
            ends = [before - edge for edge in step.position_5s.interval]
            axes.plot(ends, [row, row], color=TEXT, lw=1.0)
            change = f"{after - before:+.2f} m".replace("-", "−")
            small = abs(after - before) < report_text.LEAST and report_text.other_channel(step)
            _label(axes, max(before, after, *ends), row, small or change)
            rows.append(f"{report_text.step_name(step)}  {quantities.short_values(step.parameters)}")
        axes.plot([last, last], [len(steps) + 0.31, len(steps) + 0.69], color=TEXT, lw=0.6, alpha=0.5)
        axes.barh(len(steps) + 1, last, color=AFTER, height=0.62)
        _label(axes, last, len(steps) + 1, quantities.metres(last))
        axes.axvline(floor, color=MEASURED_COLOUR, lw=1.4, ls="--")
        axes.set_yticks(range(len(steps) + 2), [*rows, "with all that was found"])
        axes.set(ylim=(len(steps) + 1.6, -0.6), xlim=(0.0, 1.16 * max(first, *(s.position_5s.base for s in steps))),
                 xlabel="mean position error after 5 s on held-out driving, m")
        rises = any(s.position_5s.augmented > s.position_5s.base for s in steps)
        handles = [Patch(color=scene.colour, label=f"{scene.found.base.base.name} model"),
                   Patch(color=AFTER, label="with what was found"), Patch(color=AFTER, alpha=0.65, label="taken away"),
                   *([Patch(color=BAD, alpha=0.65, label="made worse")] if rises else []),
                   Line2D([], [], color=MEASURED_COLOUR, ls="--", label="noise alone")]
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))
        caption = ("One effect more in each row, all values fitted anew; every error is on driving its values were not "
                   "fitted to. Line: 95 % of the change.")
        return finish(figure, scene.place, "waterfall", report_text.title(scene.found), caption)


def _label(axes: plt.Axes, x: float, row: int, text: str) -> None:
    axes.annotate(text, (x, row), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)


def budget(scene: Scene) -> Drawn | None:
    """What each part takes of the error: added last, and added first."""
    lines = [one for one in scene.found.budget if np.isfinite((one.last, one.first)).all()]
    if not lines:
        return None
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.1 + 0.4 * len(lines)))
        axes.set_axisbelow(True)
        for row, one in enumerate(lines):
            colour = MEASURED_COLOUR if one.part == UNEXPLAINED else AFTER
            axes.barh(row - 0.18, one.last, color=colour, height=0.32)
            axes.barh(row + 0.18, one.first, color=colour, height=0.32, alpha=0.45)
            _label(axes, max(one.last, one.first, 0.0), row, report_text.span(one))
        axes.set_yticks(range(len(lines)), [one.part for one in lines])
        axes.set_ylim(len(lines) - 0.4, -0.6)
        top = max(*(max(one.last, one.first) for one in lines), 1e-3)
        axes.set_xlim(min(0.0, 1.1 * min(min(one.last, one.first) for one in lines)), 1.35 * top)
        axes.set_xlabel("part of the mean position error after 5 s on held-out driving, m")
        handles = [Patch(color=AFTER, label="added last: gain when all others are in"),
                   Patch(color=AFTER, alpha=0.45, label="added first: gain with nothing else in"),
                   Patch(color=MEASURED_COLOUR, label="unexplained")]
        figure.legend(handles=handles, loc="outside lower left", ncols=3)
        largest = max(lines, key=lambda one: max(one.last, one.first))
        title = f"Where the error comes from, most from: {largest.part}, {report_text.span(largest)}"
        caption = ("Where both bars of a part are alike, its share does not depend on what else is blamed; added last "
                   "is the larger one where a part shows only once the others are mended. Unexplained: noise included.")
        return finish(figure, scene.place, "budget", title, caption)


def runs(scene: Scene) -> Drawn | None:
    """Mean position error after 5 s of each run, before and after."""
    steps = scene.found.steps
    if not steps:
        return None
    before = {name: pair[0] for name, pair in steps[0].runs.items()}
    after = {name: pair[1] for name, pair in steps[-1].runs.items()}
    names = sorted((name for name in before if np.isfinite((before[name], after.get(name, np.nan))).all()),
                   key=lambda name: -before[name])
    if not names:
        return None
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.1 + 0.27 * len(names)))
        for row, name in enumerate(names):
            axes.plot([before[name], after[name]], [row, row], color=TEXT, lw=0.7, alpha=0.5, zorder=1)
            axes.plot(before[name], row, "o", ms=7, color=scene.colour, zorder=2)
            axes.plot(after[name], row, "o", ms=7, color=AFTER, zorder=3)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("mean position error after 5 s on held-out driving, m")
        figure.legend(handles=[Line2D([], [], color=scene.colour, marker="o", ls="", label="before"),
                               Line2D([], [], color=AFTER, marker="o", ls="", label="after")],
                      loc="outside lower left", ncols=2)
        better = sum(after[name] < before[name] for name in names)
        title = f"The error became smaller on {better} of {len(names)} runs"
        return finish(figure, scene.place, "runs", title, "Each run predicted with values fitted to other driving.")


def certificate(scene: Scene) -> Drawn | None:
    """How often each effect, put into these very drives, would be found, at three sizes."""
    powers = scene.found.certificate.powers
    if not powers:
        return None
    rows: dict[tuple[str, str], list] = {}
    for power in powers:
        rows.setdefault((power.effect, power.parameter), []).append(power)
    ranked = sorted(rows.values(), key=lambda entries: -sum(p.found for p in entries))
    ranked = [sorted(entries, key=lambda p: abs(p.size)) for entries in ranked]
    most = max(map(len, ranked))
    grid = np.full((len(ranked), most), np.nan)
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 1.3 + 0.25 * len(ranked)))
        for row, entries in enumerate(ranked):
            for column, power in enumerate(entries):
                grid[row, column] = power.found
                text = f"{quantities.change(power.size, power.unit)}: {100 * power.found:.0f} %"
                axes.text(column, row, text, ha="center", va="center", fontsize=8,
                          color="white" if power.found < 0.55 else "black")
        image = axes.imshow(grid, aspect="auto", cmap="cividis", vmin=0.0, vmax=1.0)
        axes.grid(False)
        alone = {effect: sum(e == effect for e, _ in rows) == 1 for effect, _ in rows}
        axes.set_yticks(range(len(ranked)), [quantities.plain(e[0].effect) + ("" if alone[e[0].effect] else
                                             f", {quantities.plain(e[0].parameter)}") for e in ranked])
        axes.set_xticks(range(most), SIZES[:most] if most <= len(SIZES) else [f"{k + 1}" for k in range(most)])
        axes.tick_params(length=0)
        figure.colorbar(image, ax=axes, label="found, share of cases", pad=0.01)
        seen = sum(max(p.found for p in entries) >= report_text.SHOWN for entries in ranked)
        title = f"Of {len(ranked)} effects, {seen} would be found in these drives at one of three sizes"
        certificate = scene.found.certificate
        caption = ("Known effects put into these recordings and searched for" if certificate.driven else
                   "Predicted from how these drives constrain the values; --certify drives each of them") + "."
        return finish(figure, scene.place, "certificate", title, caption)
