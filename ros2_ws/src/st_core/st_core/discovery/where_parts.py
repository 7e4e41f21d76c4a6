"""Tests for larger errors in parts of the driving: ranges of the conditions, stretches of a run, and places.

For each range (bin) of a condition:

    excess = sqrt(mean square error in the bin / expected mean square error)

The expected error is the error of the reference drives in the same bin, or in their worst bin if they have too few
blocks there; without a reference it is the sensor noise. Intervals and p-values are from resampling whole time blocks,
since errors of neighbouring predictions are correlated. Significance is corrected for the number of bins (Benjamini and
Hochberg, 1995).

Errors are larger in corners than on straights. Times and places are therefore compared by the residuals of a
regression of the errors on the conditions; ice, a gust or a defect changes these residuals. The regression is

    log(mean square + noise^2) = a + b . (log speed, log lateral acceleration, log steering rate,
                                          |forward acceleration|)
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ..binning import LATERAL_ACCELERATION_EDGES, SPEED_EDGES, STEERING_RATE_EDGES

STEERING_ANGLE = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad at the road wheels, magnitude
FORWARD_ACCELERATION = (-math.inf, -2.0, -0.7, 0.7, 2.0)  # m/s^2
MIN_TURNING = 0.5  # m/s^2 of lateral acceleration; driving with less counts as straight
MIN_BLOCKS = 4  # minimum number of blocks in a bin for an interval
FALSE_DISCOVERY_RATE = 0.05  # among the significant bins or cells
MIN_FLOOR_RATIO = 1.25  # minimum ratio of the error in a relevant bin to the floor

CELL_SIZE = 20.0  # m, side of a cell of the map
MIN_PART_DURATION = 8.0  # s between change points
MAX_P_VALUE = 0.01  # largest p-value of a reported change point
MIN_ERROR_RATIO = 1.5  # minimum ratio of RMS errors for a reported stretch or cell
MAX_CHANGES = 3  # change points per run and channel
PERMUTATIONS = 299  # enough to resolve a p-value of 0.01

EVERYWHERE = "everywhere"


@dataclass(frozen=True, eq=False)
class Samples:
    """Errors and conditions of n predictions. run: index into names. time [s]: since the first measurement of the run.
    x, y [m]: position at the start. block: number of the block of time; a block counts as one observation. conditions:
    (n,) by name. squares: (n,) mean square error by channel [unit^2]."""

    names: tuple[str, ...]
    run: np.ndarray
    time: np.ndarray
    x: np.ndarray
    y: np.ndarray
    block: np.ndarray
    conditions: Mapping[str, np.ndarray]
    squares: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Range:
    """Range of a condition. label: text for reports. low, high: limits; None for directions (left, straight, right)."""

    quantity: str
    label: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class BinExcess:
    """Error of one channel in one range. excess [1]: ratio to the expected error; interval: 95 %. p: p-value of the
    hypothesis that the error is not larger than expected. blocks: number of blocks. covered: whether the reference has
    enough driving in the range; True without a reference."""

    channel: str
    range: Range
    excess: float
    interval: tuple[float, float]
    p: float
    blocks: int
    covered: bool = True
    significant: bool = False


@dataclass(frozen=True)
class Part:
    """A stretch of a run. start, end [s]: since the first measurement of the run. ratio [1]: RMS error divided by the
    RMS error in the rest of the run under similar conditions."""

    channel: str
    run: int
    start: float
    end: float
    ratio: float
    p: float


@dataclass(frozen=True)
class Cell:
    """A square of the map with side CELL_SIZE. x, y [m]: its centre in the map frame. ratio [1]: ratio of the RMS error
    to the value expected under the same conditions; interval: 95 %."""

    channel: str
    x: float
    y: float
    ratio: float
    interval: tuple[float, float]
    p: float


def membership(samples: Samples) -> tuple[tuple[Range, ...], np.ndarray]:
    """(all ranges, (n, number of ranges) mask of the rows in each range); the first range contains every row."""
    c = samples.conditions
    lateral = c["lateral_acceleration"]
    ranges, columns = [Range(EVERYWHERE, EVERYWHERE)], [np.ones(len(lateral), bool)]
    for quantity, unit, values, edges in (
            ("speed", "m/s", c["speed"], SPEED_EDGES),
            ("lateral acceleration", "m/s²", np.abs(lateral), LATERAL_ACCELERATION_EDGES),
            ("steering angle", "rad", np.abs(c["steering_angle"]), STEERING_ANGLE),
            ("steering rate", "rad/s", c["steering_rate"], STEERING_RATE_EDGES),
            ("forward acceleration", "m/s²", c["forward_acceleration"], FORWARD_ACCELERATION)):
        for low, high in zip(edges, (*edges[1:], math.inf), strict=True):
            ranges.append(Range(quantity, range_text(quantity, unit, low, high), low, high))
            columns.append((values >= low) & (values < high))
    for label, rows in (("left", lateral >= MIN_TURNING), ("straight", np.abs(lateral) < MIN_TURNING),
                        ("right", lateral <= -MIN_TURNING)):
        ranges.append(Range("direction", label))
        columns.append(rows)
    return tuple(ranges), np.stack(columns, axis=1)


def range_text(quantity: str, unit: str, low: float, high: float) -> str:
    """A range as text: "speed above 12 m/s"."""
    if math.isinf(high):
        return f"{quantity} above {low:g} {unit}"
    if low in (0.0, -math.inf):
        return f"{quantity} below {high:g} {unit}"
    return f"{quantity} {low:g} to {high:g} {unit}"


@dataclass(frozen=True, eq=False)
class _Means:
    """Mean square error by bin. deviation: bootstrap standard deviation of its logarithm. blocks: number of blocks."""

    mean: np.ndarray
    deviation: np.ndarray
    blocks: np.ndarray


def compute_excesses(samples: Samples, members: np.ndarray, ranges: tuple[Range, ...], reference: Samples | None,
                     noise: Mapping[str, float], seed: int, resamples: int) -> tuple[BinExcess, ...]:
    """Excess of every channel in every range with at least MIN_BLOCKS blocks. noise: expected error if no reference."""
    found = []
    expected_members = membership(reference)[1] if reference is not None else None
    for number, (channel, squares) in enumerate(samples.squares.items()):
        means = _bin_means(squares, samples.block, members, np.random.default_rng((seed, number, 0)), resamples)
        if reference is None or expected_members is None:
            expected = np.full(len(ranges), noise[channel] ** 2)
            spread, covered = np.zeros(len(ranges)), np.ones(len(ranges), bool)
        else:
            floor = _bin_means(reference.squares[channel], reference.block, expected_members,
                               np.random.default_rng((seed, number, 1)), resamples)
            covered = floor.blocks >= MIN_BLOCKS
            # A bin with too little reference driving gets the error of the worst bin, to avoid false alarms.
            worst = int(np.nanargmax(np.where(covered, floor.mean, -1.0)))
            expected = np.where(covered, floor.mean, floor.mean[worst])
            spread = np.where(covered, floor.deviation, floor.deviation[worst])
        for k in np.flatnonzero(means.blocks >= MIN_BLOCKS):
            found.append(_excess(channel, ranges[k], float(means.mean[k]), float(expected[k]),
                                 math.hypot(means.deviation[k], spread[k]), int(means.blocks[k]), bool(covered[k])))
    return _with_significance(found)


def _bin_means(squares: np.ndarray, block: np.ndarray, members: np.ndarray, rng: np.random.Generator,
               resamples: int) -> _Means:
    """Means of the squares in each column of `members`; deviations are from resampling whole blocks."""
    known = np.isfinite(squares)
    _, index = np.unique(block[known], return_inverse=True)
    weights = members[known].astype(float)
    count = int(index.max()) + 1 if len(index) else 0
    sums, numbers = np.zeros((count, members.shape[1])), np.zeros((count, members.shape[1]))
    np.add.at(sums, index, weights * squares[known][:, None])
    np.add.at(numbers, index, weights)
    blocks = (numbers > 0).sum(axis=0)
    if not count:
        return _Means(np.full(members.shape[1], np.nan), np.full(members.shape[1], np.nan), blocks)
    draws = rng.multinomial(count, np.full(count, 1.0 / count), size=resamples).astype(float)
    with np.errstate(all="ignore"):
        mean = sums.sum(axis=0) / numbers.sum(axis=0)
        drawn = np.log((draws @ sums) / (draws @ numbers))
        drawn[~np.isfinite(drawn)] = np.nan
        enough = np.isfinite(drawn).sum(axis=0) > 0.5 * resamples
        deviation = np.full(members.shape[1], np.nan)
        if enough.any():
            deviation[enough] = np.nanstd(drawn[:, enough], axis=0)
        # Bessel's correction: a bootstrap over few blocks underestimates the deviation.
        deviation *= np.sqrt(blocks / np.maximum(blocks - 1, 1))
    return _Means(mean, deviation, np.where(np.isfinite(deviation), blocks, 0))


def _excess(channel: str, part: Range, mean: float, expected: float, deviation: float, blocks: int,
            covered: bool) -> BinExcess:
    """The `BinExcess` of a bin; interval and p-value by Student's t for the log ratio, one observation per block."""
    log_ratio = math.log(max(mean, 1e-300) / max(expected, 1e-300))
    deviation = max(deviation, 1e-6)
    reach = float(stats.t.ppf(0.975, blocks - 1)) * deviation
    p = float(stats.t.sf(log_ratio / deviation, blocks - 1))
    return BinExcess(channel, part, math.exp(0.5 * log_ratio),
                     (math.exp(0.5 * (log_ratio - reach)), math.exp(0.5 * min(log_ratio + reach, 60.0))), p, blocks,
                     covered)


