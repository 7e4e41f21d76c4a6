"""The advice as tables and a figure."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from rich.table import Table
from st_core.palette import MODEL_COLOUR

from ..evaluation.drawing import TEXT, WIDTH, Drawn, Place, finish, style
from ..terminal import rows_table
from .choice import Key, paid, speed_label
from .cost import Cost
from .worth import SHARE, Worth

MARKERS = ("o", "s", "^", "D", "v")


def rows(costs: Mapping[Key, Cost], worths: Mapping[Key, Worth]) -> list[dict[str, str]]:
    """One row for each model and step; columns by their titles. Costs also as multiples of the least of the column."""
    least = {kind: min(v for v in (getattr(one, kind) for one in costs.values()) if v is not None)
             for kind in ("floats", "compiled", "batch") if any(getattr(one, kind) for one in costs.values())}
    found = []
    for (model, step), cost in costs.items():
        row = {"model": model, "step, s": f"{step:g}"}
        row |= {f"{kind}, µs (x)": _time(getattr(cost, kind), least[kind]) for kind in least}
        one = worths.get((model, step))
        seconds = one.second if one else max((w.second for w in worths.values()), default=())
        for name, values in (("error", one and one.rms), ("band", one and one.width)):
            row |= {f"{name} {second} s, m": "-" if not values else f"{values[k]:.2f}"
                    for k, second in enumerate(seconds)}
        found.append(row)
    return found


def choice_rows(chosen: Mapping[float, tuple[Key | None, ...]]) -> list[dict[str, str]]:
    """One row for each speed, one column for each second ahead."""
    return [{"speed": speed_label(low)} | {f"{k + 1} s": "none" if key is None else f"{key[0]}, {key[1]:g} s"
                                           for k, key in enumerate(keys)} for low, keys in chosen.items()]


def table(found: Sequence[Mapping[str, str]], title: str, caption: str) -> Table:
    return rows_table(found, title=title, title_justify="left", title_style="bold", caption=caption,
                      caption_justify="left", padding=(0, 1))


def caption(worths: Mapping[Key, Worth]) -> str:
    levels = {one.level for one in worths.values()}
    level = next(iter(levels), None)
    bands = "band: none, from fewer than 3 runs" if level is None else (
        f"band: mean half-width across of the {level:.0%} band, whole path, calibrated on these runs")
    return ("processor time of one prediction, in brackets over the least; error: across, rms, inputs as driven; "
            f"{bands}")


def choice_title(tolerance: float) -> str:
    return f"Cheapest with {SHARE:.0%} of starts within {tolerance:g} m across up to then, inputs as driven"


def figure(costs: Mapping[Key, Cost], worths: Mapping[Key, Worth], tolerance: float, place: Place) -> Drawn:
    """Error and band half-width against cost, one panel a second ahead."""
    known = max((one.second for one in worths.values()), default=())
    seconds = [s for s in known if s in (1, 2, 3, 5)] or known[:1]
    steps = sorted({step for _, step in worths})
    with style():
        drawn, panels = plt.subplots(1, len(seconds), figsize=(WIDTH, 3.4), sharey=True, squeeze=False)
        for axes, second in zip(panels[0], seconds, strict=True):
            for (model, step), one in worths.items():
                k, marker = one.second.index(second), MARKERS[steps.index(step) % len(MARKERS)]
                cost, colour = 1e6 * paid(costs[model, step]), MODEL_COLOUR.get(model, TEXT)
                axes.plot(cost, one.rms[k], marker, color=colour, ms=5)
                if one.width is not None:
                    axes.plot([cost, cost], [one.rms[k], one.width[k]], color=colour, lw=0.7)
                    axes.plot(cost, one.width[k], marker, color=colour, ms=5, mfc="none")
            axes.axhline(tolerance, color=TEXT, lw=0.7, ls=(0, (4, 3)))
            axes.set(title=f"{second} s ahead", xscale="log", yscale="log", xlabel="µs a prediction")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        panels[0, 0].set_ylabel("across, m")
        models = list(dict.fromkeys(model for model, _ in worths))
        handles = [Line2D([], [], ls="", marker="o", color=MODEL_COLOUR.get(m, TEXT), label=m) for m in models]
        handles += [Line2D([], [], ls="", marker=MARKERS[k % len(MARKERS)], color=TEXT, label=f"step {step:g} s")
                    for k, step in enumerate(steps)]
        handles += [Line2D([], [], ls="", marker="D", color=TEXT, ms=5, label="error, rms"),
                    Line2D([], [], ls="", marker="D", color=TEXT, ms=5, mfc="none", label="half-width of the band"),
                    Line2D([], [], color=TEXT, lw=0.7, ls=(0, (4, 3)), label=f"{tolerance:g} m")]
        drawn.legend(handles=handles, loc="outside lower left", ncols=6)
        return finish(drawn, place, "advice", "What each model and step costs, and what it is worth",
                      f"Filled: rms error; hollow: half-width of the band; dashed: {tolerance:g} m.")


def _time(seconds: float | None, least: float) -> str:
    return "-" if seconds is None else f"{1e6 * seconds:.3g} ({seconds / least:.1f})"
