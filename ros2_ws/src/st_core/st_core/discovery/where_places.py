"""When and where in space a drive misses more than its conditions explain: change points in time, cells of the track.

A corner is always harder than a straight, so levels are compared with what the same conditions give elsewhere:

    log(mean square + noise) = a + b . (log speed, log lateral acceleration, log steering rate, |forward acceleration|)

fitted over all predictions; what is left changes at a patch of ice, a gust or when something breaks.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from .where_bins import FEWEST_BLOCKS, Samples

CELL = 20.0  # m
SHORTEST = 8.0  # s, of a part between change points
LARGEST_P = 0.01
RELEVANT_STEP = 1.5  # times, of root mean squares
MOST_CHANGES = 3
SHUFFLES = 299  # enough to resolve a p of 0.01


@dataclass(frozen=True)
class Part:
    """A stretch of a run, [s] after its first measurement. step: level over the rest of the run, root mean square."""

    channel: str
    run: int
    start: float
    end: float
    step: float
    p: float


@dataclass(frozen=True)
class Cell:
    """A place of CELL x CELL, centre in the map frame [m]. step: level over that elsewhere under like conditions."""

    channel: str
    x: float
    y: float
    step: float
    interval: tuple[float, float]
    p: float


def remainders(samples: Samples, squares: np.ndarray, noise: float) -> np.ndarray:
    """(n,) logarithm of a level over what its conditions predict; NaN where not known."""
    c = samples.conditions
    rows = np.stack([np.ones(len(squares)), np.log(np.maximum(c["speed"], 0.5)),
                     np.log(np.abs(c["lateral_acceleration"]) + 0.2), np.log(c["steering_rate"] + 0.005),
                     np.abs(c["forward_acceleration"])], axis=1)
    values = np.log(squares + noise * noise)
    known = np.isfinite(values) & np.isfinite(rows).all(axis=1)
    left = np.full(len(squares), np.nan)
    if known.sum() > 4 * rows.shape[1]:
        fitted, *_ = np.linalg.lstsq(rows[known], values[known], rcond=None)
        left[known] = values[known] - rows[known] @ fitted
    return left


def changes(samples: Samples, channel: str, noise: float, block: float, seed: int, resamples: int) -> list[Part]:
    """Stretches on which a run is worse than on its rest, found by binary segmentation.

    A change counts when the largest cumulated sum of `remainders` is beyond that of the same blocks shuffled.
    """
    left = remainders(samples, samples.squares[channel], noise)
    rng = np.random.default_rng((seed, 17))
    parts = []
    for run in np.unique(samples.run):
        rows = np.flatnonzero((samples.run == run) & np.isfinite(left))
        if not len(rows):
            continue
        time, values = _seconds(samples.time[rows], left[rows])
        size = max(1, round(block))
        edges = sorted(_edges(values, 0, len(values), size, rng, resamples, MOST_CHANGES))
        cuts = [0, *(k for k, _ in edges), len(values)]
        if len(cuts) == 2:
            continue
        p = max(q for _, q in edges)
        for a, b in itertools.pairwise(cuts):
            rest = np.concatenate((values[:a], values[b:]))
            step = math.exp(0.5 * float(values[a:b].mean() - rest.mean()))
            if step >= RELEVANT_STEP:
                parts.append(Part(channel, int(run), float(time[a]), float(time[b - 1] + 1.0), step, p))
    return parts


def _seconds(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over whole seconds."""
    second = np.floor(time).astype(int)
    unique, index = np.unique(second, return_inverse=True)
    return unique.astype(float), np.bincount(index, values) / np.bincount(index)


def _edges(values: np.ndarray, first: int, last: int, block: int, rng: np.random.Generator, resamples: int,
           left: int) -> list[tuple[int, float]]:
    part = values[first:last]
    shortest = round(SHORTEST)
    if left < 1 or len(part) < 2 * shortest:
        return []
    sizes = _cusum(part[None])[0]
    at = int(np.argmax(sizes[shortest:-shortest])) + shortest if len(part) > 2 * shortest else shortest
    whole = len(part) // block * block
    if whole < 4 * block:
        return []
    pieces = part[:whole].reshape(-1, block)
    shuffled = np.stack([pieces[rng.permutation(len(pieces))].ravel() for _ in range(resamples)])
    largest = _cusum(shuffled).max(axis=1)
    p = (1 + int((largest >= sizes[at]).sum())) / (1 + resamples)
    if p > LARGEST_P:
        return []
    middle = first + at
    return [(middle, p), *_edges(values, first, middle, block, rng, resamples, left - 1),
            *_edges(values, middle, last, block, rng, resamples, left - 1)][:left]


def _cusum(rows: np.ndarray) -> np.ndarray:
    """|cumulated sum| of deviations from the mean, before each element; scaled by the spread and the length."""
    centred = rows - rows.mean(axis=1, keepdims=True)
    sums = np.cumsum(centred, axis=1) - centred
    return np.abs(sums) / (rows.std(axis=1, keepdims=True) * math.sqrt(rows.shape[1]) + 1e-12)


def cells(samples: Samples, channel: str, noise: float) -> list[Cell]:
    """Places passed at least FEWEST_BLOCKS times (blocks), with p that they are no worse than conditions say."""
    left = remainders(samples, samples.squares[channel], noise)
    known = np.isfinite(left) & np.isfinite(samples.x) & np.isfinite(samples.y)
    key = np.stack([np.floor(samples.x[known] / CELL), np.floor(samples.y[known] / CELL)], axis=1)
    unique, index = np.unique(key, axis=0, return_inverse=True)
    index = np.ravel(index)
    found = []
    for k, (column, row) in enumerate(unique):
        rows = np.flatnonzero(known)[index == k]
        means = np.array([left[rows[samples.block[rows] == b]].mean() for b in np.unique(samples.block[rows])])
        if len(means) < FEWEST_BLOCKS:
            continue
        deviation = max(float(means.std(ddof=1)) / math.sqrt(len(means)), 1e-6)
        mean, reach = float(means.mean()), float(stats.t.ppf(0.975, len(means) - 1)) * deviation
        found.append(Cell(channel, float(CELL * (column + 0.5)), float(CELL * (row + 0.5)), math.exp(0.5 * mean),
                          (math.exp(0.5 * (mean - reach)), math.exp(0.5 * (mean + reach))),
                          float(stats.t.sf(mean / deviation, len(means) - 1))))
    return found
