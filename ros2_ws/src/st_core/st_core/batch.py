"""Simultaneous predictions from many starts of a recorded drive, with states at selected points of the horizon.

The results equal those of `prediction.predict` with the inputs of the log, for any backend. Starts are computed in
blocks. In addition to the result, memory holds the tables of one block and the two inputs of the log on the grid: 16
bytes per half step, or 32 for a model that corrects the measurements.

Horizons of 5 s that start every 0.1 s overlap fifty-fold. If the starts are multiples of half an integration step
apart, they share the instants of one grid: with q half steps between starts, instant number index * q + phase is stored
at [phase, index]. Neighbouring starts are then adjacent in memory at every instant, and nothing is copied. Starts at
other times have separate instants in the same layout.
"""

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from . import integrate
from .backends import get_backend
from .errors import ConfigurationError
from .log import DriveLog, LogSignals, shares_memory
from .models import Model, get_model
from .planned_inputs import SLIP_FREE_ANGLE
from .prediction import step_count
from .readings import correct_log, predict_wheel_angles, reading_errors
from .timeseries import NANOSECOND, half_step_grid
from .types import STATE_NAMES
from .vehicle import VehicleParameters

MAX_BLOCK_COLUMNS = 8192  # with 4 half steps between starts, 33 000 instants
MAX_BLOCK_INSTANTS = 2**17


@dataclass(frozen=True, eq=False)
class GridBlock:
    """Columns of a batch that are computed together."""

    number: int
    rows: slice  # starts in the block
    start_columns: np.ndarray  # (starts,), column of each start
    starts_ns: np.ndarray  # (count,), start time of each column
    times_ns: np.ndarray  # instants to sample (m,), in the order of the table
    offsets: np.ndarray  # instant k of the horizon of column i is element `offsets[k] + i` of a row of the table
    columns: int  # count, rounded up to a multiple of the lanes
    spacing: int  # instants stored for each column of the table
    is_shared: bool  # whether the starts share instants

    @property
    def count(self) -> int:
        return len(self.starts_ns)

    def tabulate(self, fields: tuple) -> np.ndarray:
        """Table (fields, m) of quantities, each of them an array (m,) or a number."""
        result = np.empty((len(fields), self.times_ns.size))
        for row, values in zip(result, fields, strict=True):
            row[:] = values
        return result


