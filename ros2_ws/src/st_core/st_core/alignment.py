"""Recent measurements: INS and steering on one time axis, with the filtered forward acceleration."""

import math
from typing import NamedTuple

from . import position_jumps
from .filtering import NANOSECOND, advance
from .timeseries import TimeSeries
from .types import ControlInput, InsSample

INS_COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "filtered_velocity_x", "velocity_x_dot")
YAW, VELOCITY_X, YAW_RATE, FILTERED, DERIVATIVE = 2, 3, 5, 6, 7


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
    jumps (position_jumps.py): `jumps` counts that since the start, `jump` is the newest one.

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
        size = position_jumps.excess((times[1] - times[0]) * NANOSECOND, *rows)
        if not size:
            return 0.0
        before = slice(max(0, after - 1 - position_jumps.NOISE_STEPS), after)
        usual = self.ins.times[before].tolist(), self.ins.rows[before].tolist()
        return size if position_jumps.exceeds_noise(size, *usual) else 0.0

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
