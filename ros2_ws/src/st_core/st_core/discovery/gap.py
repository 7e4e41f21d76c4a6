"""Which drives serve what, and the error before and after on those that served nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..log import DriveLog
from .floor import Floor
from .quadratic import costs, row_errors, whitened
from .result import Gap, Split
from .settings import UNITS, DiscoverySettings
from .study import Fit, Study
from .windows import CHANNEL_OF, Windows

HELD_OUT_FROM = 4  # runs; with fewer each is predicted by values fitted to the others
LONG = 5.0  # s
RESAMPLES = 400
RISE = 3.0  # of twice the negative log-likelihood: a run that does not show an effect may say nothing of it


@dataclass(frozen=True, eq=False)
class Parts:
    used: list[DriveLog]
    held_out: list[DriveLog]
    said: Split


def split(runs: Sequence[DriveLog], settings: DiscoverySettings) -> Parts:
    """Every fourth run is held out: the ones that are driven least hard, so that what is learnt covers them."""
    runs = list(runs)
    names = tuple(run.name for run in runs)
    if len(runs) >= HELD_OUT_FROM:
        hardness = [float(np.std(run.yaw_rate * run.velocity_x)) for run in runs]
        middle = np.argsort(np.abs(np.array(hardness) - np.median(hardness)), kind="stable")
        held = sorted(middle[:len(runs) // HELD_OUT_FROM].tolist())
        used = [run for i, run in enumerate(runs) if i not in held]
        kept = [runs[i] for i in held]
        said = Split(tuple(r.name for r in used), tuple(r.name for r in used), tuple(r.name for r in kept),
                     "held-out runs served nothing else")
        return Parts(used, kept, said)
    if len(runs) > 1:
        return Parts(runs, [], Split(names, names, names, "too few runs to hold one out: each is predicted and "
                                     "reported on with values fitted to the others"))
    return Parts(runs, [], Split(names, names, names, f"one run only: blocks of {settings.block:g} s are "
                                 "predicted with values fitted to the other half of the blocks"))


def folds(windows: Windows) -> np.ndarray:
    """(b,) fold of each block: its run, or odd and even blocks of a single run."""
    first = np.unique(windows.block, return_index=True)[1]
    run = windows.run[first]
    return run if len(np.unique(run)) > 1 else np.arange(len(first)) % 2


def measure(parts: Parts, vehicle, study: Study, fit: Fit, vector: np.ndarray, floor: Floor) -> dict[str, Gap]:
    """By channel at the end of the horizon, and the position after LONG seconds."""
    result = {}
    for long in (False, True):
        if long and "position" not in study.settings.channels:
            continue
        settings = replace(study.settings, horizon=LONG) if long else study.settings
        before, after, run, block, columns = _errors(parts, vehicle, study, fit, vector, settings, long)
        if not len(run):
            continue
        for channel in ("position",) if long else dict.fromkeys(CHANNEL_OF.get(c, c) for c in columns):
            mine = [i for i, c in enumerate(columns) if CHANNEL_OF.get(c, c) == channel]
            squares = [np.square(e[:, mine]).sum(axis=1) for e in (before, after)]
            name = "position_5s" if long else channel
            size = None if long else floor.size.get(channel)
            result[name] = _gap(squares, run, block, study, parts, UNITS[name], size if floor.quadratic else None)
    return result


def shrinks(gaps: Mapping[str, Gap], study: Study, fit: Fit) -> bool:
    """Whether errors go down with what was found on driving that its values were not fitted to.

    With a reference the cost must fall by values fitted to the other runs, all else as in the healthy car, and rise in
    no run: what healthy drives gain by accident one of them denies. Where runs differ one may; then errors at the end
    of the horizon must shrink, over all channels, in half widths of their intervals. Without a reference one surely
    must."""
    surely = any(g.interval[0] > 0.0 for g in gaps.values())
    if study.floor.quadratic is None:
        return surely
    each = falls(study, fit)
    if each.sum() > 0.0 and each.min() > -RISE:
        return True
    together = sum((g.base - g.augmented) / max(0.5 * (g.interval[1] - g.interval[0]), 1e-12) for g in gaps.values())
    return study.floor.restless > 0.0 and (surely or together > 0.0)


def explained(study: Study, fit: Fit) -> float:
    """What the effects alone explain of runs they were not fitted to, over what healthy drives as long cost [1]."""
    floor, windows = study.floor, study.quadratic.windows
    return float(falls(study, fit).sum() * floor.inflation / (windows.sum() * floor.level.mean()))


def falls(study: Study, fit: Fit) -> np.ndarray:
    """(folds,) of twice the negative log-likelihood of each fold, from the healthy base to the effects alone, fitted to
    the other folds."""
    return np.array([_fall(study, fit, fold) for fold in np.unique(study.folds)])


def _fall(study: Study, fit: Fit, fold: int) -> float:
    mine = study.folds == fold
    vector = study.only(fit, study.space.indices(*fit.names), ~mine)
    rows = row_errors(study.windows, study.space, vector)
    each, _ = costs(whitened(rows, study.windows.condition, study.floor.how), study.windows)
    return float(study.quadratic.cost[mine].sum() - each[mine[study.windows.block]].sum()) / study.floor.inflation


def _errors(parts: Parts, vehicle, study: Study, fit: Fit, vector: np.ndarray, settings, long: bool):
    space, base = study.space, study.floor.vector
    if parts.held_out:
        windows = Windows(parts.held_out, vehicle, settings)
        groups = [(vector, np.ones(len(windows), bool))]
    else:
        windows = Windows(parts.used, vehicle, settings) if long else study.windows
        groups = [(study.only(fit, space.indices(*fit.names), study.folds != fold), mine)
                  for fold, mine in _members(windows, study)]
    before = windows.errors(space.at(base), float(base[-1]))
    last = before.values[:, -1]
    after = last.copy()
    if fit.names:
        for values, mine in groups:
            errors = windows.errors(space.at(values), float(values[-1])).values[:, -1]
            after[mine] = errors[mine]
    known = np.isfinite(last).all(axis=1) & np.isfinite(after).all(axis=1)
    return last[known], after[known], windows.run[known], windows.block[known], before.columns


def _members(windows: Windows, study: Study):
    own = folds(windows)
    for fold in np.unique(study.folds):
        yield fold, own[windows.block] == fold


def _gap(squares, run, block, study: Study, parts: Parts, unit: str, floor: float | None) -> Gap:
    base, augmented = (float(np.sqrt(s.mean())) for s in squares)
    count = np.bincount(block)
    sums = [np.bincount(block, s) for s in squares]
    used = np.flatnonzero(count)
    rng = np.random.default_rng(study.settings.seed)
    drawn = rng.choice(used, (RESAMPLES, len(used)))
    number = count[drawn].sum(axis=1)
    difference = [np.sqrt(s[drawn].sum(axis=1) / number) for s in sums]
    tail = 0.5 * (1.0 - study.settings.confidence)
    low, high = np.quantile(difference[0] - difference[1], (tail, 1.0 - tail))
    names = [r.name for r in (parts.held_out or parts.used)]
    by_run = {i: [float(np.sqrt(s[run == i].mean())) for s in squares] for i in np.unique(run)}
    worst = max(by_run, key=lambda i: by_run[i][1])
    slack = 0.1 * (floor if floor is not None else base)
    worse = tuple(names[i] for i, (b, a) in by_run.items() if a > b + slack)
    return Gap(base, augmented, (float(low), float(high)), unit, floor, names[worst], by_run[worst][1], worse)

