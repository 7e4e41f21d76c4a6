"""Recent measurements: INS and steering on one time axis, with the filtered forward acceleration.

Jumps of the position are displacements between two samples that integrated velocity does not explain:

    d = p_k - p_{k-1} - dt (v_{k-1} + v_k) / 2,   v = R(yaw) (v_x, v_y)

RTK lost and found again, another unit on the network, a new origin: |d| is then a step, while noise and the error
of the trapezoid rule stay within `allowed`. Checked by: test_alignment.py, test_position_jumps.py.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from .filtering import NANOSECOND, advance
from .timeseries import TimeSeries
from .types import ControlInput, InsSample

# Positions with RTK have 2 cm of noise, those of an INS far less from sample to sample; a larger step is not noise [m].
LEAST = 0.3
# Share of the distance driven: scale of the velocity, a heading error.
SHARE = 0.1
# Largest acceleration on tyres [m/s^2]: bounds the error of the trapezoid rule over longer steps.
ACCELERATION = 10.0
# Longer gaps are not judged, since the car may be anywhere [s].
LONGEST = 10.0
# Positions may be noisier than RTK's: a jump exceeds NOISE_FACTOR times the median of the previous steps, at most and
# at least of this many, ...
NOISE_STEPS, FEWEST_STEPS, NOISE_FACTOR = 20, 5, 6.0
# ... or is larger than any noise [m].
NO_NOISE = 5.0

X, Y, YAW, VELOCITY_X, VELOCITY_Y, YAW_RATE, FILTERED, DERIVATIVE = range(8)  # places in a row of INS_COLUMNS


def excess(spacing: float, before: Sequence[float], after: Sequence[float]) -> float:
    """|d| [m] where it is more than allowed, else 0. spacing: dt [s], > 0. Rows begin with x, y, yaw, v_x, v_y."""
    size, driven = _step(spacing, before, after)
    allowed = LEAST + SHARE * driven + 0.25 * ACCELERATION * spacing**2
    return size if size > allowed and spacing <= LONGEST else 0.0


def exceeds_noise(size: float, times_ns: Sequence[int], rows: Sequence[Sequence[float]]) -> bool:
    """Whether a step of `size` [m] is larger than the noise of the samples before it; the last is where it started."""
    if size > NO_NOISE:
        return True
    if len(times_ns) <= FEWEST_STEPS:
        return False
    usual = sorted(_step((times_ns[i] - times_ns[i - 1]) * NANOSECOND, rows[i - 1], rows[i])[0]
                   for i in range(max(1, len(times_ns) - NOISE_STEPS), len(times_ns)))
    return size > NOISE_FACTOR * usual[len(usual) // 2]


def _step(spacing: float, before: Sequence[float], after: Sequence[float]) -> tuple[float, float]:
    """(|d|, way driven) [m]."""
    east = north = 0.0
    for row in (before, after):
        cosine, sine = math.cos(row[YAW]), math.sin(row[YAW])
        east += 0.5 * spacing * (cosine * row[VELOCITY_X] - sine * row[VELOCITY_Y])
        north += 0.5 * spacing * (sine * row[VELOCITY_X] + cosine * row[VELOCITY_Y])
    return math.hypot(after[X] - before[X] - east, after[Y] - before[Y] - north), math.hypot(east, north)


INS_COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "filtered_velocity_x", "velocity_x_dot")


class PositionJump(NamedTuple):
    """time_ns: of the first sample after it. size: position change not explained by velocity [m]."""

    time_ns: int
    size: float


class MeasurementHistory:
    """Time-ordered INS and steering samples of the last `span` seconds.

    Samples that come out of order are put in their place; late ones (over half a second), repeated ones and those with
    a NaN are refused. Whatever the order of arrival within half a second, the content is the same, the filtered
    acceleration included. When the INS time jumps back (a replay that starts over) both signals restart;
    `generation` counts that. Between samples further apart than maximum_gap nothing is known, nor where the position
    jumps (see the module): `jumps` counts that since the start, `jump` is the newest one.

    span, maximum_gap [s]; filter_cutoff [Hz], see filtering.py for the definition and delay of velocity_x_dot.
    """

    def __init__(self, span: float, maximum_gap: float, filter_cutoff: float):
        self._settings = span, maximum_gap, filter_cutoff
        self._cutoff = filter_cutoff
        self.ins = TimeSeries(INS_COLUMNS, span, maximum_gap, angles=("yaw",))
        self.steering = TimeSeries(("road_wheel_angle",), span, maximum_gap)
        self.generation = 0
        self.jumps = 0
        self.jump: PositionJump | None = None
        self._judges = True

    def like(self) -> "MeasurementHistory":
        """An empty history with the same settings, for the same samples corrected: positions jump where they do here,
        so that both know the same instants."""
        other = MeasurementHistory(*self._settings)
        other.ins.breaks, other._judges = self.ins.breaks, False
        return other

    def add_ins(self, sample: InsSample) -> bool:
        """Take an INS sample (INS point, see InsSample). False if it was refused."""
        position, jumped = self.ins.add(sample.time_ns, sample[1:])
        if jumped:
            self.steering.clear()
            self.jump = None
            self.generation += 1
        if position is None:
            return False
        self._filter_from(position)
        if self._judges:
            self._look_for_jumps(position)
        return True

    def _look_for_jumps(self, position: int) -> None:
        # A late sample has two neighbours, and may be the one that a jump led to.
        for after in range(max(position, 1), min(position + 2, len(self.ins))):
            size = self._jump_before(after)
            time_ns = int(self.ins.times[after])
            known = self.ins.breaks.pop(time_ns, None)
            if size:
                self.ins.breaks[time_ns] = f"position jumps by {size:.2f} m"
                self.jump = PositionJump(time_ns, size)
            self.jumps += bool(size) - bool(known)

    def _jump_before(self, after: int) -> float:
        """What the position jumps by between a sample and the one before it [m]; 0 where it does not."""
        times, rows = self.ins.times[after - 1:after + 1].tolist(), self.ins.rows[after - 1:after + 1].tolist()
        size = excess((times[1] - times[0]) * NANOSECOND, *rows)
        if not size:
            return 0.0
        before = slice(max(0, after - 1 - NOISE_STEPS), after)
        usual = self.ins.times[before].tolist(), self.ins.rows[before].tolist()
        return size if exceeds_noise(size, *usual) else 0.0

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> bool:
        """Take a road wheel angle [rad], left +, measured at time_ns. False if it was refused."""
        position, _ = self.steering.add(time_ns, (road_wheel_angle,))
        return position is not None

    def _filter_from(self, position: int) -> None:
        # One pass in the usual case of the newest sample; a late one changes all after it.
        times, rows = self.ins.times, self.ins.rows
        if position == 0:
            rows[0, FILTERED], rows[0, DERIVATIVE] = rows[0, VELOCITY_X], math.nan
            position = 1
        for i in range(position, len(times)):
            spacing_ns = int(times[i] - times[i - 1])
            now = float(rows[i, VELOCITY_X])
            if spacing_ns > self.ins.maximum_gap_ns:
                rows[i, FILTERED], rows[i, DERIVATIVE] = now, math.nan
            else:
                filtered, before = float(rows[i - 1, FILTERED]), float(rows[i - 1, VELOCITY_X])
                spacing = spacing_ns * NANOSECOND
                rows[i, FILTERED], rows[i, DERIVATIVE] = advance(filtered, before, now, spacing, self._cutoff)

    def ins_at(self, time_ns: int) -> InsSample | None:
        """The INS sample at an instant, interpolated; None where not known."""
        row = self.ins.at(time_ns)
        return None if row is None else InsSample(time_ns, *row[:6])

    def inputs_at(self, time_ns: int) -> ControlInput | None:
        """Both inputs at an instant, interpolated; None where one is not known."""
        ins, steering = self.ins.at(time_ns), self.steering.at(time_ns)
        if ins is None or steering is None or math.isnan(ins[DERIVATIVE]):
            return None
        return ControlInput(steering[0], ins[DERIVATIVE])
