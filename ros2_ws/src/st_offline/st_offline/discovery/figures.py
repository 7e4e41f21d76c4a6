"""Draws the figures of a discovery: error by step, axle forces, error map, local estimates of effects, relation."""

import textwrap
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from st_core.channels import UNITS
from st_core.discovery import Discovery
from st_core.discovery.error_regions import Samples
from st_core.discovery.result import LocalEstimate, Step
from st_core.log import DriveLog
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_core.regression import Z95
from st_core.relations import Relation
from st_core.relations.candidates import QUANTITIES

from ..evaluation.drawing import BAD_COLOUR, TEXT_COLOUR, WIDTH, FigureOutput, PageFigure, save_figure
from . import quantities, report_text

AFTER_COLOUR = MODEL_COLOUR["augmented"]
HALF_WIDTH = 6.8  # inch; for two figures side by side on the page
MIN_CHANGE = 0.005  # m; if the position error changes less, the channel error with the lowest ratio is reported instead
MIN_ASPECT = 0.3  # `_compute_aspect_ratio` of a track; the axes of narrower tracks have different scales
MAX_PANELS = 6  # maximum number of effects in the figure of local estimates
MAX_ROWS = 14  # a partition with more parts, or by place, is drawn in one row
AXIS_LIMIT = 3.0  # largest magnitude on the axis of local ratios; longer intervals are cut off there


def draw_waterfall(discovery: Discovery, output: FigureOutput) -> PageFigure | None:
    """Draw the held-out position error after 5 s at each step of the search; None without steps or position errors."""
    steps, position = discovery.steps, discovery.errors.get("position_5s")
    if not steps or position is None or not np.isfinite(position.base):
        return None
    base = discovery.base.base.name
    base_colour = MODEL_COLOUR.get(base, TEXT_COLOUR)
    figure, axes = plt.subplots(figsize=(WIDTH, 1.1 + 0.3 * (len(steps) + 2)))
    axes.set_axisbelow(True)
    first, last = steps[0].position_5s.base, steps[-1].position_5s.augmented
    labels = [f"{base} model, {discovery.start}"]
    axes.barh(0, first, color=base_colour, height=0.62, label=f"{base} model")
    _annotate(axes, first, 0, quantities.format_metres(first))
    for row, step in enumerate(steps, 1):
        before, after = step.position_5s.base, step.position_5s.augmented
        axes.plot([before, before], [row - 0.7, row + 0.31], color=TEXT_COLOUR, lw=0.6, alpha=0.5)
        colour, change = (AFTER_COLOUR, "reduction") if after - before <= MIN_CHANGE else (BAD_COLOUR, "increase")
        axes.barh(row, before - after, left=after, color=colour, height=0.62, alpha=0.65, label=change)
        ends = [before - end for end in step.position_5s.interval]
        axes.plot(ends, [row, row], color=TEXT_COLOUR, lw=1.0)
        label, text = _format_step(discovery, step)
        _annotate(axes, max(before, after, *ends), row, text)
        labels.append(label)
    end = "model with identified effects only" if discovery.effective else "complete model"
    axes.plot([last, last], [len(steps) + 0.31, len(steps) + 0.69], color=TEXT_COLOUR, lw=0.6, alpha=0.5)
    axes.barh(len(steps) + 1, last, color=AFTER_COLOUR, height=0.62, label=end)
    _annotate(axes, last, len(steps) + 1, quantities.format_metres(last))
    axes.axvline(position.floor, color=MEASURED_COLOUR, lw=1.4, ls="--", label="noise level")
    axes.set_yticks(range(len(steps) + 2), [*labels, end])
    axes.set(ylim=(len(steps) + 1.6, -0.6), xlim=(0.0, 1.16 * max(first, *(s.position_5s.base for s in steps))),
             xlabel="mean position error after 5 s on held-out driving, m")
    caption = ("Each row adds one effect, refits all values, and shows the effect and the change of the error. Line: "
               "95 % interval of the change. Effects in parentheses are part of the fit, but not reported as causes.")
    return save_figure(figure, output, "waterfall", "Error of each step of the search", caption)


