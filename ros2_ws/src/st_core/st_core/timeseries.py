"""Time series: samples sorted by time, interpolation except in gaps, and forward acceleration from speed.

The acceleration is the derivative of the speed u after a first-order Butterworth low-pass, solved exactly for a speed
that is linear between its samples. The actual spacing dt of the samples is used, so uneven spacing adds no noise:

    tau y_dot = u - y,   tau = 1 / (2 pi f_c)
    x = dt / tau,  e = exp(-x),  g = (1 - e) / x,   y_k = e y_{k-1} + (g - e) u_{k-1} + (1 - g) u_k
    y_dot_k = (y_k - y_{k-1}) / dt

With uniform 100 Hz sampling the results agree with scipy.signal.butter(1, 5, fs=100) within 0.2 % up to 1 Hz. The
backward difference belongs to the middle of the last interval, so slow changes are delayed by tau + dt / 2: for f_c =
5 Hz at 100 Hz, 31.8 + 5 = 37 ms. The filter restarts at the first sample and after every gap, with y = u and derivative
NaN. Source: paper, section on the models' inputs. Checked by: test_filtering.py, test_timeseries.py.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from .errors import StCoreError
from .types import wrap_angle

NANOSECOND = 1.0e-9
REORDER_WINDOW_NS = 500_000_000  # a sample that is older than the newest one by more than this is rejected as late
SETBACK_SAMPLES = 5  # number of late samples, in ascending order, after which the clock is considered set back
MAXIMUM_SAMPLES = 200_000
MIN_RECOVERED_FRACTION = 0.01  # fraction of samples that `find_ascending` must recover to use a subsequence


class TimeSeries:
    """The last `span` seconds of a signal: rows of numbers by time in integer nanoseconds.

    columns: names, in row order. An added row may be shorter; the remaining columns are NaN until the caller sets them.
    angles: columns interpolated along the shorter arc. span [s]: at least one second is kept. maximum_gap [s]: the
    signal is unknown between samples further apart. The number of samples is limited to MAXIMUM_SAMPLES.

    breaks: reason why the signal is unknown just before a sample, by sample time [ns]; set by the caller.
    """

    def __init__(self, columns: Sequence[str], span: float, maximum_gap: float, angles: Sequence[str] = ()):
        self.columns = tuple(columns)
        self.maximum_gap_ns = round(maximum_gap / NANOSECOND)
        self._span_ns = max(round(span / NANOSECOND), 2 * REORDER_WINDOW_NS)
        self._angles = [self.columns.index(name) for name in angles]
        self._late: list[tuple[int, Sequence[float]]] = []
        self.breaks: dict[int, str] = {}
        self.clear()

    def clear(self) -> None:
        """Discard all samples and breaks."""
        self._times = np.empty(256, np.int64)
        self._rows = np.empty((256, len(self.columns)))
        self._first = self._end = 0
        self._late.clear()
        self.breaks.clear()

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def times(self) -> np.ndarray:
        """Sample times [ns], increasing. A view: valid until the next `add`."""
        return self._times[self._first:self._end]

    @property
    def rows(self) -> np.ndarray:
        """Samples, (n, columns). A view: valid until the next `add`."""
        return self._rows[self._first:self._end]

    @property
    def newest(self) -> int | None:
        """Time of the newest sample [ns]; None if there is none."""
        return int(self._times[self._end - 1]) if len(self) else None

    def add(self, time_ns: int, row: Sequence[float]) -> tuple[int | None, bool]:
        """Add a sample; returns (its index in `rows`, or None if it was rejected; whether the clock was set back).

        Non-finite rows, repeated times and samples older than the newest by more than REORDER_WINDOW_NS are rejected.
        If the clock was set back, the series restarts with the SETBACK_SAMPLES late samples, and the index is 0.
        """
        if not np.isfinite(row).all():
            return None, False
        newest = self.newest
        if newest is None or time_ns > newest:
            self._late.clear()
            return self._insert(len(self), time_ns, row), False
        if newest - time_ns <= REORDER_WINDOW_NS:
            position = int(np.searchsorted(self.times, time_ns))
            return (None if self.times[position] == time_ns else self._insert(position, time_ns, row)), False
        if self._late and not 0 < time_ns - self._late[-1][0] <= REORDER_WINDOW_NS:
            self._late.clear()
        self._late.append((time_ns, tuple(row)))
        if len(self._late) < SETBACK_SAMPLES:
            return None, False
        restart = list(self._late)
        self.clear()
        for position, (time, values) in enumerate(restart):
            self._insert(position, time, values)
        return 0, True

    def _insert(self, position: int, time_ns: int, row: Sequence[float]) -> int:
        if self._end == len(self._times):
            # Move the samples to the front of the buffers, which are doubled if more than half full.
            count, times, rows = len(self), self._times, self._rows
            if 2 * count > len(times):
                times, rows = np.empty(2 * len(times), np.int64), np.empty((2 * len(times), len(self.columns)))
            times[:count], rows[:count] = self.times, self.rows
            self._times, self._rows, self._first, self._end = times, rows, 0, count
        index = self._first + position
        if index < self._end:
            self._times[index + 1:self._end + 1] = self._times[index:self._end].copy()
            self._rows[index + 1:self._end + 1] = self._rows[index:self._end].copy()
        self._times[index] = time_ns
        self._rows[index, :len(row)] = row
        self._rows[index, len(row):] = np.nan
        self._end += 1
        limit = self._times[self._end - 1] - self._span_ns
        while self._times[self._first] < limit or self._end - self._first > MAXIMUM_SAMPLES:
            self.breaks.pop(int(self._times[self._first]), None)
            self._first += 1
        return max(index - self._first, 0)

    def row_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The row at an instant, interpolated linearly; None where the signal is unknown."""
        after = int(np.searchsorted(self.times, time_ns))
        if after < len(self) and self.times[after] == time_ns:
            return tuple(self.rows[after].tolist())
        row = self.sample(np.array([time_ns]))[0]
        return None if np.isnan(row[0]) else tuple(row.tolist())

    def sample(self, times_ns: np.ndarray) -> np.ndarray:
        """Rows at many instants [ns], (n, columns), interpolated linearly; NaN where the signal is unknown."""
        times, instants = self.times, np.asarray(times_ns, np.int64)
        if not len(times):
            return np.full((len(instants), len(self.columns)), np.nan)
        before, after, exact, known, fraction = find_neighbours(times, instants, self.maximum_gap_ns)
        if self.breaks:
            known &= exact | ~np.isin(times[after], list(self.breaks))
        low, high = self.rows[before], self.rows[after]
        change = high - low
        change[:, self._angles] = wrap_angle(change[:, self._angles])
        result = np.where(exact[:, None], high, low + fraction[:, None] * change)
        result[~known] = np.nan
        return result

    def newest_known_time(self, time_ns: int) -> int | None:
        """The newest instant at or before `time_ns` at which the signal is known [ns]; None if there is none."""
        if not self.describe_unknown(time_ns):
            return int(time_ns)
        earlier = self.times[:np.searchsorted(self.times, time_ns)]
        return int(earlier[-1]) if len(earlier) else None

    def describe_unknown(self, time_ns: int) -> str:
        """Reason why the signal is unknown at an instant, such as "gap of 0.200 s"; "" if it is known."""
        times = self.times
        if not len(times):
            return "no samples"
        after = int(np.searchsorted(times, time_ns))
        if after == len(times):
            return f"ends {(time_ns - int(times[-1])) * NANOSECOND:.3f} s earlier"
        if times[after] == time_ns:
            return ""
        if after == 0:
            return f"begins {(int(times[0]) - time_ns) * NANOSECOND:.3f} s later"
        spacing_ns = int(times[after] - times[after - 1])
        gap = f"gap of {spacing_ns * NANOSECOND:.3f} s" if spacing_ns > self.maximum_gap_ns else ""
        return self.breaks.get(int(times[after])) or gap


