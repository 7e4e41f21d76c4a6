"""Multi-step errors: from instants of the recorded drives the model predicts what the sensors then showed.

All runs are laid out one after the other on one clock, so that one call of the batch predicts every window of a
discovery. A window starts from the measured state. Without the measured sideslip it starts from that of steady
cornering and is scored once that guess is forgotten.
"""

from collections import OrderedDict
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..augmented import AugmentedModel
from ..batch import LogBatch, Recording
from ..channels import CHANNELS
from ..composition import compose
from ..effects import Measured
from ..errors import StCoreError
from ..log import INS_SIGNALS, DriveLog
from ..log_signals import LogSignals, same
from ..models import Model
from ..readings import true_readings
from ..start_grid import Block
from ..timeseries import NANOSECOND, Neighbours
from ..vehicle import VehicleParameters
from .settings import DiscoverySettings

STEP = 0.05  # s, of the integration
SIDESLIP_SETTLING_TIME = 0.75  # s until a guessed sideslip is forgotten
MARGIN_NS = 600_000_000  # at both ends of a run: a delayed or early steering is known there too
MAX_GAP = 0.1  # s: nothing is interpolated across a longer one, as in PredictionSettings.maximum_gap
MIN_SPEED = 1.5  # m/s. Slower windows show no lateral motion
PAUSE_NS = 5_000_000_000  # between runs laid out on one clock
RECORDING_CACHE_SIZE = 4  # recordings as the last models correct them, and what follows from them
LOOKUP_CACHE_SIZE = 8  # sets of instants remembered, with where they lie between the samples
SCORED_SHARES = (0.1, 0.25, 0.5, 1.0)  # of the horizon: where it is scored


class Signals(LogSignals):
    """A drive with the slope of the forward speed over 2 STEP, without delay, as forward acceleration. Where the last
    requested instants lie between the samples is kept: a fit requests the same ones thousands of times."""

    def __init__(self, log: DriveLog, maximum_gap: float):
        self.log, self.maximum_gap = log, maximum_gap
        self._gap_ns = round(maximum_gap / NANOSECOND)
        seconds = (log.ins_time_ns - log.ins_time_ns[:1]) * NANOSECOND
        low, high = np.maximum(seconds - STEP, 0.0), np.minimum(seconds + STEP, seconds[-1:])
        ends = [np.interp(t, seconds, log.velocity_x) for t in (low, high)]
        self.velocity_x_dot = (ends[1] - ends[0]) / np.maximum(high - low, STEP)
        self._places: OrderedDict[tuple, tuple] = OrderedDict()

    def of(self, log: DriveLog) -> "Signals":
        if not same(log, self.log, "ins_time_ns", "velocity_x"):
            other = Signals(log, self.maximum_gap)
            other._places = self._places
            return other
        other = copy(self)
        other.log = log
        return other

    def _find_neighbours(self, times: np.ndarray, requested: np.ndarray) -> Neighbours:
        key = _memory(times), _memory(requested)
        known = self._places.pop(key, None)
        # The same place in memory may hold other numbers by now: to compare them takes a hundredth of a search.
        if known is None or not (np.array_equal(known[0], times) and np.array_equal(known[1], requested)):
            known = times.copy(), requested.copy(), super()._find_neighbours(times, requested)
        return _remember(self._places, key, known, LOOKUP_CACHE_SIZE)[2]