def _format_step(discovery: Discovery, step: Step) -> tuple[str, str]:
    """(effect and values of a step, in parentheses if it is not a reported cause; change of the error)."""
    label = f"{quantities.to_words(step.effect)}  {quantities.format_briefly(step.effect, step.parameters)}"
    change = step.position_5s.augmented - step.position_5s.base
    text = f"{change:+.2f} m"
    ratios = {channel: c.augmented / c.base for channel, c in step.channels.items() if c.base > 0}
    if abs(change) < MIN_CHANGE and ratios:
        best = min(ratios, key=ratios.__getitem__)
        text = f"{quantities.label_channel(best)} error {100 * (ratios[best] - 1.0):+.0f} %"
    is_named = step.effect in {e.name for e in discovery.effects}
    return f"+ {label}" if is_named else f"+ ({label})", text.replace("-", "−")


def _annotate(axes: plt.Axes, x: float, row: int, text: str) -> None:
    axes.annotate(text, (x, row), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)


def draw_axle_curves(discovery: Discovery, output: FigureOutput) -> PageFigure | None:
    """Draw the force of each axle versus slip angle with its 90 % interval, and the distribution of slip angles."""
    curves = discovery.axle_curves
    if not curves or not discovery.model:
        return None
    base_colour = MODEL_COLOUR.get(discovery.base.base.name, TEXT_COLOUR)
    figure, panels = plt.subplots(2, len(curves), figsize=(HALF_WIDTH, 3.3), sharex="col", squeeze=False,
                                  height_ratios=(3.0, 1.0))
    for (axes, lower), curve in zip(panels.T, curves, strict=True):
        slip = np.rad2deg(curve.slip)
        force, low, high, at_start = (1e-3 * np.array(v) for v in (curve.force, curve.low, curve.high, curve.file))
        axes.fill_between(slip, low, high, color=AFTER_COLOUR, alpha=0.25, lw=0, label="90 % interval")
        axes.plot(slip, force, color=AFTER_COLOUR, label="complete model")
        axes.plot(slip, at_start, color=base_colour, ls="--", label=discovery.start)
        ratio, lowest, highest = (v[-1] / curve.file[-1] for v in (curve.force, curve.low, curve.high))
        axes.set_title(f"{curve.axle} axle\n{ratio:.2f} (90 %: {lowest:.2f} to {highest:.2f}) times the "
                       f"{discovery.start} at {slip[-1]:.1f}°", fontsize=7)
        lower.stairs(100.0 * np.array(curve.density), slip, color=MEASURED_COLOUR, fill=True)
        lower.set_xlabel("slip angle, °")
    panels[0][0].set_ylabel("lateral force, kN")
    panels[1][0].set_ylabel("samples, %")
    return save_figure(figure, output, "axle_curves", "Axle force versus slip angle, in the range of the drives",
                       "The band includes the uncertainty of the other vehicle parameters.")