def half_step_grid(start_ns: int, steps: int, step: float) -> np.ndarray:
    """Instants [ns] 0, step/2, step, ... [s] after a start: (2 * steps + 1,)."""
    return start_ns + np.round(np.arange(2 * steps + 1) * (0.5 * step / NANOSECOND)).astype(np.int64)


class Neighbours(NamedTuple):
    """Samples next to given instants, for interpolation."""

    before: np.ndarray  # index of the last sample before an instant
    after: np.ndarray  # index of the first sample at or after an instant
    exact: np.ndarray  # whether sample `after` is at the instant itself
    known: np.ndarray  # whether the signal is known at the instant
    fraction: np.ndarray  # position of the instant between the two samples, 0 to 1

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """A signal at the instants, interpolated linearly between its samples; NaN where it is unknown."""
        low, high = values[self.before], values[self.after]
        between = np.where(self.exact, high, low + self.fraction * (high - low))
        return np.where(self.known, between, np.nan)


def find_neighbours(times: np.ndarray, instants: np.ndarray, gap_ns: int) -> Neighbours:
    """Neighbouring samples of instants of any shape [ns].

    times [ns]: sample times, increasing, at least one. gap_ns: the signal is unknown between samples further apart.
    """
    after = np.minimum(np.searchsorted(times, instants), len(times) - 1)
    before = np.maximum(after - 1, 0)
    spacing = times[after] - times[before]
    exact = times[after] == instants
    known = exact | ((instants > times[before]) & (instants < times[after]) & (spacing <= gap_ns))
    fraction = np.where(exact, 1.0, (instants - times[before]) / np.maximum(spacing, 1))
    return Neighbours(before, after, exact, known, fraction)


