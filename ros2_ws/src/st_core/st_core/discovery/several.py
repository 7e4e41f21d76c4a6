"""One effect or more: forward steps with everything fitted anew, effects taken out again and exchanged, and when to say
that the library does not explain it."""

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from . import choice, testable
from .study import Fit, Study

SHARE, SHARE_OF_LITTLE = 0.05, 0.08  # of the whole gain another effect must bring; where little is left to explain
FURTHER = 2.8  # times the gain the first effect needs: what that explains imperfectly looks like another
ENOUGH = 0.8  # share of the best gain at which an effect that does its work alone is preferred
ORDINARY = 0.85  # excess of an ordinary healthy run
PARTNERS = 8  # pairs fitted to the end
UNKNOWN, SURELY = 1.7, 4.0  # mean excess, or times the limit, from which there is a gap though no name holds
RESTLESS = 0.3  # by how much more healthy runs exceed where they differ from each other
UNKNOWN_LEFT = 1.5  # excess an explanation may leave
LEAST, MOST = 0.2, 0.8  # shares of the excess an explanation takes away
# What all effects together may gain over an answer, and what more as a share of its gain.
TOGETHER, SHARE_TOGETHER = 90.0, 0.06
TOO_MANY = 3  # changes at once of a car that is known to have been healthy
NEARLY = 0.7  # share of the best gain at which another name does nearly as well


def excess(study: Study, fit: Fit, over: Callable = np.median) -> float:
    """Cost of a window over that of a window of healthy driving [1].

    over: blocks are compared by their median or, which sees a gap in a few of them, their mean. What it costs to move a
    healthy car's values so far is shared out.
    """
    q = fit.quadratic
    moved = max(fit.cost * study.floor.inflation - float(q.cost.sum()), 0.0) / max(int(q.windows.sum()), 1)
    return float((over(q.cost / np.maximum(q.windows, 1)) + moved) / over(study.floor.level))


def search(study: Study, fits: Mapping[str, Fit], limit: float, most: int) -> tuple[list[Fit], float]:
    """([the answer, the fits it beat ...], excess it leaves). limit: the gain another effect must bring."""
    base = study.base.cost
    best = min(fits.values(), key=lambda fit: fit.cost)
    near = [fit for fit in fits.values() if study.credible(fit) and base - fit.cost > ENOUGH * (base - best.cost)]
    answer = min(near or [best], key=lambda fit: fit.cost)
    while len(answer.names) < most:
        gain = base - answer.cost
        need = max(FURTHER * limit, (SHARE if excess(study, answer) > ORDINARY else SHARE_OF_LITTLE) * gain)
        need = need if study.credible(answer) else limit
        better = _joined(study, answer, fits, need)
        if better is None or answer.cost - better.cost < need or not study.credible(better):
            break
        better = _without_still(study, _without_idle(study, better, need))
        if set(better.names) == set(answer.names):
            break
        answer = better
        if len(answer.names) == 1:
            break
    return [answer], excess(study, answer)


def _joined(study: Study, answer: Fit, fits: Mapping[str, Fit], need: float) -> Fit | None:
    """The best fit with one effect more, exchanges of those found included."""
    names = study.space.hypotheses
    about = [(*answer.names, n) for n in names if n not in answer.names]
    if len(answer.names) == 1:
        strong = sorted(fits, key=lambda n: fits[n].cost)[:5]
        about += [pair for pair in combinations(strong, 2) if answer.names[0] not in pair]
        about += [(a, n) for a in strong if a != answer.names[0] for n in names if n not in (a, answer.names[0])]
    promise = {}
    for group in dict.fromkeys(tuple(sorted(g)) for g in about):
        promise[group] = study.promise(group, fits, answer)
    tried = sorted(promise, key=promise.get)[:PARTNERS]
    if not tried or answer.cost - promise[tried[0]] < 0.3 * need:
        return None
    joint = [study.fit(group, study.start_of(group, fits, answer)) for group in tried[:3]]
    return min(joint, key=lambda fit: fit.cost)


def _without_idle(study: Study, fit: Fit, need: float) -> Fit:
    """The fit without effects it hardly needs."""
    for name in fit.names:
        rest = tuple(n for n in fit.names if n != name)
        smaller = study.fit(rest, study.start_of(rest, {}, fit))
        if smaller.cost - fit.cost < need:
            return _without_idle(study, smaller, need) if len(rest) > 1 else smaller
    return fit


def _without_still(study: Study, fit: Fit) -> Fit:
    """The fit without effects that stay where a healthy car has them once nothing else may move with them."""
    change = (alone(study, fit) - study.floor.vector) / study.space.scale
    free = study.space.indices(*fit.names)
    moved = np.abs(change[free]) > testable.deviations(study, fit.quadratic, fit.names)
    for name in fit.names:
        if len(fit.names) > 1 and not moved[np.isin(free, study.space.indices(name))].any():
            rest = tuple(n for n in fit.names if n != name)
            return _without_still(study, study.fit(rest, study.start_of(rest, {}, fit)))
    return fit


def rivals(study: Study, answer: Fit, fits: Mapping[str, Fit], gain: float) -> dict[str, list[tuple[float, str]]]:
    """For each effect of the answer the (cost more, name) of those that could stand in its place."""
    result = {}
    for name in answer.names:
        rest = tuple(n for n in answer.names if n != name)
        alone = {n: f for n, f in fits.items() if n != name and study.credible(f)}
        swapped = _swapped(study, answer, name, rest, fits) if rest else alone
        names = choice.not_worse(swapped, answer, name, gain, study)
        result[name] = [(choice.behind(swapped[n], answer, study)[0], n) for n in names]
    return result


def _swapped(study: Study, answer: Fit, name: str, rest: tuple[str, ...], fits: Mapping[str, Fit]) -> dict[str, Fit]:
    others = [n for n in study.space.hypotheses if n not in answer.names]
    promise = {n: study.promise((*rest, n), fits, answer) for n in others}
    near = sorted(promise, key=promise.get)[:3]
    return {n: study.fit((*rest, n), study.start_of((*rest, n), fits, answer)) for n in near}


def unexplained(study: Study, answer: Fit, left: float, fits: Mapping[str, Fit]) -> bool:
    """Whether so much is left that the truth must be outside the library: next to nothing is explained, or not
    most of it and another effect does nearly as well."""
    before = excess(study, study.base)
    if left < UNKNOWN_LEFT:
        return False
    explained = (before - left) / max(before - 1.0, 1e-9)
    base = study.base.cost
    gains = sorted(base - fit.cost for name, fit in fits.items() if name not in answer.names)
    near = bool(gains) and gains[-1] > NEARLY * (base - answer.cost)
    return explained < LEAST or (explained < MOST and near)


def incomplete(study: Study, answer: Fit, fits: Mapping[str, Fit], slower: float) -> bool:
    """Whether all effects together would explain so much more that the answer only resembles the truth.

    slower: times as much as where car and road stay the same."""
    more = answer.cost - study.promise(study.space.hypotheses, fits, answer)
    return more > TOGETHER * slower + SHARE_TOGETHER * (study.base.cost - answer.cost)


def alone(study: Study, answer: Fit) -> np.ndarray:
    """The vector with the effects of the answer changed and all else that of the floor, fitted so."""
    free = study.space.indices(*answer.names)
    return study.only(answer, free)
