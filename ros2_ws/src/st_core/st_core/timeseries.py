"""One signal in time: samples kept in order of their own time, interpolated, never across a gap."""

from collections.abc import Sequence

import numpy as np

from .filtering import NANOSECOND
from .frames import wrap_angle

# A sample this much older than the newest is put in its place; an older one is late and dropped ...
REORDER_WINDOW_NS = 500_000_000
# ... unless so many in a row are that old: then time itself has jumped back and they are the new beginning.
JUMP_SAMPLES = 5
MAXIMUM_SAMPLES = 200_000


class TimeSeries:
    """Rows of numbers by time in integer nanoseconds, the last `span` seconds of them.

    columns: names, in row order; a row may be shorter, the rest is NaN until filled in by the owner. angles: columns
    interpolated the short way round. span [s]: at least one second is kept. maximum_gap [s]. Memory is bounded by
    the span, and by MAXIMUM_SAMPLES whatever the rate.

    breaks: samples (by time [ns]) up to which nothing is known since the one before, as after a gap, and why; filled in
    by the owner.
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
        """Forget all samples."""
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
        """Time of the newest sample [ns]."""
        return int(self._times[self._end - 1]) if len(self) else None

    def add(self, time_ns: int, row: Sequence[float]) -> tuple[int | None, bool]:
        """Take a sample. Returns (its position in `rows` or None if it was refused, whether time jumped back).

        After a jump the series has only the samples after it and the position is 0.
        """
        if not np.isfinite(row).all():
            return None, False
        newest = self.newest
        if newest is not None and time_ns <= newest:
            return self._add_old(newest, time_ns, row)
        self._late.clear()
        return self._insert(len(self), time_ns, row), False

    def _add_old(self, newest: int, time_ns: int, row: Sequence[float]) -> tuple[int | None, bool]:
        if newest - time_ns > REORDER_WINDOW_NS:
            return self._add_late(time_ns, row)
        position = int(np.searchsorted(self.times, time_ns))
        if self.times[position] == time_ns:
            return None, False
        return self._insert(position, time_ns, row), False

    def _add_late(self, time_ns: int, row: Sequence[float]) -> tuple[int | None, bool]:
        if self._late and not 0 < time_ns - self._late[-1][0] <= REORDER_WINDOW_NS:
            self._late.clear()
        self._late.append((time_ns, tuple(row)))
        if len(self._late) < JUMP_SAMPLES:
            return None, False
        restart = list(self._late)
        self.clear()
        for number, (time, values) in enumerate(restart):
            self._insert(number, time, values)
        return 0, True

    def _insert(self, position: int, time_ns: int, row: Sequence[float]) -> int:
        if self._end == len(self._times):
            self._make_room()
        at = self._first + position
        if at < self._end:
            self._times[at + 1:self._end + 1] = self._times[at:self._end].copy()
            self._rows[at + 1:self._end + 1] = self._rows[at:self._end].copy()
        self._times[at] = time_ns
        self._rows[at, :len(row)] = row
        self._rows[at, len(row):] = np.nan
        self._end += 1
        before = self._first
        self._trim()
        return max(position - (self._first - before), 0)

    def _trim(self) -> None:
        limit = self._times[self._end - 1] - self._span_ns
        while self._times[self._first] < limit or self._end - self._first > MAXIMUM_SAMPLES:
            self.breaks.pop(int(self._times[self._first]), None)
            self._first += 1

    def _make_room(self) -> None:
        # Moved to the front where that frees half the room: a long run needs no more memory. Else twice the room.
        count = len(self)
        times, rows = self._times, self._rows
        if 2 * count > len(times):
            times, rows = np.empty(2 * len(times), np.int64), np.empty((2 * len(times), len(self.columns)))
        times[:count], rows[:count] = self.times, self.rows
        self._times, self._rows, self._first, self._end = times, rows, 0, count

    def at(self, time_ns: int) -> tuple[float, ...] | None:
        """The row at an instant, interpolated linearly; None where it is not known."""
        times = self.times
        after = int(np.searchsorted(times, time_ns))
        if after == len(times):
            return None
        if times[after] == time_ns:
            return tuple(self.rows[after].tolist())
        if not self._joined(after):
            return None
        rows = self.rows[after - 1:after + 1]
        fraction = (time_ns - int(times[after - 1])) / int(times[after] - times[after - 1])
        change = rows[1] - rows[0]
        change[self._angles] = wrap_angle(change[self._angles])
        return tuple((rows[0] + fraction * change).tolist())

    def _joined(self, position: int) -> bool:
        """Whether the signal is known between the sample there and the one before it."""
        if position == 0 or self._times[self._first + position] in self.breaks:
            return False
        return bool(self.times[position] - self.times[position - 1] <= self.maximum_gap_ns)

    def sample(self, times_ns: np.ndarray) -> np.ndarray:
        """Rows at many instants, (n, columns); NaN where not known. The same numbers as `at`."""
        times, instants = self.times, np.asarray(times_ns, np.int64)
        if not len(times):
            return np.full((len(instants), len(self.columns)), np.nan)
        before, after, exact, known, fraction = between(times, instants, self.maximum_gap_ns)
        if self.breaks:
            known &= exact | ~np.isin(times[after], list(self.breaks))
        low, high = self.rows[before], self.rows[after]
        change = high - low
        change[:, self._angles] = wrap_angle(change[:, self._angles])
        result = np.where(exact[:, None], high, low + fraction[:, None] * change)
        result[~known] = np.nan
        return result

    def known_until(self, time_ns: int) -> int | None:
        """The newest instant at or before `time_ns` at which the signal is known [ns]; None if there is none."""
        times = self.times
        after = int(np.searchsorted(times, time_ns))
        if after < len(times) and (times[after] == time_ns or self._joined(after)):
            return int(time_ns)
        return int(times[after - 1]) if after > 0 else None

    def why_unknown(self, time_ns: int) -> str:
        """Reason for an unknown value at an instant, naming the samples around it."""
        times = self.times
        if not len(times):
            return "no samples"
        after = int(np.searchsorted(times, time_ns))
        if after == len(times):
            return f"ends {(time_ns - int(times[-1])) * NANOSECOND:.3f} s before"
        if after == 0 and times[0] != time_ns:
            return f"begins {(int(times[0]) - time_ns) * NANOSECOND:.3f} s after"
        if reason := self.breaks.get(int(times[after])):
            return reason
        return f"gap of {int(times[after] - times[after - 1]) * NANOSECOND:.3f} s"


def half_step_grid(start_ns: int, steps: int, step: float) -> np.ndarray:
    """Instants [ns] 0, step/2, step, ... after a start: (2 * steps + 1,)."""
    return start_ns + np.round(np.arange(2 * steps + 1) * (0.5 * step / NANOSECOND)).astype(np.int64)


def between(times: np.ndarray, instants: np.ndarray, gap_ns: int) -> tuple[np.ndarray, ...]:
    """(sample before, after, whether it is just that of `after`, whether it is known, share of the way there).

    times [ns]: rising, at least one. instants [ns]: of any shape. gap_ns: unknown between samples further apart.
    """
    after = np.minimum(np.searchsorted(times, instants), len(times) - 1)
    before = np.maximum(after - 1, 0)
    spacing = times[after] - times[before]
    exact = times[after] == instants
    known = exact | ((instants > times[before]) & (instants < times[after]) & (spacing <= gap_ns))
    return before, after, exact, known, np.where(exact, 1.0, (instants - times[before]) / np.maximum(spacing, 1))


def interpolate(time_ns: np.ndarray, values: np.ndarray, instants_ns: np.ndarray, gap_ns: int) -> np.ndarray:
    """A signal at given instants; NaN where not known."""
    if not len(time_ns):
        return np.full(len(instants_ns), np.nan)
    return at(values, *between(time_ns, instants_ns, gap_ns))


def at(values: np.ndarray, before: np.ndarray, after: np.ndarray, exact: np.ndarray, known: np.ndarray,
       fraction: np.ndarray) -> np.ndarray:
    """A signal interpolated with the weights of `between`."""
    low, high = values[before], values[after]
    return np.where(known, np.where(exact, high, low + fraction * (high - low)), np.nan)
