"""The figures of a discovery that show driving: errors on the map, over time, and paths from the worst start."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from st_core.batch import LogBatch, LogPrediction
from st_core.channels import UNITS
from st_core.log import DriveLog
from st_core.log_evaluation import regular_starts, usable_starts
from st_core.log_signals import LogSignals
from st_core.palette import MEASURED_COLOUR
from st_core.readings import readings

from ..evaluation.drawing import TEXT, WIDTH, Drawn, finish, style, thinned
from . import quantities
from .figures import AFTER, Scene

HORIZON, STEP, SLOWEST = 5.0, 0.05, 1.5  # s, s, m/s
PATHS = 3
FLAT = 0.3  # a track narrower than this share of its length is drawn stretched


def maps(scene: Scene) -> Drawn | None:
    """The track of one run, coloured by the error of the most affected channel, before and after."""
    run, levels = _worst_run(scene, of_area=True)
    if run is None:
        return None
    sides = [("before", scene.before)] + ([("after", scene.after)] if scene.after else [])
    top = quantities.factor(UNITS[scene.channel]) * max(float(np.nanmax(levels)), 1e-12)
    unit = UNITS[scene.channel]
    with style():
        log = scene.runs[run]
        shape = np.ptp(log.y) / max(np.ptp(log.x), 1e-9) if _flatness(log) > FLAT else 0.5
        size = (WIDTH, float(np.clip(0.4 * WIDTH * shape, 1.2, 5.0)) + 1.0)
        figure, panels = plt.subplots(1, len(sides), figsize=size, sharex=True, sharey=True, squeeze=False)
        every = max(1, len(log.x) // 600)
        for axes, (name, survey) in zip(panels[0], sides, strict=True):
            rows = np.flatnonzero(survey.samples.run == run)
            rows = rows[:: max(1, len(rows) // 500)]
            x, y = survey.samples.x[rows], survey.samples.y[rows]
            level = quantities.factor(unit) * np.sqrt(survey.samples.squares[scene.channel][rows])
            axes.plot(log.x[::every], log.y[::every], color=MEASURED_COLOUR, lw=0.6, alpha=0.6, zorder=1)
            points = axes.scatter(x, y, c=level, s=14, cmap="cividis", zorder=2, linewidths=0, rasterized=True,
                                  vmin=0.0, vmax=top)
            if _flatness(log) > FLAT:
                axes.set_aspect("equal", adjustable="box")
            axes.set_title("base model" if name == "before" else "with what was found", fontsize=9)
            axes.set_xlabel("east, m")
        panels[0][0].set_ylabel("north, m")
        bar = figure.colorbar(points, ax=list(panels[0]))
        bar.set_label(f"{quantities.channel(scene.channel)} error, {quantities.shown_unit(unit)}")
        title = f"{log.name}: where on the track the {quantities.channel(scene.channel)} is missed"
        return finish(figure, scene.place, "map", title, "Every point is one prediction, coloured by its error; the "
                      "same colours on both sides.")


def over_time(scene: Scene) -> Drawn | None:
    """Error of the most affected channel over the same run."""
    run, _ = _worst_run(scene)
    if run is None:
        return None
    unit = UNITS[scene.channel]
    with style():
        figure, axes = plt.subplots(figsize=(WIDTH, 2.7))
        for survey, colour in ((scene.before, scene.colour), (scene.after, AFTER)):
            if survey is None:
                continue
            rows = survey.samples.run == run
            level = quantities.factor(unit) * np.sqrt(survey.samples.squares[scene.channel][rows])
            axes.plot(*thinned(survey.samples.time[rows], level), color=colour, lw=1.2)
        parts = [p for p in scene.before.parts if p.run == run and p.channel == scene.channel]
        for part in parts:
            axes.axvspan(part.start, part.end, color=MEASURED_COLOUR, alpha=0.15, lw=0)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("time in the run, s")
        axes.set_ylabel(f"{quantities.channel(scene.channel)}\nerror, {quantities.shown_unit(unit)}")
        figure.legend(handles=scene.handles("s"), loc="outside lower left", ncols=3)
        caption = "Root mean square of each prediction." + (
            " Shaded: worse than like conditions on the rest of the run." if parts else
            " No part of the run is worse than like conditions elsewhere.")
        title = f"{scene.runs[run].name}: {quantities.channel(scene.channel)} error over the run"
        return finish(figure, scene.place, "time", title, caption)


def paths(scene: Scene) -> Drawn | None:
    """Measured and predicted paths over 5 s from the starts where the base model ends furthest off."""
    ends = (_ends(scene, log) for log in scene.runs if log.overlap > HORIZON)
    worst = max(ends, key=lambda e: e[1].max(initial=-1.0), default=None)
    if worst is None or not len(worst[1]):
        return None
    log, distance, batch, before = worst
    after = batch.predict(scene.found.model, scene.vehicle) if scene.found.model else None
    rows = _apart(batch.starts_ns, distance)
    with style():
        figure, panels = plt.subplots(1, len(rows), figsize=(WIDTH, 3.6), squeeze=False)
        for axes, row in zip(panels[0], rows, strict=True):
            start = int(batch.starts_ns[row])
            inside = slice(*np.searchsorted(log.ins_time_ns, (start, start + round(HORIZON * 1e9))))
            every = max(1, (inside.stop - inside.start) // 120)
            axes.plot(log.x[inside][::every], log.y[inside][::every], color=MEASURED_COLOUR, lw=5, alpha=0.45,
                      solid_capstyle="butt")
            axes.plot(log.x[inside.start], log.y[inside.start], "o", ms=4, color=TEXT, zorder=5)
            for paths, model, colour in ((before, scene.found.base, scene.colour), (after, scene.found.model, AFTER)):
                if paths is not None and model is not None:
                    seen = readings(model, scene.vehicle, tuple(paths.states[row].T))
                    axes.plot(seen.x, seen.y, color=colour)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_xlabel("east, m")
            axes.set_title(f"{(start - int(log.ins_time_ns[0])) * 1e-9:.1f} s", fontsize=9)
        panels[0][0].set_ylabel("north, m")
        lines = [Line2D([], [], color=MEASURED_COLOUR, lw=5, alpha=0.45, label="measured"),
                 Line2D([], [], color=scene.colour, label=f"{scene.found.base.base.name} model")]
        lines += [Line2D([], [], color=AFTER, label="with what was found")] if after is not None else []
        figure.legend(handles=lines, loc="outside lower left", ncols=3)
        text = f"{log.name}: from its worst starts the base model ends up to {distance[rows].max():.2f} m off after 5 s"
        if after is not None:
            text += f", with what was found {np.nanmax(_distance(batch, after)[rows]):.2f} m"
        return finish(figure, scene.place, "paths", text, "Predictions with the measured inputs. The model is "
                      "fitted to all drives; what it does on driving it was not fitted to is in the figures above.")


def _flatness(log: DriveLog) -> float:
    """Smaller over larger extent of the track."""
    width, height = np.ptp(log.x), np.ptp(log.y)
    return float(min(width, height) / max(width, height, 1e-9))


def _worst_run(scene: Scene, of_area: bool = False) -> tuple[int | None, np.ndarray]:
    """The run whose error in the channel is largest, and the errors of all its predictions [SI].

    of_area: of those whose track is no line, if there are any.
    """
    samples = scene.before.samples
    squares = samples.squares.get(scene.channel)
    if squares is None or not len(squares):
        return None, np.empty(0)
    runs = np.unique(samples.run)
    if of_area:
        wide = [_flatness(scene.runs[r]) > FLAT for r in runs]
        runs = runs[wide] if any(wide) else runs
    run = int(max(runs, key=lambda r: float(squares[samples.run == r].mean())))
    return run, np.sqrt(squares[samples.run == run])


def _ends(scene: Scene, log: DriveLog):
    signals = LogSignals(log, 0.1, 5.0)
    starts, _ = usable_starts(signals, scene.vehicle, regular_starts(log, 0.25), SLOWEST)
    batch = LogBatch(signals, starts, HORIZON, STEP, substeps="auto")
    prediction = batch.predict(scene.found.base, scene.vehicle)
    return log, np.nan_to_num(_distance(batch, prediction), nan=-1.0), batch, prediction


def _distance(batch: LogBatch, prediction: LogPrediction) -> np.ndarray:
    errors = batch.errors(prediction)
    return np.hypot(errors[:, -1, 0], errors[:, -1, 1])


def _apart(starts_ns: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Rows of the largest distances, a horizon apart from each other, in order of time."""
    rows: list[int] = []
    for row in np.argsort(-distance):
        if distance[row] < 0 or len(rows) == PATHS:
            break
        if all(abs(int(starts_ns[row]) - int(starts_ns[r])) > HORIZON * 1e9 for r in rows):
            rows.append(int(row))
    return np.sort(np.array(rows, int))
