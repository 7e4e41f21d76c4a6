"""Conditions, times and places with larger prediction errors than expected.

For each range (bin) of a condition:

    excess = sqrt(mean squared error in the bin / expected mean squared error)

The expected error is that of the reference drives in the same bin, or in their worst bin if this bin has too few
blocks; without reference drives it is the sensor noise. Standard deviations are from a bootstrap of whole blocks of
time, since errors of neighbouring predictions are correlated; intervals and p-values are from Student's t distribution.
Significance is corrected for the number of bins (Benjamini and Hochberg, 1995).

Errors are larger in corners than on straights. Times and places are therefore compared by the residuals of a
regression of the errors on the conditions; ice, a gust or a defect changes these residuals. The regression is

    log(mean square + noise^2) = a + b . (log v_x, log |lateral acceleration|, log steering rate, |v_x_dot|)
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.sparse.csgraph import connected_components

from ..augmented import AugmentedModel
from ..channels import CHANNEL_OF_COLUMN
from ..log import DriveLog, LogSignals
from ..log_evaluation import LATERAL_ACCELERATION_EDGES, SPEED_EDGES, STEERING_RATE_EDGES, Bin, bin_by_edges
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .result import LargeErrorRegion
from .settings import DiscoverySettings
from .windows import MAX_GAP, STEP, Windows

CONDITIONS = {"speed": ("m/s", SPEED_EDGES), "lateral acceleration": ("m/s²", LATERAL_ACCELERATION_EDGES),
              "road-wheel angle": ("rad", (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)),
              "steering rate": ("rad/s", STEERING_RATE_EDGES),
              "forward acceleration": ("m/s²", (-math.inf, -2.0, -0.7, 0.7, 2.0))}
"""Unit, and edges of the ranges, by quantity."""
MIN_TURNING_ACCELERATION = 0.5  # m/s^2, lateral; driving with less counts as straight
MIN_BLOCKS = 4  # minimum number of blocks in a bin for an interval
FALSE_DISCOVERY_RATE = 0.05  # expected fraction of false positives among the significant bins or cells
MIN_EXCESS = 1.25  # minimum ratio of the error in a significant bin to the expected error
SHORT_HORIZON = 1.0  # s, horizon for errors of velocity, yaw rate and acceleration, to locate where they arise
RESAMPLES = 1000  # number of bootstrap samples
MAX_RANGES, MAX_PLACES = 3, 2  # maximum numbers of reported ranges and places per channel
MAX_EXCESS_RATIO = 1.5  # largest ratio between the excesses of neighbouring ranges that are reported as one
BINNED_BY_MAGNITUDE = ("lateral acceleration", "road-wheel angle", "steering rate")
MIN_CONTRAST = 1.15  # minimum ratio of the excess in a reported range to the excess in all driving
CELL_SIZE = 20.0  # m, side of a cell of the map
MAX_CELL_DISTANCE = 1.6 * CELL_SIZE  # m, largest distance along each axis between neighbouring cells of one place
MIN_SEGMENT_DURATION = 8.0  # s, minimum time between change points
MAX_P_VALUE = 0.01  # largest p-value of a reported change point
MIN_ERROR_RATIO = 1.5  # minimum `ratio` of a reported `Segment` or `Cell`
MAX_CHANGE_POINTS = 3  # maximum number of change points per run and channel
PERMUTATIONS = 299  # number of permutations, enough to resolve a p-value of 0.01
EVERYWHERE = "everywhere"


@dataclass(frozen=True, eq=False)
class Samples:
    """Errors and conditions of n predictions, all finite."""

    names: tuple[str, ...]
    run: np.ndarray  # index into names
    time: np.ndarray  # since the first INS sample of the run [s]
    x: np.ndarray  # position at the start [m]
    y: np.ndarray  # position at the start [m]
    block: np.ndarray  # number of the block of time; a block counts as one observation
    conditions: Mapping[str, np.ndarray]  # (n,) by name [SI]
    squares: Mapping[str, np.ndarray]  # (n,) squared error by channel [SI]


@dataclass(frozen=True)
class BinExcess:
    """Error of one channel in one range."""

    channel: str
    range: Bin
    excess: float  # ratio of the RMS error to the expected one [1]
    interval: tuple[float, float]  # 95 %, of `excess`
    p_value: float  # of the hypothesis that the error is not larger than expected
    blocks: int  # number of blocks
    is_covered: bool = True  # whether the reference has enough driving in the range; True without reference drives
    is_significant: bool = False


@dataclass(frozen=True)
class Segment:
    """A segment of a run with larger errors."""

    channel: str
    run: int
    start: float  # since the first INS sample of the run [s]
    end: float  # since the first INS sample of the run [s]
    ratio: float  # ratio of the errors to those in the rest of the run under similar conditions (geometric mean) [1]


@dataclass(frozen=True)
class Cell:
    """A square of the map with side CELL_SIZE."""

    channel: str
    x: float  # its centre in the map frame [m]
    y: float  # its centre in the map frame [m]
    ratio: float  # ratio of the errors to those expected under the same conditions (geometric mean) [1]
    interval: tuple[float, float]  # 95 %, of `ratio`
    p_value: float  # of the hypothesis that the errors are not larger than expected


def assign_ranges(samples: Samples) -> list[Bin]:
    """Bins of the predictions by range of each condition, and by direction; the first bin contains all."""
    lateral, limit = samples.conditions["lateral_acceleration"], MIN_TURNING_ACCELERATION
    bins = [Bin(EVERYWHERE, EVERYWHERE, None, None, np.ones(len(lateral), bool))]
    for quantity, (unit, edges) in CONDITIONS.items():
        values = samples.conditions[quantity.replace(" ", "_").replace("-", "_")]
        bins += bin_by_edges(quantity, unit, np.abs(values) if quantity in BINNED_BY_MAGNITUDE else values, edges)
    directions = {"left": lateral >= limit, "straight": np.abs(lateral) < limit, "right": lateral <= -limit}
    return bins + [Bin("direction", label, None, None, mask) for label, mask in directions.items()]


def describe_range(quantity: str, low: float, high: float | None) -> str:
    """Description of a range, such as "speed above 12 m/s"."""
    limits = (f"above {low:g}" if high is None else
              f"below {high:g}" if low in (0.0, -math.inf) else f"{low:g} to {high:g}")
    return f"{quantity} {limits} {CONDITIONS[quantity][0]}"


def find_error_regions(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                       settings: DiscoverySettings, reference: Sequence[DriveLog] = (),
                       noise: Mapping[str, float] | None = None,
                       acceleration_gain: float = 0.0) -> tuple[LargeErrorRegion, ...]:
    """Conditions in which the errors of a model are larger than in the reference drives or, without these, than the
    sensor noise; times and places where they are larger than elsewhere under similar conditions. noise: standard
    deviation by channel [SI]. acceleration_gain: see `Discovery`. Channels that are not measured in both the runs and
    the reference, and channels without a significant range, are left out."""
    samples = compute_window_errors(runs, model, vehicle, settings, acceleration_gain)
    expected = compute_window_errors(reference, model, vehicle, settings, acceleration_gain) if reference else None
    if expected is not None:
        common = [c for c in samples.squares if c in expected.squares and np.isfinite(expected.squares[c]).any()]
        samples = replace(samples, squares={c: samples.squares[c] for c in common})
    sigma = {channel: (noise or {}).get(channel, 0.0) for channel in samples.squares}
    bins = compute_excesses(samples, expected, sigma, settings.seed, RESAMPLES)
    residuals = {channel: compute_log_residuals(samples, channel, deviation) for channel, deviation in sigma.items()}
    segments = [segment for channel, residual in residuals.items() for segment in
                find_segments(samples, channel, residual, settings.block, settings.seed)]
    cells = [cell for channel, residual in residuals.items() for cell in find_cells(samples, channel, residual)]
    adjusted_p = stats.false_discovery_control([c.p_value for c in cells], method="bh") if cells else ()
    cells = [c for c, q in zip(cells, adjusted_p, strict=True)
             if q <= FALSE_DISCOVERY_RATE and c.ratio >= MIN_ERROR_RATIO]
    regions: list[LargeErrorRegion] = []
    for channel in samples.squares:
        channel_bins = [b for b in bins if b.channel == channel]
        if not any(b.is_significant for b in channel_bins):
            continue
        overall = next(b for b in channel_bins if b.range.quantity == EVERYWHERE)
        ranges = [_make_range_region(group, channel_bins, overall, expected is not None)
                  for group in _group_neighbours(channel_bins)]
        # Ranked by the lower bound, because a range with few observations can have a large error by chance.
        regions += sorted((r for r in ranges if r.interval[0] > 1.0 and r.excess >= MIN_CONTRAST * overall.excess),
                          key=lambda r: -r.interval[0])[:MAX_RANGES]
        if overall.is_significant:
            regions.append(LargeErrorRegion(channel, EVERYWHERE, overall.excess, overall.interval))
        regions += [_make_segment_region(s, overall, samples) for s in segments if s.channel == channel]
        regions += _list_place_regions([c for c in cells if c.channel == channel], overall)
    return tuple(regions)


def compute_window_errors(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                          settings: DiscoverySettings, acceleration_gain: float = 0.0) -> Samples:
    """Errors and conditions of windows with known values: squared errors at the end of the horizon for channels with
    accumulating errors, mean squared errors over the first SHORT_HORIZON for the others."""
    windows = Windows(runs, vehicle, settings)
    short = windows.time <= max(SHORT_HORIZON, float(windows.time[0]))
    errors = windows.errors(model, acceleration_gain)
    squares: dict[str, np.ndarray] = {}
    for k, column in enumerate(windows.columns):
        channel, square = CHANNEL_OF_COLUMN[column], np.square(errors[:, :, k])
        value = square[:, -1] if channel.accumulates else square[:, short].mean(axis=1)
        squares[channel.name] = squares.get(channel.name, 0.0) + value
    # Positions at the starts of the windows, and means over the first SHORT_HORIZON (steering rate: RMS).
    signals = LogSignals(windows.joined_log, MAX_GAP, 5.0, "zero_phase")
    offsets = np.arange(0.0, min(SHORT_HORIZON, float(windows.time[-1])) + STEP / 2, STEP)
    times = windows.starts_ns[:, None] + np.round(offsets / NANOSECOND).astype(np.int64)
    x, y = signals.ins_at(windows.starts_ns, "x", "y")
    speed, yaw_rate, acceleration = signals.ins_at(times, "velocity_x", "yaw_rate", "velocity_x_dot")
    angle = signals.road_wheel_angle_at(times)
    conditions = {"speed": speed.mean(axis=1), "lateral_acceleration": (speed * yaw_rate).mean(axis=1),
                  "road_wheel_angle": angle.mean(axis=1),
                  "steering_rate": np.sqrt(np.square(np.diff(angle, axis=1) / STEP).mean(axis=1)),
                  "forward_acceleration": acceleration.mean(axis=1)}
    finite = np.isfinite(np.stack([x, y, *squares.values(), *conditions.values()])).all(axis=0)
    # `Windows.seconds` counts from the first instant with both INS and steering.
    lead = np.array([max(float(log.steering_time_ns[0] - log.ins_time_ns[0]) * NANOSECOND, 0.0) if log.overlap else 0.0
                     for log in runs])
    time = windows.seconds + lead[windows.run]
    return Samples(windows.names, windows.run[finite], time[finite], x[finite], y[finite], windows.block[finite],
                   {name: values[finite] for name, values in conditions.items()},
                   {channel: values[finite] for channel, values in squares.items()})


def _group_neighbours(bins: Sequence[BinExcess]) -> list[list[BinExcess]]:
    """Group significant neighbouring ranges of the same quantity with similar excess."""
    groups: list[list[BinExcess]] = []
    for current in (b for b in bins if b.is_significant and b.range.quantity != EVERYWHERE):
        last = groups[-1][-1] if groups else None
        if (last is not None and last.range.quantity == current.range.quantity
                and last.range.high is not None and last.range.high == current.range.low
                and max(last.excess, current.excess) <= MAX_EXCESS_RATIO * min(last.excess, current.excess)):
            groups[-1].append(current)
        else:
            groups.append([current])
    return groups


def _make_range_region(group: Sequence[BinExcess], bins: Sequence[BinExcess], overall: BinExcess,
                       has_reference: bool) -> LargeErrorRegion:
    """Region of a group of ranges. bins: all bins of the channel. overall: the bin of all driving."""
    quantity, label = group[0].range.quantity, group[0].range.label
    low, high = group[0].range.low, group[-1].range.high
    if low is None:  # a direction
        condition = "straight driving" if label == "straight" else f"{label} turns"
        return LargeErrorRegion(overall.channel, condition, group[0].excess, group[0].interval)
    condition = describe_range(quantity, low, high)
    sides = [b for b in bins if b.range.quantity == "direction" and b.range.label != "straight"]
    if quantity in BINNED_BY_MAGNITUDE and low and len(sides) == 2 and all(b.is_significant for b in sides):
        condition += ", both directions"
    if has_reference and not all(b.is_covered for b in group):
        condition += " (poorly covered by the reference drives)"
    weights = np.array([b.blocks for b in group], float)
    rows = np.array([(b.excess, *b.interval) for b in group])
    excess, lowest, highest = np.sqrt((weights @ np.square(rows)) / weights.sum()).tolist()
    return LargeErrorRegion(overall.channel, condition, excess, (lowest, highest))


def _make_segment_region(segment: Segment, overall: BinExcess, samples: Samples) -> LargeErrorRegion:
    """Region of a segment of a run; its excess is the overall excess times the ratio of the segment."""
    last = float(samples.time[samples.run == segment.run].max())
    period = (f"from {segment.start:.0f} s on" if segment.end >= last - 1.0 else
              f"until {segment.end:.0f} s" if segment.start < 2.0 else
              f"from {segment.start:.0f} to {segment.end:.0f} s")
    text = (f"run {samples.names[segment.run]}, {period}: {segment.ratio:.1f} times the error of the rest of the run "
            "under similar conditions")
    low, high = overall.interval
    return LargeErrorRegion(segment.channel, text, overall.excess * segment.ratio,
                            (low * segment.ratio, high * segment.ratio))


def _list_place_regions(cells: Sequence[Cell], overall: BinExcess) -> list[LargeErrorRegion]:
    """Regions of the MAX_PLACES places with the largest excess; neighbouring cells form one place."""
    adjacency = [[max(abs(a.x - b.x), abs(a.y - b.y)) < MAX_CELL_DISTANCE for b in cells] for a in cells]
    number = connected_components(np.array(adjacency))[1] if cells else np.zeros(0, int)
    regions = []
    for k in np.unique(number):
        place = [cell for cell, n in zip(cells, number, strict=True) if n == k]
        x, y, ratio, low, high = np.mean([(c.x, c.y, c.ratio, *c.interval) for c in place], axis=0).tolist()
        radius = max(math.hypot(c.x - x, c.y - y) for c in place) + 0.5 * CELL_SIZE
        text = f"within {radius:.0f} m of (E {x:.0f} m, N {y:.0f} m), averaged over the passes"
        regions.append(LargeErrorRegion(overall.channel, text, overall.excess * ratio,
                                        (overall.excess * low, overall.excess * high)))
    return sorted(regions, key=lambda r: -r.excess)[:MAX_PLACES]


def compute_excesses(samples: Samples, reference: Samples | None, noise: Mapping[str, float], seed: int,
                     resamples: int) -> tuple[BinExcess, ...]:
    """Excess of every channel in every range with at least MIN_BLOCKS blocks, with intervals and p-values by Student's
    t for the log ratio, one observation per block. noise: expected error without reference drives."""
    excesses, ranges = [], assign_ranges(samples)
    for number, (channel, squares) in enumerate(samples.squares.items()):
        means, deviations, blocks = _compute_bin_means(squares, samples.block, ranges,
                                                       np.random.default_rng((seed, number, 0)), resamples)
        if reference is None:
            expected = np.full(len(ranges), noise[channel] ** 2)
            expected_deviations, is_covered = np.zeros(len(ranges)), np.ones(len(ranges), bool)
        else:
            expected, expected_deviations, expected_blocks = _compute_bin_means(
                reference.squares[channel], reference.block, assign_ranges(reference),
                np.random.default_rng((seed, number, 1)), resamples)
            is_covered = expected_blocks >= MIN_BLOCKS
            # A bin with too little reference driving gets the error of the worst bin, to avoid false alarms.
            worst = int(np.nanargmax(np.where(is_covered, expected, -1.0)))
            expected = np.where(is_covered, expected, expected[worst])
            expected_deviations = np.where(is_covered, expected_deviations, expected_deviations[worst])
        for k in np.flatnonzero(blocks >= MIN_BLOCKS):
            log_ratio = math.log(max(means[k], 1e-300) / max(expected[k], 1e-300))
            deviation, count = math.hypot(deviations[k], expected_deviations[k]), int(blocks[k])
            excesses.append(BinExcess(channel, ranges[k], *_test_ratio(log_ratio, deviation, count), count,
                                      bool(is_covered[k])))
    adjusted_p = stats.false_discovery_control([e.p_value for e in excesses], method="bh") if excesses else ()
    return tuple(replace(e, is_significant=bool(q <= FALSE_DISCOVERY_RATE and e.excess >= MIN_EXCESS))
                 for e, q in zip(excesses, adjusted_p, strict=True))


def _test_ratio(log_ratio: float, deviation: float, blocks: int) -> tuple[float, tuple[float, float], float]:
    """(ratio of errors, its 95 % interval, p-value of the hypothesis that it is at most 1) by Student's t, from the
    logarithm of the ratio of their squares and its standard deviation."""
    deviation = max(deviation, 1e-6)
    half_width = float(stats.t.ppf(0.975, blocks - 1)) * deviation
    interval = math.exp(0.5 * (log_ratio - half_width)), math.exp(0.5 * min(log_ratio + half_width, 60.0))
    return math.exp(0.5 * log_ratio), interval, float(stats.t.sf(log_ratio / deviation, blocks - 1))


def _compute_bin_means(squares: np.ndarray, block: np.ndarray, bins: Sequence[Bin], rng: np.random.Generator,
                       resamples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean of the squares, bootstrap standard deviation of its logarithm, number of blocks) for each bin. The
    bootstrap resamples whole blocks; the number is 0 where it gives no standard deviation."""
    _, index = np.unique(block, return_inverse=True)
    weights = np.stack([b.mask for b in bins], axis=1).astype(float)
    count = int(index.max()) + 1 if len(index) else 0
    sums, counts = np.zeros((count, len(bins))), np.zeros((count, len(bins)))
    np.add.at(sums, index, weights * squares[:, None])
    np.add.at(counts, index, weights)
    blocks, deviation = (counts > 0).sum(axis=0), np.full(len(bins), np.nan)
    if not count:
        return deviation, deviation, blocks
    draws = rng.multinomial(count, np.full(count, 1.0 / count), size=resamples).astype(float)
    with np.errstate(all="ignore"):
        mean = sums.sum(axis=0) / counts.sum(axis=0)
        log_means = np.log((draws @ sums) / (draws @ counts))
        log_means[~np.isfinite(log_means)] = np.nan
        is_determined = np.isfinite(log_means).sum(axis=0) > 0.5 * resamples
        if is_determined.any():
            deviation[is_determined] = np.nanstd(log_means[:, is_determined], axis=0)
        # Bessel's correction: a bootstrap over few blocks underestimates the deviation.
        deviation *= np.sqrt(blocks / np.maximum(blocks - 1, 1))
    return mean, deviation, np.where(np.isfinite(deviation), blocks, 0)