def _with_significance(found: list[BinExcess]) -> tuple[BinExcess, ...]:
    """Set `significant` for the bins that pass the test of Benjamini and Hochberg over all bins and exceed the floor by
    a factor of at least MIN_FLOOR_RATIO."""
    adjusted = stats.false_discovery_control([f.p for f in found], method="bh") if found else ()
    return tuple(replace(f, significant=bool(q <= FALSE_DISCOVERY_RATE and f.excess >= MIN_FLOOR_RATIO))
                 for f, q in zip(found, adjusted, strict=True))


def log_residuals(samples: Samples, squares: np.ndarray, noise: float) -> np.ndarray:
    """(n,) residuals of the regression of the log square errors on the conditions; NaN where unknown."""
    c = samples.conditions
    rows = np.stack([np.ones(len(squares)), np.log(np.maximum(c["speed"], 0.5)),
                     np.log(np.abs(c["lateral_acceleration"]) + 0.2), np.log(c["steering_rate"] + 0.005),
                     np.abs(c["forward_acceleration"])], axis=1)
    values = np.log(squares + noise * noise)
    known = np.isfinite(values) & np.isfinite(rows).all(axis=1)
    residual = np.full(len(squares), np.nan)
    if known.sum() > 4 * rows.shape[1]:
        fitted, *_ = np.linalg.lstsq(rows[known], values[known], rcond=None)
        residual[known] = values[known] - rows[known] @ fitted
    return residual


