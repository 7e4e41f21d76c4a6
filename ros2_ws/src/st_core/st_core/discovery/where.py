"""Statements on conditions, times and places with larger prediction errors than expected."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..channels import CHANNEL_OF_COLUMN
from ..log import DriveLog
from ..log_signals import LogSignals
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .result import ErrorCondition
from .settings import DiscoverySettings
from .where_parts import (
    CELL_SIZE,
    EVERYWHERE,
    FALSE_DISCOVERY_RATE,
    MIN_ERROR_RATIO,
    PERMUTATIONS,
    BinExcess,
    Cell,
    Part,
    Samples,
    compute_excesses,
    find_cells,
    find_changes,
    membership,
    range_text,
)
from .windows import STEP, Windows

SHORT_HORIZON = 1.0  # s, for errors of velocity, yaw rate and acceleration, to locate where they arise
RESAMPLES = 1000  # bootstrap samples
MAX_RANGES = 3  # maximum number of statements about conditions per channel
SIGNED = ("lateral acceleration", "steering angle", "steering rate")  # signed quantities that are binned by magnitude
MIN_CONTRAST = 1.15  # minimum ratio of the error in a reported range to the error in all driving


def largest_errors(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                   settings: DiscoverySettings, reference: Sequence[DriveLog] = (),
                   noise: Mapping[str, float] | None = None, gain: float = 0.0) -> tuple[ErrorCondition, ...]:
    """Conditions, times and places in which the errors of a model exceed those in the reference drives or, without a
    reference, the sensor noise.

    noise: standard deviation by channel [unit], required without a reference. gain: see `Windows.errors`. Channels that
    are not measured in the runs or in the reference are left out.
    """
    samples = window_errors(runs, model, vehicle, settings, gain)
    expected = window_errors(reference, model, vehicle, settings, gain) if reference else None
    if expected is not None:
        common = [c for c in samples.squares if c in expected.squares and np.isfinite(expected.squares[c]).any()]
        samples = replace(samples, squares={c: samples.squares[c] for c in common})
    sigma = {channel: (noise or {}).get(channel, 0.0) for channel in samples.squares}
    ranges, members = membership(samples)
    bins = compute_excesses(samples, members, ranges, expected, sigma, settings.seed, RESAMPLES)
    parts = [part for channel, noise_level in sigma.items()
             for part in find_changes(samples, channel, noise_level, settings.block, settings.seed, PERMUTATIONS)]
    places = _significant([cell for channel, noise_level in sigma.items()
                           for cell in find_cells(samples, channel, noise_level)])
    return tuple(statement for channel in samples.squares
                 for statement in _statements(channel, bins, parts, places, samples, expected is not None))


def window_errors(runs: Sequence[DriveLog], model: AugmentedModel, vehicle: VehicleParameters,
                  settings: DiscoverySettings, gain: float = 0.0) -> Samples:
    """Errors and conditions of all windows of the runs, see `windows.Windows`."""
    windows = Windows(runs, vehicle, settings)
    squares = _mean_squared_errors(windows, np.square(windows.errors(model, gain)))
    rows = [_places_of_run(log, windows.seconds[windows.run == number], float(windows.time[-1]))
            for number, log in enumerate(runs)]
    place = {name: np.concatenate([r[name] for r in rows]) for name in rows[0]}
    known = np.isfinite(np.stack([*squares.values(), *place.values()])).all(axis=0)
    x, y, time = (place.pop(name)[known] for name in ("x", "y", "time"))
    return Samples(windows.names, windows.run[known], time, x, y, windows.block[known],
                   {name: values[known] for name, values in place.items()},
                   {channel: values[known] for channel, values in squares.items()})


def _mean_squared_errors(windows: Windows, squares: np.ndarray) -> dict[str, np.ndarray]:
    """(n,) mean square error by channel over the first SHORT_HORIZON; for channels with accumulating errors, square
    error at the end of the horizon."""
    short = windows.time <= max(SHORT_HORIZON, float(windows.time[0]))
    found: dict[str, np.ndarray] = {}
    for column, square in zip(windows.columns, np.moveaxis(squares, -1, 0), strict=True):
        channel = CHANNEL_OF_COLUMN[column]
        value = square[:, -1] if channel.accumulates else square[:, short].mean(axis=1)
        found[channel.name] = found.get(channel.name, 0.0) + value
    return found


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


def _significant(found: list[Cell]) -> list[Cell]:
    """The significant cells (Benjamini and Hochberg over all cells) with a ratio of at least MIN_ERROR_RATIO."""
    if not found:
        return []
    adjusted = stats.false_discovery_control([c.p for c in found], method="bh")
    return [c for c, q in zip(found, adjusted, strict=True) if q <= FALSE_DISCOVERY_RATE and c.ratio >= MIN_ERROR_RATIO]


def _statements(channel: str, bins: Sequence[BinExcess], parts: Sequence[Part], places: Sequence[Cell],
                samples: Samples, with_reference: bool) -> list[ErrorCondition]:
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
        statements.append(ErrorCondition(channel, EVERYWHERE, overall.excess, overall.interval))
    statements += [_part_statement(part, overall, samples) for part in parts if part.channel == channel]
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
                     with_reference: bool) -> ErrorCondition:
    """Statement on a group of ranges. bins: all bins of the channel. overall: the bin of all driving."""
    quantity = group[0].range.quantity
    if quantity == "direction":
        return ErrorCondition(overall.channel, f"{group[0].range.label} turns" if group[0].range.label != "straight"
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
    return ErrorCondition(overall.channel, condition, excess, (low, high))


def _part_statement(part: Part, overall: BinExcess, samples: Samples) -> ErrorCondition:
    """Statement on a stretch of a run; its excess is the overall excess times the ratio of the stretch."""
    last = float(samples.time[samples.run == part.run].max())
    name = samples.names[part.run]
    when = (f"from {part.start:.0f} s on" if part.end >= last - 1.0 else f"until {part.end:.0f} s" if part.start < 2.0
            else f"from {part.start:.0f} to {part.end:.0f} s")
    text = f"run {name}, {when}: {part.ratio:.1f} times the error of the rest of the run under similar conditions"
    return ErrorCondition(part.channel, text, overall.excess * part.ratio,
                          (overall.interval[0] * part.ratio, overall.interval[1] * part.ratio))


def _place_statements(places: Sequence[Cell], overall: BinExcess) -> list[ErrorCondition]:
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
        statements.append(ErrorCondition(overall.channel, text, overall.excess * ratio,
                                         (overall.excess * low, overall.excess * high)))
    return sorted(statements, key=lambda s: -s.excess)[:2]