def compute_log_residuals(samples: Samples, channel: str, noise: float) -> np.ndarray:
    """(n,) residuals of a regression of log squared errors on the conditions; NaN where undetermined. noise [SI]."""
    squares, c = samples.squares[channel], samples.conditions  # the constants limit the logarithms of values near 0
    rows = np.stack([np.ones(len(squares)), np.log(np.maximum(c["speed"], 0.5)),
                     np.log(np.abs(c["lateral_acceleration"]) + 0.2), np.log(c["steering_rate"] + 0.005),
                     np.abs(c["forward_acceleration"])], axis=1)
    values = np.log(squares + noise * noise)
    finite = np.isfinite(values) & np.isfinite(rows).all(axis=1)
    residual = np.full(len(squares), np.nan)
    if finite.sum() > 4 * rows.shape[1]:
        coefficients, *_ = np.linalg.lstsq(rows[finite], values[finite], rcond=None)
        residual[finite] = values[finite] - rows[finite] @ coefficients
    return residual


def find_segments(samples: Samples, channel: str, residual: np.ndarray, block: float, seed: int) -> list[Segment]:
    """Segments with larger errors than the rest of their run, by binary segmentation. A change point is significant if
    the cumulative sum of `residual` is larger than with shuffled blocks. residual: `compute_log_residuals` of the
    channel. block: duration of a block [s]."""
    rng = np.random.default_rng((seed, 17))
    segments = []
    for run in np.unique(samples.run):
        rows = np.flatnonzero((samples.run == run) & np.isfinite(residual))
        if not len(rows):
            continue
        time, index = np.unique(np.floor(samples.time[rows]), return_inverse=True)  # means over whole seconds
        values = np.bincount(index, residual[rows]) / np.bincount(index)
        changes = sorted(_find_change_points(values, 0, len(values), max(1, round(block)), rng, MAX_CHANGE_POINTS))
        for first, last in itertools.pairwise([0, *changes, len(values)]) if changes else ():
            other_values = np.concatenate((values[:first], values[last:]))
            ratio = math.exp(0.5 * float(values[first:last].mean() - other_values.mean()))
            if ratio >= MIN_ERROR_RATIO:
                segments.append(Segment(channel, int(run), float(time[first]), float(time[last - 1] + 1.0), ratio))
    return segments