def find_changes(samples: Samples, channel: str, noise: float, block: float, seed: int, resamples: int) -> list[Part]:
    """Find the stretches with larger errors than the other parts of the run, by binary segmentation.

    A change point is significant if the cumulative sum of `log_residuals` is larger than with shuffled blocks.
    """
    residual = log_residuals(samples, samples.squares[channel], noise)
    rng = np.random.default_rng((seed, 17))
    parts = []
    for run in np.unique(samples.run):
        rows = np.flatnonzero((samples.run == run) & np.isfinite(residual))
        if not len(rows):
            continue
        time, values = _average_by_second(samples.time[rows], residual[rows])
        size = max(1, round(block))
        edges = sorted(_find_change_points(values, 0, len(values), size, rng, resamples, MAX_CHANGES))
        cuts = [0, *(k for k, _ in edges), len(values)]
        if len(cuts) == 2:
            continue
        p = max(q for _, q in edges)
        for a, b in itertools.pairwise(cuts):
            outside = np.concatenate((values[:a], values[b:]))
            ratio = math.exp(0.5 * float(values[a:b].mean() - outside.mean()))
            if ratio >= MIN_ERROR_RATIO:
                parts.append(Part(channel, int(run), float(time[a]), float(time[b - 1] + 1.0), ratio, p))
    return parts