def draw_maps(discovery: Discovery, runs: Sequence[DriveLog], before: Samples, after: Samples | None,
              output: FigureOutput) -> PageFigure | None:
    """Draw the track of the run with the largest mean squared error and the starts of its predictions, coloured by the
    error of the base model and of the complete model; None without errors. Narrow tracks are left out if possible.

    The channel is that of the region with the highest lower limit of the error ratio; without regions, the first.
    before, after: errors of the base and of the complete model in `runs`, the suspect drives.
    """
    regions = [region for region in discovery.large_error_regions if region.channel in before.squares]
    channel = max(regions, key=lambda r: r.interval[0]).channel if regions else next(iter(before.squares))
    squares = before.squares[channel]
    if not len(squares):
        return None
    indices = np.unique(before.run).tolist()
    wide = [k for k in indices if _compute_aspect_ratio(runs[k]) > MIN_ASPECT]
    run = max(wide or indices, key=lambda k: float(squares[before.run == k].mean()))
    models = [("base model", before)] + ([("complete model", after)] if after else [])
    factor, unit = quantities.get_display_unit(UNITS[channel])
    largest = factor * max(float(np.nanmax(np.sqrt(samples.squares[channel][samples.run == run]), initial=1e-12))
                           for _, samples in models)
    log = runs[run]
    shape = np.ptp(log.y) / max(np.ptp(log.x), 1e-9) if wide else 0.5
    size = (HALF_WIDTH, float(np.clip(0.4 * HALF_WIDTH * shape, 1.2, 3.5)) + 0.9)
    figure, panels = plt.subplots(1, len(models), figsize=size, sharex=True, sharey=True, squeeze=False)
    stride = max(1, len(log.x) // 600)
    for axes, (name, samples) in zip(panels[0], models, strict=True):
        subset = np.flatnonzero(samples.run == run)
        subset = subset[:: max(1, len(subset) // 500)]
        error = factor * np.sqrt(samples.squares[channel][subset])
        axes.plot(log.x[::stride], log.y[::stride], color=MEASURED_COLOUR, lw=0.6, alpha=0.6, zorder=1)
        points = axes.scatter(samples.x[subset], samples.y[subset], c=error, s=14, cmap="cividis", zorder=2,
                              linewidths=0, rasterized=True, vmin=0.0, vmax=largest)
        if wide:
            axes.set_aspect("equal", adjustable="box")
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("east, m")
    panels[0][0].set_ylabel("north, m")
    figure.colorbar(points, ax=list(panels[0]), label=f"{quantities.label_channel(channel)} error, {unit}")
    title = f"{log.name}: {quantities.label_channel(channel)} error on the map"
    caption = "Each point is the start of a prediction, coloured by its error. All panels have the same colour scale."
    return save_figure(figure, output, "map", title, caption)


def _compute_aspect_ratio(log: DriveLog) -> float:
    """Smaller extent of the track, to the east or to the north, divided by the larger one."""
    width, height = np.ptp(log.x), np.ptp(log.y)
    return float(min(width, height) / max(width, height, 1e-9))


def draw_agreement(discovery: Discovery, output: FigureOutput) -> PageFigure | None:
    """Draw the ratio of the local estimate to the overall estimate of each effect, for each part of the drives."""
    effects = report_text.sort_by_size([e for e in discovery.effects if any(e.agreement.values())])[:MAX_PANELS]
    if not effects:
        return None
    parts: dict[str, dict[str, None]] = {}  # names of the parts of each partition; the dict keeps their order
    for e in effects:
        for partition, entries in e.agreement.items():
            parts.setdefault(partition, {}).update(dict.fromkeys(v.subset for v in entries))
    single_row_labels = {partition: f"{len(names)} {partition}s" for partition, names in parts.items()
                         if partition == "place" or len(names) > MAX_ROWS}
    labels = [(partition, label) for partition, names in parts.items()
              for label in ([single_row_labels[partition]] if partition in single_row_labels else names)]
    figure, panels = plt.subplots(1, len(effects), figsize=(HALF_WIDTH, 1.3 + 0.17 * len(labels)), sharey=True,
                                  squeeze=False)
    for axes, effect in zip(panels[0], effects, strict=True):
        _draw_ratios(axes, [(labels.index((partition, v.subset)), v) for partition, entries in effect.agreement.items()
                            if partition not in single_row_labels for v in entries])
        for partition in single_row_labels.keys() & effect.agreement.keys():
            ratios = np.clip([v.ratio for v in effect.agreement[partition]], *axes.get_xlim())
            row = labels.index((partition, single_row_labels[partition]))
            axes.plot(ratios, np.full(len(ratios), row), "|", ms=7, color=AFTER_COLOUR, alpha=0.6)
        title = textwrap.fill(quantities.to_words(effect.name), 64 // len(effects), break_long_words=False)
        axes.set_title(title, fontsize=8)
    for row in (row for row in range(1, len(labels)) if labels[row - 1][0] != labels[row][0]):
        for axes in panels[0]:
            axes.axhline(row - 0.5, color=TEXT_COLOUR, lw=0.5)
    figure.supxlabel("ratio of the local to the overall estimate", fontsize=8)
    panels[0][0].set_yticks(range(len(labels)), [label for _, label in labels], fontsize=7)
    panels[0][0].set_ylim(len(labels) - 0.5, -0.5)
    caption = ("Point: the effect refitted to one part of the drives, with the other effects fixed, divided by "
               "the overall estimate; filled if the 95 % interval (bar) excludes zero. Solid line: the overall "
               "estimate; dotted line: zero. A property of the car is the same everywhere.")
    return save_figure(figure, output, "agreement", "Local estimates of each effect", caption)


def _draw_ratios(axes: plt.Axes, ratios: Sequence[tuple[int, LocalEstimate]]) -> None:
    """Draw (row, local estimate) with 95 % intervals, and set the range of the axis."""
    axes.axvline(0.0, color=TEXT_COLOUR, lw=0.8, ls=":")
    axes.axvline(1.0, color=TEXT_COLOUR, lw=0.8)
    for row, estimate in ratios:
        half_width = Z95 * estimate.deviation
        low, high = estimate.ratio - half_width, estimate.ratio + half_width
        is_significant = low > 0.0 or high < 0.0
        axes.plot(np.clip([low, high], -AXIS_LIMIT, AXIS_LIMIT), [row, row], color=AFTER_COLOUR, lw=1.2)
        axes.plot(np.clip(estimate.ratio, -AXIS_LIMIT, AXIS_LIMIT), row, "o", ms=4.5, color=AFTER_COLOUR,
                  mfc=AFTER_COLOUR if is_significant else "none")
    ends = [v.ratio + side * Z95 * v.deviation for _, v in ratios for side in (-1.0, 1.0)]
    axes.set_xlim(max(min([-0.2, *ends]), -AXIS_LIMIT) - 0.05, min(max([1.2, *ends]), AXIS_LIMIT) + 0.05)


def draw_relation(relation: Relation, output: FigureOutput) -> PageFigure:
    """Draw the curve of a relation with its 95 % interval, and the distribution of the samples below it."""
    c = relation.candidate
    (y_scale, unit), (x_scale, x_unit) = map(quantities.get_curve_unit, (c.unit, QUANTITIES[c.quantity]))
    u, y = x_scale * relation.points, y_scale * relation.value
    half_width = y_scale * Z95 * relation.deviation
    figure, (curve, distribution) = plt.subplots(2, 1, figsize=(WIDTH, 3.6), sharex=True, height_ratios=(3.0, 1.0))
    curve.axhline(0.0, color=TEXT_COLOUR, lw=0.8, ls=":")
    curve.fill_between(u, y - half_width, y + half_width, color=AFTER_COLOUR, alpha=0.25, lw=0, label="95 % interval")
    curve.plot(u, y, color=AFTER_COLOUR, label="proposed relation")
    for k, (low, high) in enumerate(relation.next_drives.sparse_ranges):
        for axes in (curve, distribution):
            axes.axvspan(x_scale * low, x_scale * high, color=MEASURED_COLOUR, alpha=0.12, lw=0,
                         label="few samples" if axes is curve and not k else None)
    curve.set_ylabel(f"{textwrap.fill(quantities.make_axis_label(c), 28)}, {unit}")
    curve.legend(loc="best")
    distribution.set_axisbelow(True)
    distribution.bar(u, 100.0 * relation.density, width=u[1] - u[0], color=MEASURED_COLOUR)
    # Most driving is straight at constant speed; a linear scale would hide the other bins.
    distribution.set(yscale="log", ylim=(0.02, 100.0), yticks=(0.1, 1.0, 10.0, 100.0))
    distribution.yaxis.set_major_formatter("{x:g}")
    distribution.set(ylabel="samples, %", xlabel=f"{quantities.QUANTITY_NAMES[c.quantity]}, {x_unit}")
    errors = "; held-out position error after 5 s: {:.3f} m without it, {:.3f} m with it"
    title = f"PROPOSAL: {quantities.describe_relation(relation)}{relation.describe_errors(errors)}"
    units = f"y in {c.unit}, u in {QUANTITIES[c.quantity]}".replace("^2", "²")
    formula = f"As a formula: {relation.formulas[0].text}, {units}. " if relation.formulas else ""
    caption = (f"{formula}The dotted line at zero is the model without the relation. The curve is fitted by "
               "simulation together with all identified effects; it is constant beyond the range of the drives. "
               "In the grey ranges with few samples it is interpolated, and the interval assumes the same smoothness. "
               "The other figures do not contain the relation.")
    return save_figure(figure, output, "relation", title, caption)