def find_ascending(times: np.ndarray) -> np.ndarray:
    """Mask (n,) of strictly ascending times: the times later than all previous ones. If the longest ascending
    subsequence is longer by MIN_RECOVERED_FRACTION, as after a single time far in the future, it is used instead."""
    is_newer = np.diff(np.maximum.accumulate(times), prepend=times[:1] - 1) > 0
    if is_newer.sum() >= (1.0 - MIN_RECOVERED_FRACTION) * len(times):
        return is_newer
    # Patience sorting: for each length, the earliest last time of a subsequence so far, and the row of this time.
    last_times, last_rows, previous_rows = list[int](), list[int](), list[int]()
    for row, time in enumerate(times.tolist()):
        length = bisect_left(last_times, time)
        previous_rows.append(last_rows[length - 1] if length else -1)
        last_times[length:length + 1], last_rows[length:length + 1] = [time], [row]
    if len(last_times) <= is_newer.sum() + MIN_RECOVERED_FRACTION * len(times):
        return is_newer
    is_ascending, row = np.zeros(len(times), bool), last_rows[-1]
    while row >= 0:
        is_ascending[row], row = True, previous_rows[row]
    return is_ascending


def interpolate(time_ns: np.ndarray, values: np.ndarray, instants_ns: np.ndarray, gap_ns: int) -> np.ndarray:
    """A signal at instants of any shape [ns]; NaN where it is unknown."""
    if not len(time_ns):
        return np.full(instants_ns.shape, np.nan)
    return find_neighbours(time_ns, instants_ns, gap_ns).interpolate(values)


def low_pass_step(filtered: float, before: float, now: float, spacing: float, cutoff: float) -> tuple[float, float]:
    """(filtered value, its derivative) at the sample `now`, `spacing` [s] after the sample `before`.

    filtered: filtered value at `before`. cutoff [Hz]. Equations: see the module docstring.
    """
    x = 2.0 * math.pi * cutoff * spacing
    response = -math.expm1(-x)  # 1 - e
    g = response / x
    result = filtered + response * (before - filtered) + (1.0 - g) * (now - before)
    return result, (result - filtered) / spacing


