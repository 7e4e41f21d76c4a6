"""Statements on conditions, times and places with larger prediction errors than expected.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..binning import LATERAL_ACCELERATION_EDGES, SPEED_EDGES, STEERING_RATE_EDGES
from ..channels import CHANNEL_OF_COLUMN
from ..log import DriveLog
from ..log_signals import LogSignals
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .result import LargeErrorRegion
from .settings import DiscoverySettings
from .windows import STEP, Windows

ROAD_WHEEL_ANGLE_EDGES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)  # rad at the road wheels, magnitude
FORWARD_ACCELERATION_EDGES = (-math.inf, -2.0, -0.7, 0.7, 2.0)  # m/s^2
MIN_TURNING = 0.5  # m/s^2 of lateral acceleration; driving with less counts as straight
MIN_BLOCKS = 4  # minimum number of blocks in a bin for an interval
FALSE_DISCOVERY_RATE = 0.05  # among the significant bins or cells
MIN_FLOOR_RATIO = 1.25  # minimum ratio of the error in a relevant bin to the floor
SHORT_HORIZON = 1.0  # s, for errors of velocity, yaw rate and acceleration, to locate where they arise
RESAMPLES = 1000  # bootstrap samples
MAX_RANGES = 3  # maximum number of statements about conditions per channel
SIGNED = ("lateral acceleration", "steering angle", "steering rate")  # signed quantities that are binned by magnitude
MIN_CONTRAST = 1.15  # minimum ratio of the error in a reported range to the error in all driving
CELL_SIZE = 20.0  # m, side of a cell of the map
MIN_STRETCH_DURATION = 8.0  # s between change points
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
class Stretch:
    """A stretch of a run with larger errors. start, end [s]: since the first measurement of the run. ratio [1]: RMS
    error divided by the RMS error in the rest of the run under similar conditions."""

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
            ("steering angle", "rad", np.abs(c["steering_angle"]), ROAD_WHEEL_ANGLE_EDGES),
            ("steering rate", "rad/s", c["steering_rate"], STEERING_RATE_EDGES),
            ("forward acceleration", "m/s²", c["forward_acceleration"], FORWARD_ACCELERATION_EDGES)):
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


def find_error_regions(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                       settings: DiscoverySettings, reference: Sequence[DriveLog] = (),
                       noise: Mapping[str, float] | None = None,
                       acceleration_gain: float = 0.0) -> tuple[LargeErrorRegion, ...]:
    """Conditions, times and places in which the errors of a model exceed those in the reference drives or, without a
    reference, the sensor noise. noise: standard deviation by channel [unit], required without a reference.
    acceleration_gain: see `Discovery`. Channels that the runs or the reference do not measure are left out."""
    samples = window_errors(runs, model, vehicle, settings, acceleration_gain)
    expected = window_errors(reference, model, vehicle, settings, acceleration_gain) if reference else None
    if expected is not None:
        common = [c for c in samples.squares if c in expected.squares and np.isfinite(expected.squares[c]).any()]
        samples = replace(samples, squares={c: samples.squares[c] for c in common})
    sigma = {channel: (noise or {}).get(channel, 0.0) for channel in samples.squares}
    ranges, members = membership(samples)
    bins = compute_excesses(samples, members, ranges, expected, sigma, settings.seed, RESAMPLES)
    parts = [part for channel, noise_level in sigma.items()
             for part in find_changes(samples, channel, noise_level, settings.block, settings.seed, PERMUTATIONS)]
    cells = [cell for channel, noise_level in sigma.items() for cell in find_cells(samples, channel, noise_level)]
    adjusted = stats.false_discovery_control([c.p for c in cells], method="bh") if cells else ()
    places = [c for c, q in zip(cells, adjusted, strict=True)
              if q <= FALSE_DISCOVERY_RATE and c.ratio >= MIN_ERROR_RATIO]
    return tuple(statement for channel in samples.squares
                 for statement in _statements(channel, bins, parts, places, samples, expected is not None))


def window_errors(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                  settings: DiscoverySettings, acceleration_gain: float = 0.0) -> Samples:
    """Errors and conditions of all windows of the runs: mean square errors over the first SHORT_HORIZON; for channels
    with accumulating errors, square errors at the end of the horizon."""
    windows = Windows(runs, vehicle, settings)
    short = windows.time <= max(SHORT_HORIZON, float(windows.time[0]))
    errors = windows.errors(model, acceleration_gain)
    squares: dict[str, np.ndarray] = {}
    for k, column in enumerate(windows.columns):
        channel, square = CHANNEL_OF_COLUMN[column], np.square(errors[:, :, k])
        value = square[:, -1] if channel.accumulates else square[:, short].mean(axis=1)
        squares[channel.name] = squares.get(channel.name, 0.0) + value
    rows = [_places_of_run(log, windows.seconds[windows.run == number], float(windows.time[-1]))
            for number, log in enumerate(runs)]
    place = {name: np.concatenate([r[name] for r in rows]) for name in rows[0]}
    known = np.isfinite(np.stack([*squares.values(), *place.values()])).all(axis=0)
    x, y, time = (place.pop(name)[known] for name in ("x", "y", "time"))
    return Samples(windows.names, windows.run[known], time, x, y, windows.block[known],
                   {name: values[known] for name, values in place.items()},
                   {channel: values[known] for channel, values in squares.items()})


def _places_of_run(log: DriveLog, seconds: np.ndarray, horizon: float) -> dict[str, np.ndarray]:
    """Position and conditions of the windows of one run. seconds: their starts, after both INS and steering began."""
    signals = LogSignals(log, 0.1, 5.0, "zero_phase")
    begin = max((int(t[0]) for t in (log.ins_time_ns, log.steering_time_ns) if len(t)), default=0)
    starts = begin + np.round(seconds / NANOSECOND).astype(np.int64)
    after = np.round(np.arange(0.0, min(SHORT_HORIZON, horizon) + STEP / 2, STEP) / NANOSECOND).astype(np.int64)
    times = starts[:, None] + after
    x, y = signals.ins_at(starts, "x", "y")
    speed, yaw_rate, acceleration = signals.ins_at(times, "velocity_x", "yaw_rate", "velocity_x_dot")
    angle = signals.road_wheel_angle_at(times)
    first = int(log.ins_time_ns[0]) if len(log.ins_time_ns) else begin
    return {
        "x": x, "y": y, "time": (starts - first) * NANOSECOND, "speed": speed.mean(axis=1),
        "lateral_acceleration": (speed * yaw_rate).mean(axis=1), "steering_angle": angle.mean(axis=1),
        "steering_rate": np.sqrt(np.square(np.diff(angle, axis=1) / STEP).mean(axis=1)),
        "forward_acceleration": acceleration.mean(axis=1),
    }


def _statements(channel: str, bins: Sequence[BinExcess], parts: Sequence[Stretch], places: Sequence[Cell],
                samples: Samples, with_reference: bool) -> list[LargeErrorRegion]:
    """Statements on one channel; empty without a significant bin."""
    of_channel = [b for b in bins if b.channel == channel]
    if not any(b.significant for b in of_channel):
        return []
    overall = next(b for b in of_channel if b.range.quantity == EVERYWHERE)
    found = [_range_statement(group, of_channel, overall, with_reference) for group in _group_neighbours(of_channel)]
    # Ranked by the lower bound, because a range with few observations can have a large error by chance.
    clear = sorted((s for s in found if s.interval[0] > 1.0 and s.excess >= MIN_CONTRAST * overall.excess),
                   key=lambda s: -s.interval[0])
    statements = [*clear[:MAX_RANGES]]
    if overall.significant:
        statements.append(LargeErrorRegion(channel, EVERYWHERE, overall.excess, overall.interval))
    statements += [_stretch_statement(part, overall, samples) for part in parts if part.channel == channel]
    statements += _place_statements([c for c in places if c.channel == channel], overall)
    return statements


def _group_neighbours(bins: Sequence[BinExcess]) -> list[list[BinExcess]]:
    """Group significant neighbouring ranges of the same quantity with similar excess."""
    groups: list[list[BinExcess]] = []
    for _, of_quantity in itertools.groupby((b for b in bins if b.range.quantity != EVERYWHERE),
                                            key=lambda b: b.range.quantity):
        current: list[BinExcess] = []
        for bin_excess in of_quantity:
            low, excess = bin_excess.range.low, bin_excess.excess
            similar = current and low == current[-1].range.high and low is not None and (
                max(excess, current[-1].excess) <= 1.5 * min(excess, current[-1].excess))
            if bin_excess.significant and similar:
                current.append(bin_excess)
            else:
                groups.append(current)
                current = [bin_excess] if bin_excess.significant else []
        groups.append(current)
    return [g for g in groups if g]


def _range_statement(group: Sequence[BinExcess], bins: Sequence[BinExcess], overall: BinExcess,
                     with_reference: bool) -> LargeErrorRegion:
    """Statement on a group of ranges. bins: all bins of the channel. overall: the bin of all driving."""
    quantity = group[0].range.quantity
    if quantity == "direction":
        return LargeErrorRegion(overall.channel, f"{group[0].range.label} turns" if group[0].range.label != "straight"
                              else "straight driving", group[0].excess, group[0].interval)
    unit = group[0].range.label.rsplit(" ", 1)[1]
    low, high = group[0].range.low, group[-1].range.high
    assert low is not None and high is not None  # None only for directions
    condition = range_text(quantity, unit, low, high)
    sides = {b.range.label: b for b in bins if b.range.quantity == "direction" and b.range.label != "straight"}
    if quantity in SIGNED and group[0].range.low and len(sides) == 2 and all(b.significant for b in sides.values()):
        condition += ", both directions"
    if with_reference and not all(b.covered for b in group):
        condition += " (poorly covered by the reference drives)"
    weights = np.array([b.blocks for b in group], float)
    excess = math.sqrt(float((weights * [b.excess ** 2 for b in group]).sum() / weights.sum()))
    low, high = (math.sqrt(float((weights * [b.interval[k] ** 2 for b in group]).sum() / weights.sum()))
                 for k in (0, 1))
    return LargeErrorRegion(overall.channel, condition, excess, (low, high))


def _stretch_statement(part: Stretch, overall: BinExcess, samples: Samples) -> LargeErrorRegion:
    """Statement on a stretch of a run; its excess is the overall excess times the ratio of the stretch."""
    last = float(samples.time[samples.run == part.run].max())
    name = samples.names[part.run]
    when = (f"from {part.start:.0f} s on" if part.end >= last - 1.0 else f"until {part.end:.0f} s" if part.start < 2.0
            else f"from {part.start:.0f} to {part.end:.0f} s")
    text = f"run {name}, {when}: {part.ratio:.1f} times the error of the rest of the run under similar conditions"
    return LargeErrorRegion(part.channel, text, overall.excess * part.ratio,
                          (overall.interval[0] * part.ratio, overall.interval[1] * part.ratio))


def _place_statements(places: Sequence[Cell], overall: BinExcess) -> list[LargeErrorRegion]:
    """Statements on the two places with the largest excess; neighbouring cells form one place."""
    remaining, statements = list(places), []
    while remaining:
        cluster = [remaining.pop(0)]
        grown = True
        while grown:
            near = [c for c in remaining if any(max(abs(c.x - o.x), abs(c.y - o.y)) < 1.6 * CELL_SIZE for o in cluster)]
            grown = bool(near)
            cluster += near
            remaining = [c for c in remaining if c not in near]
        x, y = (float(np.mean([getattr(c, axis) for c in cluster])) for axis in ("x", "y"))
        reach = max(math.hypot(c.x - x, c.y - y) for c in cluster) + 0.5 * CELL_SIZE
        ratio = float(np.mean([c.ratio for c in cluster]))
        low, high = (float(np.mean([c.interval[k] for c in cluster])) for k in (0, 1))
        text = f"within {reach:.0f} m of (E {x:.0f} m, N {y:.0f} m), on average over the passes"
        statements.append(LargeErrorRegion(overall.channel, text, overall.excess * ratio,
                                         (overall.excess * low, overall.excess * high)))
    return sorted(statements, key=lambda s: -s.excess)[:2]


def compute_excesses(samples: Samples, members: np.ndarray, ranges: tuple[Range, ...], reference: Samples | None,
                     noise: Mapping[str, float], seed: int, resamples: int) -> tuple[BinExcess, ...]:
    """Excess of every channel in every range with at least MIN_BLOCKS blocks, with intervals and p-values by Student's
    t for the log ratio, one observation per block. noise: expected error if no reference."""
    found = []
    for number, (channel, squares) in enumerate(samples.squares.items()):
        means, spreads, blocks = _bin_means(squares, samples.block, members, np.random.default_rng((seed, number, 0)),
                                            resamples)
        if reference is None:
            expected = np.full(len(ranges), noise[channel] ** 2)
            spread, covered = np.zeros(len(ranges)), np.ones(len(ranges), bool)
        else:
            floor, deviation, floor_blocks = _bin_means(
                reference.squares[channel], reference.block, membership(reference)[1],
                np.random.default_rng((seed, number, 1)), resamples)
            covered = floor_blocks >= MIN_BLOCKS
            # A bin with too little reference driving gets the error of the worst bin, to avoid false alarms.
            worst = int(np.nanargmax(np.where(covered, floor, -1.0)))
            expected = np.where(covered, floor, floor[worst])
            spread = np.where(covered, deviation, deviation[worst])
        for k in np.flatnonzero(blocks >= MIN_BLOCKS):
            log_ratio = math.log(max(means[k], 1e-300) / max(expected[k], 1e-300))
            width, count = max(math.hypot(spreads[k], spread[k]), 1e-6), int(blocks[k])
            reach = float(stats.t.ppf(0.975, count - 1)) * width
            interval = math.exp(0.5 * (log_ratio - reach)), math.exp(0.5 * min(log_ratio + reach, 60.0))
            found.append(BinExcess(channel, ranges[k], math.exp(0.5 * log_ratio), interval,
                                   float(stats.t.sf(log_ratio / width, count - 1)), count, bool(covered[k])))
    adjusted = stats.false_discovery_control([f.p for f in found], method="bh") if found else ()
    return tuple(replace(f, significant=bool(q <= FALSE_DISCOVERY_RATE and f.excess >= MIN_FLOOR_RATIO))
                 for f, q in zip(found, adjusted, strict=True))


def _bin_means(squares: np.ndarray, block: np.ndarray, members: np.ndarray, rng: np.random.Generator,
               resamples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean of the squares, bootstrap standard deviation of its logarithm, number of blocks) for each column of
    `members`, by resampling whole blocks."""
    known = np.isfinite(squares)
    _, index = np.unique(block[known], return_inverse=True)
    weights = members[known].astype(float)
    count = int(index.max()) + 1 if len(index) else 0
    sums, numbers = np.zeros((count, members.shape[1])), np.zeros((count, members.shape[1]))
    np.add.at(sums, index, weights * squares[known][:, None])
    np.add.at(numbers, index, weights)
    blocks, deviation = (numbers > 0).sum(axis=0), np.full(members.shape[1], np.nan)
    if not count:
        return deviation, deviation, blocks
    draws = rng.multinomial(count, np.full(count, 1.0 / count), size=resamples).astype(float)
    with np.errstate(all="ignore"):
        mean = sums.sum(axis=0) / numbers.sum(axis=0)
        drawn = np.log((draws @ sums) / (draws @ numbers))
        drawn[~np.isfinite(drawn)] = np.nan
        enough = np.isfinite(drawn).sum(axis=0) > 0.5 * resamples
        if enough.any():
            deviation[enough] = np.nanstd(drawn[:, enough], axis=0)
        # Bessel's correction: a bootstrap over few blocks underestimates the deviation.
        deviation *= np.sqrt(blocks / np.maximum(blocks - 1, 1))
    return mean, deviation, np.where(np.isfinite(deviation), blocks, 0)


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