class Batch(LogBatch):
    """A LogBatch for thousands of fits: the caller validates the step once. The recording and what depends on the
    inputs alone are cached for models that correct it alike, as most do that a fit tries one after the other."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._recordings: OrderedDict[tuple, Recording] = OrderedDict()
        self._tables: OrderedDict[tuple, tuple[list[np.ndarray], np.ndarray]] = OrderedDict()

    def recording(self, model: Any) -> Recording:
        key = model.measuring
        return _remember(self._recordings, key, self._recordings.pop(key, None) or super().recording(model))

    def _table(self, block: Block, values: list[np.ndarray], model: Any, p: Any) -> np.ndarray:
        # The values are kept as well, so that no others are ever at their place in memory.
        key = (block.number, model.inputs, model.looked_at(p), *map(id, values))
        known = self._tables.pop(key, None) or (values, super()._table(block, values, model, p))
        return _remember(self._tables, key, known)[1]

    def _count_substeps(self, model: Model, vehicle: VehicleParameters) -> Any:
        return self._substeps


def _memory(array: np.ndarray) -> tuple:
    """What two views of the same numbers have in common."""
    return array.ctypes.data, array.shape, array.strides


def _remember(kept: OrderedDict, key: tuple, value: Any, most: int = RECORDING_CACHE_SIZE) -> Any:
    kept[key] = value
    while len(kept) > most:
        kept.popitem(last=False)
    return value


@dataclass(frozen=True, eq=False)
class Errors:
    """values: (n, k, c), measured minus predicted, SI, columns as `columns`; NaN where not known. predicted: (n, k) the
    lateral acceleration the sensor would show. time: (k,) after the start [s]."""

    values: np.ndarray
    predicted: np.ndarray
    columns: tuple[str, ...]
    time: np.ndarray


def score_points(settings: DiscoverySettings) -> np.ndarray:
    """Multiples of STEP after the start at which errors are taken."""
    first = 0.0 if "velocity_y" in settings.channels else SIDESLIP_SETTLING_TIME
    points = np.maximum(np.round((first + settings.horizon * np.array(SCORED_SHARES)) / STEP), 1).astype(int)
    return np.unique(points)


def smoothed(time_ns: np.ndarray, values: np.ndarray, width_ns: int) -> np.ndarray:
    """Mean over `width_ns` about each sample, as far as there are samples: centred, no delay."""
    total = np.concatenate(([0.0], np.cumsum(values)))
    low = np.searchsorted(time_ns, time_ns - width_ns // 2)
    high = np.searchsorted(time_ns, time_ns + width_ns // 2, side="right")
    return (total[high] - total[low]) / (high - low)


def steady_velocity_y(log: DriveLog, vehicle: VehicleParameters) -> np.ndarray:
    """v_y at the INS of steady cornering [m/s]: r (l_r - m l_f v^2 / (l C_r)) + r d_x."""
    slip = vehicle.mass * vehicle.cg_to_front_axle / (vehicle.wheelbase * vehicle.cornering_stiffness_rear)
    return log.yaw_rate * (vehicle.cg_to_rear_axle - slip * log.velocity_x**2 + vehicle.cg_to_ins_x)


def prepared(log: DriveLog, vehicle: VehicleParameters, settings: DiscoverySettings) -> DriveLog:
    """The drive windows start from: yaw rate without most of its noise, sideslip guessed where it is not to be used."""
    rate = smoothed(log.ins_time_ns, log.yaw_rate, 50_000_000)
    log = replace(log, yaw_rate=rate)
    return log if "velocity_y" in settings.channels else replace(log, velocity_y=steady_velocity_y(log, vehicle))


class Windows:
    """The windows of some runs. starts_ns: (n,) on the common clock; run, block: (n,) whole numbers; seconds: (n,) into
    the run."""

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings):
        self.vehicle, self.settings = vehicle, settings
        self.names = tuple(run.name for run in runs)
        self.channels = tuple(c for name, c in CHANNELS.items() if name in settings.channels)
        self.columns = tuple(column for channel in self.channels for column in channel.columns)
        self._points = score_points(settings)
        self.time = STEP * self._points
        joined, offsets = _join(runs)
        self.joined = joined
        horizon = int(self._points[-1]) + 1
        starts, run, seconds = _starts(runs, offsets, horizon * STEP, settings)
        around = np.unique(np.concatenate([self._points - 1, self._points, self._points + 1]))
        self._around = np.searchsorted(around, np.stack([self._points - 1, self._points, self._points + 1]))
        signals = Signals(prepared(joined, vehicle, settings), MAX_GAP)
        self._batch = Batch(signals, starts, horizon * STEP, STEP, points=np.round(around * STEP, 6))
        times = starts[:, None] + np.round(self._points * (STEP / NANOSECOND)).astype(np.int64)
        self._times, self._measured = times, self._readings(times)
        self.starts_ns, self.run, self.seconds = starts, run, seconds
        self.block = _blocks(run, seconds, settings.block)
        self._length = horizon * STEP

    def __len__(self) -> int:
        return len(self.starts_ns)

    @property
    def speeds(self) -> np.ndarray:
        """(n, points) forward speed at the points of the windows that are compared [m/s]."""
        return self._measured["velocity_x"]

    def measured_at(self, times: np.ndarray, *names: str) -> tuple[np.ndarray, ...]:
        """What was measured at any times [ns] of the common clock."""
        return tuple(self._batch.signals.ins_at(times, *names))

    def _readings(self, times: np.ndarray) -> dict[str, np.ndarray]:
        log, width = self.joined, round(2 * STEP / NANOSECOND)
        signals = Signals(log, MAX_GAP)
        names = {"x": False, "y": False, "yaw": False, "velocity_x": False} | {
            name: channel.smoothed for channel in self.channels for name in channel.signals}
        result = {}
        for name, smooth in names.items():
            values = getattr(log, name)
            there = np.isfinite(values)
            time_ns, values = log.ins_time_ns[there], values[there]
            result[name] = signals.sample(time_ns, smoothed(time_ns, values, width) if smooth else values, times)
        return result

    @cached_property
    def known(self) -> np.ndarray:
        """(n, m) which errors of a window, all points and columns in a row, have a measurement, and inputs up to it."""
        there = [np.isfinite([self._measured[name] for name in channel.signals]).all(axis=0)
                 for channel in self.channels for _ in channel.columns]
        return (np.stack(there, axis=-1) & self._with_inputs[..., None]).reshape(len(self), -1)

    @cached_property
    def _with_inputs(self) -> np.ndarray:
        """(n, k) points of a window before the first gap of steering or INS: beyond it no prediction can be made,
        whatever the model. MARGIN_NS around a gap, as at the ends of a run."""
        until = np.full(len(self), np.iinfo(np.int64).max)
        for time_ns in (self.joined.steering_time_ns, self.joined.ins_time_ns):
            gaps = np.flatnonzero(np.diff(time_ns) > MAX_GAP / NANOSECOND)
            first = np.searchsorted(time_ns[gaps + 1], self.starts_ns - MARGIN_NS, side="right")
            until = np.minimum(until, np.append(time_ns[gaps], until.max())[first] - MARGIN_NS // 2)
        return self._times <= until[:, None]

    @cached_property
    def driven(self) -> dict[str, np.ndarray]:
        """(n,) of each window: x, y [m] of its start, speed [m/s], lateral acceleration [m/s^2] in magnitude, means."""
        grid = self.starts_ns[:, None] + np.round(np.linspace(0.0, self._length, 12) / NANOSECOND).astype(np.int64)
        x, y, rate, speed = self._batch.signals.ins_at(grid, "x", "y", "yaw_rate", "velocity_x")
        with np.errstate(all="ignore"):
            return {"x": x[:, 0], "y": y[:, 0], "speed": np.nan_to_num(speed).mean(axis=1),
                    "lateral_acceleration": np.abs(np.nan_to_num(rate * speed)).mean(axis=1)}

    def errors(self, model: AugmentedModel, gain: float = 0.0) -> Errors:
        """Errors of a model; gain: what the accelerometer shows more than the motion, as a body that rolls makes it."""
        shown, true = self._seen(model, gain)
        parts = [part for channel in self.channels for part in channel.off(self._measured, shown, true)]
        return Errors(np.stack(parts, axis=-1), shown.acceleration_y, self.columns, self.time)

    def _seen(self, model: AugmentedModel, gain: float) -> tuple[Measured, Measured]:
        """What the INS would show at the points, with and without errors of its own; acceleration and yaw rate as means
        over 2 STEP, as measured.

        The gain is of what the unit feels; what the sensor adds of its own comes after.
        """
        states = self._batch.predict(model, self.vehicle).states
        with np.errstate(all="ignore"):
            shown = true_readings(model, self.vehicle, tuple(np.moveaxis(states, -1, 0)))
            before, true, after = (Measured(*(value[:, i] for value in shown)) for i in self._around)
            turning = [e.velocity_x * e.yaw_rate for e in (before, true, after)]
            a_y = (after.velocity_y - before.velocity_y) / (2 * STEP) + (
                turning[0] + 4.0 * turning[1] + turning[2]) / 6.0
            rate = (before.yaw_rate + 4.0 * true.yaw_rate + after.yaw_rate) / 6.0
            specific_force = self._specific_force(model, states[:, self._around[1]])
            true = true._replace(yaw_rate=rate, acceleration_x=0.0 * a_y,
                                 acceleration_y=(1.0 + gain) * (a_y + specific_force),
                                 yaw_acceleration=(after.yaw_rate - before.yaw_rate) / (2 * STEP))
            return model.observe(true), true

    def _specific_force(self, model: AugmentedModel, states: np.ndarray) -> np.ndarray | float:
        """What an accelerometer shows on top of the motion [m/s^2]."""
        if not any(e.specific_force for e in model.active):
            return 0.0
        recording = self._batch.recording(model)
        if "points" not in recording.sampled:
            signals = recording.signals
            acceleration, = signals.ins_at(self._times, "velocity_x_dot")
            recording.sampled["points"] = signals.road_wheel_angle_at(self._times), acceleration
        return added_acceleration(model, self.vehicle, tuple(np.moveaxis(states, -1, 0)),
                                  *recording.sampled["points"])


def added_acceleration(model: AugmentedModel, vehicle: VehicleParameters, states: tuple, angle: np.ndarray,
                       acceleration: np.ndarray) -> np.ndarray | float:
    """a_y an accelerometer at the CG shows on top of the motion [m/s^2]; states: the six, arrays as the inputs."""
    # Only those effects that act on an accelerometer, and what changes the inputs they look at.
    model = model.only(e for e in model.effects if e.lifts or (e in model.active and (e.specific_force or e.inputs)))
    added = compose(model.base, model.effects).specific_force
    if added is None:
        return 0.0
    p = model.parameters(vehicle)
    extra = [np.zeros(np.shape(angle))] * len(model.extra_states)
    return added((*states, *extra), model.inputs(angle, acceleration, p), p)[1]


def _join(runs: Sequence[DriveLog]) -> tuple[DriveLog, list[int]]:
    """All runs on one clock, PAUSE_NS apart, and what was added to the times of each."""
    names = dict.fromkeys((*INS_SIGNALS, *(name for channel in CHANNELS.values() for name in channel.signals)))
    offsets, at = [], 0
    for run in runs:
        offsets.append(at - run.start_ns)
        at += run.end_ns - run.start_ns + PAUSE_NS
    parts = {n: np.concatenate([getattr(run, n) for run in runs]) for n in (*names, "road_wheel_angle")
             if all(getattr(run, n) is not None for run in runs)}
    times = {n: np.concatenate([getattr(run, n) + o for run, o in zip(runs, offsets, strict=True)])
             for n in ("ins_time_ns", "steering_time_ns")}
    return DriveLog(name="all runs", **times, **parts), offsets


def _starts(runs: Sequence[DriveLog], offsets: Sequence[int], horizon: float,
            settings: DiscoverySettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants, run and seconds into the run of all windows driven faster than MIN_SPEED."""
    length = round(horizon / NANOSECOND)
    usable = sum(max(run.overlap - horizon, 0.0) for run in runs)
    interval = max(settings.interval, usable / settings.windows)
    spacing = round(round(interval / (STEP / 2)) * (STEP / 2) / NANOSECOND)
    starts, number, seconds = [], [], []
    for i, (run, offset) in enumerate(zip(runs, offsets, strict=True)):
        if not run.overlap:
            continue
        begin = max(int(run.ins_time_ns[0]), int(run.steering_time_ns[0]))
        end = min(int(run.ins_time_ns[-1]), int(run.steering_time_ns[-1]))
        times = np.arange(begin + MARGIN_NS, end - length - MARGIN_NS // 2, spacing, dtype=np.int64)
        here, there = (np.interp(t - begin, run.ins_time_ns - begin, run.velocity_x) for t in (times, times + length))
        times = times[(here > MIN_SPEED) & (there > MIN_SPEED)]
        starts.append(times + offset)
        number.append(np.full(len(times), i))
        seconds.append((times - begin) * NANOSECOND)
    if not starts:
        raise StCoreError("no run in which both INS and steering were measured")
    return np.concatenate(starts), np.concatenate(number), np.concatenate(seconds)


def _blocks(run: np.ndarray, seconds: np.ndarray, length: float) -> np.ndarray:
    """Number of the block of each window: stretches of `length` seconds of one run."""
    keys = np.stack([run, (seconds // length).astype(int)], axis=1)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def noise_floor(windows: Windows) -> dict[str, float]:
    """By column, at the end of the horizon, one standard deviation of noise [SI]; see `channels.Channel.noise`."""
    grid = windows.starts_ns[:, None] + np.round(np.linspace(0.0, windows.time[-1], 101) * 1e9).astype(np.int64)
    way = float(windows.time[-1]) / 100.0, *windows.measured_at(grid, *INS_SIGNALS)
    return {column: value for channel in windows.channels
            for column, value in zip(channel.columns, channel.left(windows.joined, *way), strict=True)}