def plan_blocks(starts_ns: np.ndarray, instants_ns: np.ndarray, lanes: int, shared: bool = True) -> Iterator[GridBlock]:
    """Blocks that cover all starts. starts_ns: increasing [ns]. instants_ns: times after each start, from 0 on [ns].

    lanes: columns that the kernel computes at once. shared: False if the values at an instant depend on the start.
    """
    if not len(starts_ns):
        return
    count, between = len(instants_ns), np.diff(starts_ns)
    half = int(instants_ns[1]) if count > 1 else 1
    is_apart = between >= half * count  # the horizon ends before the next start
    spacing = int(np.gcd.reduce(between[~is_apart] // half)) or count
    tail = (count - 1) // spacing  # columns into which the horizon of a start extends
    column = np.concatenate(([0], np.cumsum(np.where(is_apart, tail + 1, between // (half * spacing)))))
    is_on_grid = np.array_equal(instants_ns, half * np.arange(count)) and not np.any(between[~is_apart] % half)
    width = column[-1] + 1 + tail * (column[-1] // MAX_BLOCK_COLUMNS + 1)  # columns of all tables, each with a tail
    is_shared = bool(shared and is_on_grid and width <= 2 * len(starts_ns) + lanes)
    if not is_shared:
        spacing, tail, column = count, 0, np.arange(len(starts_ns))
    size = _round_up(max(min(MAX_BLOCK_INSTANTS // spacing, MAX_BLOCK_COLUMNS), 1), lanes)
    k = np.arange(count)
    for number, rows in enumerate(np.split(np.arange(len(column)), np.flatnonzero(np.diff(column // size)) + 1)):
        first, last = int(column[rows[0]]), int(column[rows[-1]])
        columns = _round_up(last + 1 - first, lanes)
        table_columns = np.minimum(np.arange(first, first + columns + tail), last + tail)
        start = rows[np.searchsorted(column[rows], table_columns, side="right") - 1]
        times = starts_ns[start] + half * spacing * (table_columns - column[start])
        yield GridBlock(number, slice(int(rows[0]), int(rows[-1]) + 1), column[rows] - first, times[:last + 1 - first],
                        (instants_ns[:spacing, None] + times).ravel(),
                        (k % spacing) * len(times) + k // spacing, columns, spacing, is_shared)


def _round_up(count: int, lanes: int) -> int:
    return -(-count // lanes) * lanes


Inputs = Literal["measured", "held"] | tuple[np.ndarray, ...]
Signals = Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Recording:
    """Signals of a drive, as recorded or corrected by a model."""

    signals: LogSignals
    sample_cache: dict[Hashable, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Cache of road wheel angle and velocity_x_dot at the instants of a block, by its number and spacing."""


class LogBatch:
    """Predictions from many starts in one drive, with any models, cars and parameters; inputs are sampled only once.

    log: a drive, or its LogSignals for settings other than the default. starts_ns: any instants [ns]. Starts that are
    multiples of half an integration step apart are predicted fastest, because they share all quantities that depend
    only on inputs. horizon, step [s].
    inputs: measured = inputs of the log over the horizon (hindsight); held = inputs at the start; or planned road wheel
    angles [rad], velocity_x_dot [m/s^2] and, if a path was planned, slip-free angles [rad], each (n, 2 * steps + 1) on
    the half-step grid.
    points [s]: times in the horizon, multiples of step; None: 0, step, ... horizon. substeps: integration steps per
    step; auto = the smallest stable number <= 64 at the lowest and highest speed. Warns once for an unstable number.
    backend: lanes or numpy; None: the fastest available. signals: (time [ns], values), by name, of the signals that a
    model needs in addition to its inputs; their values at the start are held, unless inputs = measured.
    Raises ConfigurationError for a horizon or points that are not whole numbers of steps, a missing signal, invalid
    inputs or substeps, and an unknown backend. Checked by: test_batch.py, against Evaluator and `predict`.
    """

    def __init__(self, log: DriveLog | LogSignals, starts_ns: np.ndarray, horizon: float = 5.0, step: float = 0.05, *,
                 inputs: Inputs = "measured", points: Sequence[float] | None = None,
                 substeps: int | Literal["auto"] = 1, backend: str | None = None, signals: Signals | None = None):
        if isinstance(inputs, str) and inputs not in ("measured", "held"):
            raise ConfigurationError(f"inputs: {inputs!r} is neither measured nor held")
        if substeps != "auto" and (not isinstance(substeps, int) or not 1 <= substeps <= integrate.MAX_SUBSTEPS):
            raise ConfigurationError(f"substeps: {substeps!r} is neither auto nor an integer from 1 to "
                                     f"{integrate.MAX_SUBSTEPS}")
        self._backend = get_backend(backend)
        self.signals = log if isinstance(log, LogSignals) else LogSignals(log)
        self.starts_ns = np.asarray(starts_ns, np.int64).ravel()
        self.step, self.steps = step, step_count(horizon, step)
        self.points = np.arange(self.steps + 1) if points is None else self._find_point_numbers(points)
        self._inputs, self._substeps, self.extra_signals = inputs, substeps, dict(signals or {})
        self._unique_starts, first, self._inverse = np.unique(self.starts_ns, return_index=True, return_inverse=True)
        if not isinstance(inputs, str):
            expected = len(self.starts_ns), 2 * self.steps + 1
            for name, values in zip(("road_wheel_angle", "velocity_x_dot", SLIP_FREE_ANGLE), inputs, strict=False):
                if values.shape != expected:
                    raise ConfigurationError(f"planned {name}: shape {values.shape}, not {expected}")
            if substeps != 1:
                raise ConfigurationError("substeps: planned inputs are on the half-step grid; use substeps=1")
            self._planned_inputs = tuple(values[first] for values in inputs)
        ins_time, speeds = self.signals.log.ins_time_ns, np.zeros(0)
        if len(self._unique_starts):
            ends = int(self._unique_starts[0]), int(self._unique_starts[-1]) + round(self.steps * step / NANOSECOND)
            speeds = np.abs(self.signals.log.velocity_x[slice(*np.searchsorted(ins_time, ends))])
        self._speeds = (float(speeds.min()), float(speeds.max())) if len(speeds) else ()
        self._uncorrected = Recording(self.signals)
        self._blocks: dict[tuple[int, bool], list[GridBlock]] = {}

    def _find_point_numbers(self, points: Sequence[float]) -> np.ndarray:
        requested = np.asarray(points, float).ravel()
        numbers = np.round(requested / self.step).astype(np.int64)
        is_on_grid = np.abs(numbers * self.step - requested) <= 1.0e-9
        is_later = np.diff(numbers, prepend=-1) > 0
        if not (len(numbers) and is_on_grid.all() and is_later.all() and numbers[-1] <= self.steps):
            raise ConfigurationError(f"points: {list(points)} are not increasing multiples of {self.step:g} s within "
                                     f"the horizon of {self.steps * self.step:g} s")
        return numbers

    def predict(self, model: str | Model, vehicle: VehicleParameters) -> np.ndarray:
        """States of one model at the CG, (n, k, 6), for n starts and k points of the horizon; last axis: STATE_NAMES.

        NaN from the first unknown input on, and at all points if the measured state at the start is unknown.
        """
        model = get_model(model)
        for name in model.signals:
            if name not in self.extra_signals:
                raise ConfigurationError(f"model {model.name} needs the signal {name}, which was not given")
        count = self._count_substeps(model, vehicle)
        car, p = model.effective_vehicle(vehicle), model.parameters(vehicle)
        recording = self.recording(model)
        is_separate = not isinstance(self._inputs, str) or (self._inputs == "held" and model.has_steering_dynamics)
        signals = recording.signals
        result = np.full((len(self.points), len(STATE_NAMES), len(self._unique_starts)), np.nan)
        for block in self._plan_blocks(count, is_separate):
            values = (self._sample_separately(block, signals, model) if is_separate else
                      self._sample(block, recording, model))
            start_states = signals.states_at(block.starts_ns, car).T
            result[:, :, block.rows] = self._advance(block, values, start_states, model, p, count)
        states = result if np.array_equal(self._unique_starts, self.starts_ns) else result[:, :, self._inverse]
        return states.transpose(2, 0, 1)

    def errors(self, model: str | Model, vehicle: VehicleParameters) -> np.ndarray:
        """Errors of `predict`, (n, k, 3): longitudinal, lateral [m], yaw [rad]; predicted minus measured INS point."""
        model = get_model(model)
        after_ns = np.round(self.points * (self.step / NANOSECOND)).astype(np.int64)
        measured = self.signals.ins_at(self.starts_ns[:, None] + after_ns, "x", "y", "yaw")
        return reading_errors(model, vehicle, self.predict(model, vehicle), *measured)

    def _count_substeps(self, model: Model, vehicle: VehicleParameters) -> int:
        """Number of substeps; `discovery.windows.Batch` overrides this without a check of stability."""
        if self._substeps == "auto":
            return integrate.required_substeps(model, vehicle, self._speeds, self.step)
        integrate.warn_if_step_too_long(model, vehicle, self._speeds, self.step / self._substeps)
        return self._substeps

    def _plan_blocks(self, count: int, is_separate: bool) -> Iterable[GridBlock]:
        """Blocks of all starts; stored for up to MAX_BLOCK_COLUMNS starts, as separate instants need much memory."""
        key = count, is_separate
        if key not in self._blocks:
            # Held inputs are required only at the start, unless earlier steering still affects the wheels.
            only_start = self._inputs == "held" and not is_separate
            instants = np.zeros(1, np.int64) if only_start else half_step_grid(0, self.steps * count, self.step / count)
            blocks = plan_blocks(self._unique_starts, instants, self._backend.LANES, not is_separate)
            if len(self._unique_starts) > MAX_BLOCK_COLUMNS:
                return blocks
            self._blocks[key] = list(blocks)
        return self._blocks[key]

    def recording(self, model: Model) -> Recording:
        """The drive with the sensor and steering corrections of the model applied."""
        log = correct_log(model, self.signals.log, self.signals.maximum_gap)
        return self._uncorrected if log is self.signals.log else Recording(self.signals.for_log(log))

    def _sample(self, block: GridBlock, recording: Recording, model: Model) -> list[np.ndarray]:
        """Road wheel angle, velocity_x_dot and the signals of the model at all instants of a block."""
        key, signals, times_ns = (block.number, block.spacing), recording.signals, block.times_ns
        if key in recording.sample_cache:
            angle, acceleration = recording.sample_cache[key]
        else:
            # Inputs that the model does not correct are those of the recorded drive.
            recorded = self._uncorrected.sample_cache.get(key)
            if recorded and shares_memory(signals.log, self.signals.log, "steering_time_ns", "road_wheel_angle"):
                angle = recorded[0]
            else:
                angle = signals.road_wheel_angle_at(times_ns)
            if recorded and signals.velocity_x_dot is self.signals.velocity_x_dot:
                acceleration = recorded[1]
            else:
                acceleration, = signals.ins_at(times_ns, "velocity_x_dot")
        if block.is_shared:
            recording.sample_cache[key] = angle, acceleration
        return [angle, acceleration, *(signals.sample(*self.extra_signals[name], times_ns) for name in model.signals)]

    def _sample_separately(self, block: GridBlock, signals: LogSignals, model: Model) -> list[np.ndarray]:
        """Like `_sample`, for planned inputs, and for held inputs of a model with steering dynamics."""
        times, log = block.times_ns.reshape(block.spacing, -1), self.signals.log
        if isinstance(self._inputs, str):
            angle = self.signals.road_wheel_angle_at(times[0])
            acceleration, = signals.ins_at(times[0], "velocity_x_dot")
        else:
            padding = (0, 0), (0, block.columns - block.count)
            angle, acceleration, *path = (np.pad(v[block.rows].T, padding, mode="edge") for v in self._planned_inputs)
            if path and not model.has_tyres:
                angle = path[0]  # slip-free
        angle, acceleration = (np.broadcast_to(v, times.shape) for v in (angle, acceleration))
        if model.has_steering_dynamics:
            angle = np.array([predict_wheel_angles(model, log.steering_time_ns, log.road_wheel_angle, *column,
                                                   signals.maximum_gap)
                              for column in zip(times.T, angle.T, strict=True)]).T
        extra = [np.broadcast_to(signals.sample(*self.extra_signals[name], times[0]), times.shape)
                 for name in model.signals]
        return [v.ravel() for v in (angle, acceleration, *extra)]

    def _advance(self, block: GridBlock, values: list[np.ndarray], states: np.ndarray, model: Model, p: Any,
                 substeps: int) -> np.ndarray:
        with np.errstate(all="ignore"):
            w = block.tabulate(model.inputs(*values[:2], p, *values[2:]))  # depends only on inputs
            start = model.start_state(tuple(states), tuple(w[:, block.offsets[0]:block.offsets[0] + block.count]), p)
        columns = np.full((len(start), block.columns), np.nan)
        columns[:, :block.count] = np.broadcast_arrays(*start)
        offsets = block.offsets if len(block.offsets) > 1 else np.zeros(2 * self.steps * substeps + 1, np.int64)
        out = self._backend.advance(model, p, columns, w, offsets, self.step / substeps, self.points * substeps)
        return out[:, :, :block.count] if len(block.start_columns) == block.count else out[:, :, block.start_columns]