def find_changes(samples: Samples, channel: str, noise: float, block: float, seed: int,
                 resamples: int) -> list[Stretch]:
    """Find the stretches with larger errors than the other parts of the run, by binary segmentation. A change point is
    significant if the cumulative sum of `log_residuals` is larger than with shuffled blocks."""
    residual = log_residuals(samples, samples.squares[channel], noise)
    rng = np.random.default_rng((seed, 17))
    parts = []
    for run in np.unique(samples.run):
        rows = np.flatnonzero((samples.run == run) & np.isfinite(residual))
        if not len(rows):
            continue
        time, index = np.unique(np.floor(samples.time[rows]), return_inverse=True)  # means over whole seconds
        values = np.bincount(index, residual[rows]) / np.bincount(index)
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
                parts.append(Stretch(channel, int(run), float(time[a]), float(time[b - 1] + 1.0), ratio, p))
    return parts


def _find_change_points(values: np.ndarray, first: int, last: int, block: int, rng: np.random.Generator, resamples: int,
                        max_changes: int) -> list[tuple[int, float]]:
    """(index, p-value) of at most `max_changes` significant change points in values[first:last]."""
    part = values[first:last]
    shortest = round(MIN_STRETCH_DURATION)
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
    """Cells visited in at least MIN_BLOCKS blocks; p tests whether the conditions alone explain the errors there."""
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
