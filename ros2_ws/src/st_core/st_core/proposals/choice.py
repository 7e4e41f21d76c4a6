"""Which of the laws that are sure is proposed, harmful nowhere, and which others the drives do not tell from it."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from ..discovery.limits import Limits
from .curve_fit import Fitted, Laws
from .places import Candidate
from .screening import Screened

REFITTED = 10  # laws fitted through the simulator
DRAWS = 999  # signs of the blocks drawn by chance


def to_fit(sure: Sequence[Screened]) -> list[Screened]:
    """The best law of every place, then those that hold out best. sure: best first."""
    first = {one.candidate.place: one for one in reversed(sure)}
    return list(dict.fromkeys([*sorted(first.values(), key=lambda s: -s.gain), *sure]))[:REFITTED]


def best_of(fits: Mapping[Screened, Fitted], worth: float) -> Screened:
    """The law that holds out best; one of two quantities has to be worth it beside the best of one."""
    return min(fits, key=lambda s: float(fits[s].held_out.sum()) + (worth if s.candidate.by else 0.0))


def least(fall: np.ndarray, doubt: float) -> float:
    """Lower bound of a sum over blocks (b,), at that chance (Student's t)."""
    spread = float(fall.std(ddof=1)) * np.sqrt(len(fall))
    return float(fall.sum() - stats.t.isf(doubt, len(fall) - 1) * spread)


def by_block(laws: Laws, values: np.ndarray) -> np.ndarray:
    """(b,) mean of each block of (n,) values of its windows; NaN where none is known."""
    known = np.isfinite(values)
    count = np.bincount(laws.block[known], minlength=laws.blocks)
    with np.errstate(invalid="ignore"):
        return np.bincount(laws.block[known], values[known], laws.blocks) / np.where(count, count, np.nan)


def harmful(laws: Laws, name: str, before: np.ndarray, after: np.ndarray, limits: Limits) -> str:
    """Why a law is worse than none on runs it was not fitted to, "" where it is not: the mean position error after 5 s
    rises, or that of one run surely does. before, after: (n,) [m]."""
    rise = after - before
    if not np.isfinite(rise).any():
        return ""
    if np.nanmean(rise) > 0.0:
        return (f"{name} is sure, but raises the position error after 5 s from {np.nanmean(before):.3f} to "
                f"{np.nanmean(after):.3f} m on runs it was not fitted to")
    blocks, run = by_block(laws, rise), np.zeros(laws.blocks, int)
    run[laws.block] = laws.windows.run
    names = laws.windows.names
    for k in np.unique(run):
        mine = blocks[(run == k) & np.isfinite(blocks)]
        # Of so many runs one is worse by chance.
        if len(mine) > 2 and least(mine, limits.doubt / len(names)) > 0.0:
            here = laws.windows.run == k
            return (f"{name} is sure, but makes {names[k]} worse when it is not fitted to it: "
                    f"{np.nanmean(before[here]):.3f} to {np.nanmean(after[here]):.3f} m after 5 s")
    return ""


def taken_away(laws: Laws, falls: np.ndarray, closer: np.ndarray, limits: Limits) -> str:
    """In words. falls: (b,) of the held-out loss. closer: (n,) fall of the position error [m]."""
    gain, low = (-np.expm1(-total / laws.loss.number) for total in (falls.sum(), least(falls, limits.doubt)))
    return (f"takes away {gain:.1%} of the size of the errors left, all channels together (95 %: at least {low:.1%}), "
            f"and {100 * mean_of(closer):.1f} cm after 5 s, on runs it was not fitted to")


def worthless(laws: Laws, law: Candidate, falls: np.ndarray, closer: np.ndarray, limits: Limits) -> str:
    """Why a law is not worth it, "" where it is: too little on runs it was not fitted to, perhaps nothing, or the path
    is no better with it by a chance above `limits.false_alarm`: to be misled by a law is as grave as a false one. A
    better path is not asked of what a sensor shows, nor where fewer than two blocks have a position."""
    little = falls.sum() < limits.worth * laws.loss.number and mean_of(closer) < limits.worth_position
    if little or least(falls, limits.doubt) <= 0.0:
        return f"{law.name} is sure, but {taken_away(laws, falls, closer, limits)}"
    blocks = by_block(laws, closer)
    blocks = blocks[np.isfinite(blocks)]
    if not law.of_sensor and len(blocks) > 1 and least(blocks, limits.false_alarm) <= 0.0:
        return (f"{law.name} is sure, but it is not sure that the predicted path is better with it: it "
                f"{taken_away(laws, falls, closer, limits)}")
    return ""


def mean_of(values: np.ndarray) -> float:
    """Of what is known; 0 where nothing is."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0


def not_told_apart(worse: np.ndarray, doubt: float, seed: int) -> np.ndarray:
    """(k,) whether each rival may be as good. worse: (k, b) its held-out loss by block beyond that of the best.

    Paired differences of blocks over their standard error, t; a rival is told apart where t is beyond what the largest
    of all reaches by chance: signs of whole blocks about the means, drawn for all rivals alike (Romano and Wolf 2005).
    """
    if not len(worse):
        return np.zeros(0, bool)
    count = worse.shape[1]
    about = worse - worse.mean(axis=1, keepdims=True)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, count))
    drawn = signs @ about.T / count
    spread = np.sqrt(np.maximum(np.square(about).mean(axis=1) - np.square(drawn), 1e-30) / (count - 1))
    largest = (drawn / spread).max(axis=1)
    t = worse.mean(axis=1) / np.maximum(worse.std(axis=1, ddof=1) / np.sqrt(count), 1e-30)
    return t <= np.quantile(largest, 1.0 - doubt)