def _find_change_points(values: np.ndarray, first: int, last: int, block: int, rng: np.random.Generator,
                        max_changes: int) -> list[int]:
    """Indices of at most `max_changes` significant change points in values[first:last]. block: values per block."""
    section, shortest = values[first:last], round(MIN_SEGMENT_DURATION)
    if max_changes < 1 or len(section) < max(2 * shortest, 4 * block):
        return []
    cusum = _cusum(section[None])[0]
    change = int(np.argmax(cusum[shortest:-shortest])) + shortest if len(section) > 2 * shortest else shortest
    pieces = section[:len(section) // block * block].reshape(-1, block)
    permutations = np.stack([pieces[rng.permutation(len(pieces))].ravel() for _ in range(PERMUTATIONS)])
    largest = _cusum(permutations).max(axis=1)
    p = (1 + int((largest >= cusum[change]).sum())) / (1 + PERMUTATIONS)
    if p > MAX_P_VALUE:
        return []
    middle = first + change
    return [middle, *_find_change_points(values, first, middle, block, rng, max_changes - 1),
            *_find_change_points(values, middle, last, block, rng, max_changes - 1)][:max_changes]


def _cusum(rows: np.ndarray) -> np.ndarray:
    """|sum of x - mean(x) over the elements before each one|, divided by the standard deviation and sqrt(length)."""
    centred = rows - rows.mean(axis=1, keepdims=True)
    sums = np.cumsum(centred, axis=1) - centred
    return np.abs(sums) / (rows.std(axis=1, keepdims=True) * math.sqrt(rows.shape[1]) + 1e-12)


def find_cells(samples: Samples, channel: str, residual: np.ndarray) -> list[Cell]:
    """Cells visited in at least MIN_BLOCKS blocks. residual: `compute_log_residuals` of the channel."""
    finite = np.isfinite(residual)
    grid = np.stack([np.floor(samples.x[finite] / CELL_SIZE), np.floor(samples.y[finite] / CELL_SIZE)], axis=1)
    unique, index = np.unique(grid, axis=0, return_inverse=True)
    cells = []
    for k, (column, row) in enumerate(unique):
        visits = np.flatnonzero(finite)[index.ravel() == k]
        block = samples.block[visits]
        means = np.array([residual[visits[block == b]].mean() for b in np.unique(block)])
        if len(means) < MIN_BLOCKS:
            continue
        deviation = float(means.std(ddof=1)) / math.sqrt(len(means))
        cells.append(Cell(channel, float(CELL_SIZE * (column + 0.5)), float(CELL_SIZE * (row + 0.5)),
                          *_test_ratio(float(means.mean()), deviation, len(means))))
    return cells