def _average_by_second(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(whole seconds, mean of the values in each)."""
    second = np.floor(time).astype(int)
    unique, index = np.unique(second, return_inverse=True)
    return unique.astype(float), np.bincount(index, values) / np.bincount(index)


def _find_change_points(values: np.ndarray, first: int, last: int, block: int, rng: np.random.Generator, resamples: int,
                        max_changes: int) -> list[tuple[int, float]]:
    """(index, p-value) of at most `max_changes` significant change points in values[first:last]."""
    part = values[first:last]
    shortest = round(MIN_PART_DURATION)
    if max_changes < 1 or len(part) < 2 * shortest:
        return []
    cusum = _cusum(part[None])[0]
    at = int(np.argmax(cusum[shortest:-shortest])) + shortest if len(part) > 2 * shortest else shortest
    length = len(part) // block * block
    if length < 4 * block:
        return []
    pieces = part[:length].reshape(-1, block)
    shuffled = np.stack([pieces[rng.permutation(len(pieces))].ravel() for _ in range(resamples)])
    largest = _cusum(shuffled).max(axis=1)
    p = (1 + int((largest >= cusum[at]).sum())) / (1 + resamples)
    if p > MAX_P_VALUE:
        return []
    middle = first + at
    return [(middle, p), *_find_change_points(values, first, middle, block, rng, resamples, max_changes - 1),
            *_find_change_points(values, middle, last, block, rng, resamples, max_changes - 1)][:max_changes]


def _cusum(rows: np.ndarray) -> np.ndarray:
    """|cumulative sum| of deviations from the mean before each element, over standard deviation times sqrt(length)."""
    centred = rows - rows.mean(axis=1, keepdims=True)
    sums = np.cumsum(centred, axis=1) - centred
    return np.abs(sums) / (rows.std(axis=1, keepdims=True) * math.sqrt(rows.shape[1]) + 1e-12)


def find_cells(samples: Samples, channel: str, noise: float) -> list[Cell]:
    """Cells driven in at least MIN_BLOCKS blocks; p tests whether the conditions alone explain the errors there."""
    residual = log_residuals(samples, samples.squares[channel], noise)
    known = np.isfinite(residual) & np.isfinite(samples.x) & np.isfinite(samples.y)
    key = np.stack([np.floor(samples.x[known] / CELL_SIZE), np.floor(samples.y[known] / CELL_SIZE)], axis=1)
    unique, index = np.unique(key, axis=0, return_inverse=True)
    index = np.ravel(index)
    found = []
    for k, (column, row) in enumerate(unique):
        rows = np.flatnonzero(known)[index == k]
        means = np.array([residual[rows[samples.block[rows] == b]].mean() for b in np.unique(samples.block[rows])])
        if len(means) < MIN_BLOCKS:
            continue
        deviation = max(float(means.std(ddof=1)) / math.sqrt(len(means)), 1e-6)
        mean, reach = float(means.mean()), float(stats.t.ppf(0.975, len(means) - 1)) * deviation
        found.append(Cell(channel, float(CELL_SIZE * (column + 0.5)), float(CELL_SIZE * (row + 0.5)),
                          math.exp(0.5 * mean), (math.exp(0.5 * (mean - reach)), math.exp(0.5 * (mean + reach))),
                          float(stats.t.sf(mean / deviation, len(means) - 1))))
    return found
