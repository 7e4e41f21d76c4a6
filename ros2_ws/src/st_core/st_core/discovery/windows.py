"""Multi-step prediction errors: predictions from many instants of the recorded drives, compared with measurements.

All runs are placed one after the other on a common clock, and one batch predicts all windows. A window starts from the
measured state. If sideslip is not measured, it starts from the sideslip of steady cornering and is scored only after
the influence of this assumption has decayed.
"""

from collections import OrderedDict
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from ..augmented import AugmentedModel
from ..batch import LogBatch, Recording
from ..channels import CHANNELS, SMOOTHING_NS
from ..composition import compose
from ..effects import Measured
from ..errors import StCoreError
from ..integrate import required_substeps
from ..log import INS_SIGNALS, DriveLog, LogSignals, shares_memory
from ..models import TYRE_MODELS, Model
from ..readings import predict_ideal_readings
from ..sideslip import compute_steady_velocity_y
from ..timeseries import NANOSECOND, Neighbours, moving_average
from ..vehicle import VehicleParameters
from .settings import DiscoverySettings

STEP = 0.05  # s, integration step
SIDESLIP_SETTLING_TIME = 0.75  # s, in which the error of an assumed initial sideslip decays
MARGIN_NS = 600_000_000  # ns before the first window, half of it after the last, for time shifts of the steering
MAX_GAP = 0.1  # s, longest gap that is interpolated, as PredictionSettings.maximum_gap
MIN_SPEED = 1.5  # m/s; slower windows have hardly any lateral motion
PAUSE_NS = 5_000_000_000  # ns between runs on the common clock
YAW_RATE_SMOOTHING_NS = 50_000_000  # ns, moving average of the initial yaw rate
RECORDING_CACHE_SIZE = 4  # number of corrected recordings
LOOKUP_CACHE_SIZE = 8  # number of sets of instants with their neighbouring samples
SCORED_FRACTIONS = (0.1, 0.25, 0.5, 1.0)  # of the horizon; `Windows` may add the settling time


class Signals(LogSignals):
    """Signals of a drive. Forward acceleration is the central difference of the forward speed over 2 STEP. The
    neighbouring samples of requested instants are cached, since a fit requests the same instants thousands of times."""

    def __init__(self, log: DriveLog, maximum_gap: float):
        self.log, self.maximum_gap = log, maximum_gap
        self._gap_ns = round(maximum_gap / NANOSECOND)
        seconds = (log.ins_time_ns - log.ins_time_ns[:1]) * NANOSECOND
        before, after = np.maximum(seconds - STEP, 0.0), np.minimum(seconds + STEP, seconds[-1:])
        change = np.interp(after, seconds, log.velocity_x) - np.interp(before, seconds, log.velocity_x)
        self.velocity_x_dot = change / np.maximum(after - before, STEP)
        self._lookups: OrderedDict[tuple, tuple] = OrderedDict()

    def for_log(self, log: DriveLog) -> "Signals":
        is_same_motion = shares_memory(log, self.log, "ins_time_ns", "velocity_x")
        other = copy(self) if is_same_motion else Signals(log, self.maximum_gap)
        other.log, other._lookups = log, self._lookups
        return other

    def _find_neighbours(self, times: np.ndarray, requested: np.ndarray) -> Neighbours:
        key = _memory_key(times), _memory_key(requested)
        entry = self._lookups.pop(key, None)
        # The memory may have been reused for other values; comparing them is a hundred times faster than searching.
        if entry is None or not (np.array_equal(entry[0], times) and np.array_equal(entry[1], requested)):
            entry = times.copy(), requested.copy(), super()._find_neighbours(times, requested)
        return _remember(self._lookups, key, entry, LOOKUP_CACHE_SIZE)[2]