def filtered_derivative(times_ns: np.ndarray, values: np.ndarray, cutoff: float, maximum_gap: float,
                        mode: Literal["causal", "zero_phase"] = "causal") -> tuple[np.ndarray, np.ndarray]:
    """(filtered values, derivative) of a whole log, each of the size of `values`.

    causal: the results are those of `low_pass_step` in live use. zero_phase: the filter is applied forward and backward
    between gaps, and central differences are taken; there is no delay, and the attenuation in dB is doubled.
    cutoff [Hz]. maximum_gap [s]. Raises StCoreError if times_ns [ns] is not increasing, and for an unknown mode.
    """
    times_ns, values = np.asarray(times_ns, np.int64), np.asarray(values, float)
    if np.any(np.diff(times_ns) <= 0):
        raise StCoreError("times must increase")
    filtered, derivative = _filter_causally(times_ns, values, cutoff, maximum_gap)
    if mode == "causal":
        return filtered, derivative
    if mode != "zero_phase":
        raise StCoreError(f"mode {mode!r} is neither causal nor zero_phase")
    backward, _ = _filter_causally(-times_ns[::-1], filtered[::-1], cutoff, maximum_gap)
    filtered = backward[::-1].copy()
    derivative = np.full_like(filtered, np.nan)
    seconds = (times_ns - times_ns[:1]) * NANOSECOND
    for section in np.split(np.arange(len(values)), np.flatnonzero(np.diff(seconds) > maximum_gap) + 1):
        if len(section) > 1:
            derivative[section] = np.gradient(filtered[section], seconds[section])
    return filtered, derivative


def _filter_causally(times_ns: np.ndarray, values: np.ndarray, cutoff: float,
                     maximum_gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Bit-identical results to repeated `low_pass_step`, vectorised except for the recursion."""
    spacings_ns = np.diff(times_ns)
    distinct_ns, spacing_index = np.unique(spacings_ns, return_inverse=True)
    x = 2.0 * math.pi * cutoff * (distinct_ns * NANOSECOND)
    responses = np.array([-math.expm1(-value) for value in x.tolist()])
    increments = (1.0 - responses / x)[spacing_index] * (values[1:] - values[:-1])
    after_gap = spacings_ns * NANOSECOND > maximum_gap
    results = values[:1].tolist()
    columns = responses[spacing_index], values[:-1], increments, values[1:], after_gap
    for response, before, increment, now, restarts in zip(*(column.tolist() for column in columns), strict=True):
        last = results[-1]
        results.append(now if restarts else last + response * (before - last) + increment)
    filtered = np.array(results, float)
    derivative = np.full(len(values), np.nan)
    derivative[1:] = np.where(after_gap, np.nan, (filtered[1:] - filtered[:-1]) / (spacings_ns * NANOSECOND))
    return filtered, derivative


def moving_average(time_ns: np.ndarray, values: np.ndarray, width_ns: int) -> np.ndarray:
    """Mean of the samples within a window of `width_ns` about each sample; at the ends the window is truncated."""
    total = np.concatenate(([0.0], np.cumsum(values)))
    low, high = _averaging_windows(time_ns, width_ns)
    return (total[high] - total[low]) / (high - low)


def moving_average_noise_ratio(time_ns: np.ndarray, width_ns: int) -> float:
    """Factor by which `moving_average` reduces the standard deviation of white noise: sqrt(mean(1 / sample count))."""
    low, high = _averaging_windows(time_ns, width_ns)
    return float(np.sqrt(np.mean(1.0 / (high - low)))) if len(time_ns) else 1.0


def _averaging_windows(time_ns: np.ndarray, width_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(index of the first sample, index after the last) of the window about each sample."""
    return (np.searchsorted(time_ns, time_ns - width_ns // 2),
            np.searchsorted(time_ns, time_ns + width_ns // 2, side="right"))