class Batch(LogBatch):
    """A LogBatch for thousands of predictions: the integration step is checked only once, and recordings are cached for
    models that correct them in the same way. minimum_substeps: smallest number of substeps; more if the step is
    unstable at the speeds of the drives, as for scale models."""

    def __init__(self, vehicle: VehicleParameters, minimum_substeps: int, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._substeps = max(minimum_substeps, *(required_substeps(model, vehicle, self._speeds, self.step)
                                                 for model in TYRE_MODELS))
        self._recordings: OrderedDict[tuple, Recording] = OrderedDict()

    def recording(self, model: Any) -> Recording:
        key = model.correction_key
        return _remember(self._recordings, key, self._recordings.pop(key, None) or super().recording(model))

    def _count_substeps(self, model: Model, vehicle: VehicleParameters) -> Any:
        return self._substeps


def _memory_key(array: np.ndarray) -> tuple:
    """Cache key that is equal for two views of the same memory."""
    return array.ctypes.data, array.shape, array.strides


def _remember(cache: OrderedDict, key: tuple, value: Any, size: int = RECORDING_CACHE_SIZE) -> Any:
    """Add a value to a cache as the newest, drop the oldest beyond `size`, and return the value."""
    cache[key] = value
    while len(cache) > size:
        cache.popitem(last=False)
    return value


class Windows:
    """The n windows of the runs. Raises StCoreError for a duplicate name, and unless a run has both INS and steering.

    starts_ns: (n,) starts on the common clock [ns].
    run, block: (n,) numbers of the run and of the block.
    seconds: (n,) starts, counted from the first instant of the run with both INS and steering [s].
    time: (k,) time of the scored points after the start of a window [s]; the last is the horizon, or
        SIDESLIP_SETTLING_TIME later without velocity_y.
    columns: (c,) names of the errors.
    run_time: time of each sample of `joined_log`, counted like `seconds` [s]; also a signal for models.
    """

    MIN_SUBSTEPS = 1  # substeps per STEP

    def __init__(self, runs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DiscoverySettings):
        self.vehicle, self.settings = vehicle, settings
        self.names = tuple(run.name for run in runs)
        if not runs:
            raise StCoreError("drives: none given; at least one is needed")
        if len(set(self.names)) < len(runs):
            raise StCoreError(f"drives {', '.join(self.names)}: duplicate name; give each drive once")
        self.channels = tuple(c for name, c in CHANNELS.items() if name in settings.channels)
        self.columns = tuple(column for channel in self.channels for column in channel.columns)
        with_sideslip = "velocity_y" in settings.channels
        settling_time = 0.0 if with_sideslip else SIDESLIP_SETTLING_TIME
        points = np.maximum(np.round((settling_time + settings.horizon * np.array(SCORED_FRACTIONS)) / STEP), 1)
        self._points = np.unique(points.astype(int))  # multiples of STEP
        self.time = STEP * self._points
        self.joined_log, offsets = _join(runs)
        steps = int(self._points[-1]) + 1
        starts, run, seconds = _select_starts(runs, offsets, steps * STEP, settings)
        stencil = np.unique(np.concatenate([self._points - 1, self._points, self._points + 1]))
        self._stencil_indices = np.searchsorted(stencil, np.stack([self._points - 1, self._points, self._points + 1]))
        yaw_rate = moving_average(self.joined_log.ins_time_ns, self.joined_log.yaw_rate, YAW_RATE_SMOOTHING_NS)
        initial = replace(self.joined_log, yaw_rate=yaw_rate)
        initial = initial if with_sideslip else replace(initial, velocity_y=compute_steady_velocity_y(initial, vehicle))
        self.run_time = np.concatenate([(run.ins_time_ns - (run.common_span_ns[0] or run.start_ns)) * NANOSECOND
                                        for run in runs])
        self._batch = Batch(vehicle, self.MIN_SUBSTEPS, Signals(initial, MAX_GAP), starts, steps * STEP, STEP,
                            points=np.round(stencil * STEP, 6),
                            signals={"run_time": (self.joined_log.ins_time_ns, self.run_time)})
        times = starts[:, None] + np.round(self._points * (STEP / NANOSECOND)).astype(np.int64)
        self._times, self._measured = times, self._sample_channels(times)
        self.starts_ns, self.run, self.seconds = starts, run, seconds
        blocks = np.stack([run, (seconds // settings.block).astype(int)], axis=1)
        self.block = np.unique(blocks, axis=0, return_inverse=True)[1].ravel()
        self._duration = steps * STEP

    def __len__(self) -> int:
        return len(self.starts_ns)

    def errors(self, model: AugmentedModel, gain: float = 0.0) -> np.ndarray:
        """(n, k, c) measured minus predicted [SI]; NaN where unknown. gain [1]: `Discovery.acceleration_gain`, applied
        to the true specific force, before the sensor errors. Predicted acceleration and yaw rate are means over 2 STEP,
        like the measurements."""
        states = self._batch.predict(model, self.vehicle)
        with np.errstate(all="ignore"):  # predictions may diverge
            readings = predict_ideal_readings(model, self.vehicle, tuple(np.moveaxis(states, -1, 0)))
            before, at_point, after = (Measured(*(value[:, i] for value in readings)) for i in self._stencil_indices)
            centripetal = [e.velocity_x * e.yaw_rate for e in (before, at_point, after)]
            # Means over 2 STEP by Simpson's rule.
            a_y = (after.velocity_y - before.velocity_y) / (2 * STEP) + (
                centripetal[0] + 4.0 * centripetal[1] + centripetal[2]) / 6.0
            yaw_rate = (before.yaw_rate + 4.0 * at_point.yaw_rate + after.yaw_rate) / 6.0
            excess: np.ndarray | float = 0.0
            if any(e.specific_force for e in model.active_effects):
                recording = self._batch.recording(model)
                if "points" not in recording.sample_cache:
                    acceleration, = recording.signals.ins_at(self._times, "velocity_x_dot")
                    recording.sample_cache["points"] = recording.signals.road_wheel_angle_at(self._times), acceleration
                at_points = tuple(np.moveaxis(states[:, self._stencil_indices[1]], -1, 0))
                excess = specific_force_excess(model, self.vehicle, at_points, *recording.sample_cache["points"])
            observed = model.observe(at_point._replace(
                yaw_rate=yaw_rate, acceleration_x=0.0 * a_y, acceleration_y=(1.0 + gain) * (a_y + excess),
                yaw_acceleration=(after.yaw_rate - before.yaw_rate) / (2 * STEP)))
            parts = [part for channel in self.channels for part in channel.residuals(self._measured, observed)]
        return np.stack(parts, axis=-1)

    @property
    def speeds(self) -> np.ndarray:
        """(n, k) measured forward speed at the scored points [m/s]."""
        return self._measured["velocity_x"]

    def measured_at(self, times: np.ndarray, *names: str) -> tuple[np.ndarray, ...]:
        """Measured signals at times [ns] of the common clock."""
        return tuple(self._batch.signals.ins_at(times, *names))

    def _sample_channels(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """Measured signals at times [ns], by name; smoothed where `Channel.smoothed` is set."""
        log, signals = self.joined_log, Signals(self.joined_log, MAX_GAP)
        smoothing = dict.fromkeys(("x", "y", "yaw", "velocity_x"), False) | {
            name: channel.smoothed for channel in self.channels for name in channel.signals}
        samples = {}
        for name, is_smoothed in smoothing.items():
            values = getattr(log, name)
            known = np.isfinite(values)
            time_ns, values = log.ins_time_ns[known], values[known]
            if is_smoothed:
                values = moving_average(time_ns, values, SMOOTHING_NS)
            samples[name] = signals.sample(time_ns, values, times)
        return samples

    @cached_property
    def known(self) -> np.ndarray:
        """(n, k c) whether each error is known: measured, and without a gap of the inputs before it."""
        measured = [np.isfinite([self._measured[name] for name in channel.signals]).all(axis=0)
                    for channel in self.channels for _ in channel.columns]
        return (np.stack(measured, axis=-1) & self._has_inputs[..., None]).reshape(len(self), -1)

    @cached_property
    def _has_inputs(self) -> np.ndarray:
        """(n, k) whether steering and INS have no gap before a point; after a gap, predictions are unknown. Margins are
        the same as at the ends of a run: MARGIN_NS before the start of a window, half of it after a point."""
        last = np.full(len(self), np.iinfo(np.int64).max)
        for time_ns in (self.joined_log.steering_time_ns, self.joined_log.ins_time_ns):
            gaps = np.flatnonzero(np.diff(time_ns) > MAX_GAP / NANOSECOND)
            first = np.searchsorted(time_ns[gaps + 1], self.starts_ns - MARGIN_NS, side="right")
            last = np.minimum(last, np.append(time_ns[gaps], last.max())[first] - MARGIN_NS // 2)
        return self._times <= last[:, None]

    @cached_property
    def conditions(self) -> dict[str, np.ndarray]:
        """(n,) x, y at the start [m], mean speed [m/s], mean |lateral acceleration| [m/s^2] of the windows, by name."""
        grid = self.starts_ns[:, None] + np.round(np.linspace(0.0, self._duration, 12) / NANOSECOND).astype(np.int64)
        x, y, rate, speed = self._batch.signals.ins_at(grid, "x", "y", "yaw_rate", "velocity_x")
        with np.errstate(all="ignore"):
            return {"x": x[:, 0], "y": y[:, 0], "speed": np.nan_to_num(speed).mean(axis=1),
                    "lateral_acceleration": np.abs(np.nan_to_num(rate * speed)).mean(axis=1)}

    def noise_floor(self) -> dict[str, float]:
        """Standard deviation of the noise of each column at the end of the horizon [SI]: `Channel.noise_deviations`."""
        grid = self.starts_ns[:, None] + np.round(np.linspace(0.0, self.time[-1], 101) * 1e9).astype(np.int64)
        step, signals = float(self.time[-1]) / 100.0, self.measured_at(grid, *INS_SIGNALS)
        return {column: value for c in self.channels
                for column, value in zip(c.columns, c.noise_deviations(self.joined_log, step, *signals), strict=True)}


def specific_force_excess(model: AugmentedModel, vehicle: VehicleParameters, states: tuple, angle: np.ndarray,
                          acceleration: np.ndarray) -> np.ndarray | float:
    """Lateral specific force minus lateral acceleration at the CG [m/s^2]. states: six arrays with the shape of the
    road wheel angle [rad] and the forward acceleration [m/s^2]."""
    # Keep only effects that act on the accelerometer, change the inputs or convert the base model.
    model = model.select_effects(e for e in model.effects
                                 if e.converts or (e in model.active_effects and (e.specific_force or e.inputs)))
    excess = compose(model.base, model.effects).specific_force
    if excess is None:
        return 0.0
    p = model.parameters(vehicle)
    extra = [np.zeros(np.shape(angle))] * len(model.extra_states)
    return excess((*states, *extra), model.inputs(angle, acceleration, p), p)[1]


def _join(runs: Sequence[DriveLog]) -> tuple[DriveLog, list[int]]:
    """(all runs as one log on the common clock, PAUSE_NS apart; offset of each run [ns])."""
    names = dict.fromkeys((*INS_SIGNALS, *(name for channel in CHANNELS.values() for name in channel.signals)))
    offsets, start = [], 0
    for run in runs:
        offsets.append(start - run.start_ns)
        start += run.end_ns - run.start_ns + PAUSE_NS
    columns: dict[str, Any] = {
        n: np.concatenate([getattr(run, n) for run in runs]) for n in (*names, "road_wheel_angle")
        if all(getattr(run, n) is not None for run in runs)}
    for n in ("ins_time_ns", "steering_time_ns"):
        columns[n] = np.concatenate([getattr(run, n) + o for run, o in zip(runs, offsets, strict=True)])
    return DriveLog(name="all runs", **columns), offsets


def _select_starts(runs: Sequence[DriveLog], offsets: Sequence[int], duration: float,
                   settings: DiscoverySettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(starts_ns, run, seconds) of `Windows`, for a window duration [s], with speeds above MIN_SPEED at both ends."""
    span_ns = round(duration / NANOSECOND)
    usable_duration = sum(max(run.overlap - duration, 0.0) for run in runs)
    interval = max(settings.interval, usable_duration / settings.windows)
    spacing = round(round(interval / (STEP / 2)) * (STEP / 2) / NANOSECOND)
    starts, numbers, seconds = [], [], []
    for i, (run, offset) in enumerate(zip(runs, offsets, strict=True)):
        if not run.overlap:
            continue
        begin, end = run.common_span_ns
        times = np.arange(begin + MARGIN_NS, end - span_ns - MARGIN_NS // 2, spacing, dtype=np.int64)
        first, last = (np.interp(t - begin, run.ins_time_ns - begin, run.velocity_x) for t in (times, times + span_ns))
        times = times[(first > MIN_SPEED) & (last > MIN_SPEED)]
        starts.append(times + offset)
        numbers.append(np.full(len(times), i))
        seconds.append((times - begin) * NANOSECOND)
    if not starts:
        raise StCoreError("no run in which both INS and steering were measured")
    return np.concatenate(starts), np.concatenate(numbers), np.concatenate(seconds)
