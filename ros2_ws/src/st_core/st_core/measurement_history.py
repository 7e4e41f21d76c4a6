"""Stores recent INS and steering measurements with filtered forward acceleration, and detects faults in them.

Position jump, for example after loss of RTK or with a new map origin: a large displacement d between two samples that
the integrated velocity does not explain,

    d = p_k - p_{k-1} - dt (v_{k-1} + v_k) / 2,   v = R(yaw) (v_x, v_y)

Frozen steering angle: the sensor repeats one value while the yaw motion changes. The steady-state steering angle

    delta' = l (1 + K v^2) r / v,   r: yaw rate, v: forward speed, see `handling.steady_state_steering`

is nearly constant after a low-pass, at any speed, if the wheels are held at a constant angle. The limits are wide
because bank, wind, braking and tyres at their limit also change delta'. Checked by: test_measurement_history.py,
test_position_jumps.py, test_frozen_steering.py.
"""

import math
from collections.abc import Callable, Sequence
from statistics import median_high
from typing import NamedTuple

from .handling import steady_state_steering
from .timeseries import NANOSECOND, TimeSeries, low_pass_step
from .types import ControlInput, InsSample
from .vehicle import VehicleParameters

POSITION_TOLERANCE = 0.3  # m, unexplained displacement allowed at any distance; RTK positions have 2 cm of noise
DISTANCE_TOLERANCE = 0.1  # fraction of the distance driven, added for errors of velocity scale and heading
MAX_ACCELERATION = 10.0  # m/s^2, limit of the tyres; bounds the error of the trapezoidal rule over long steps
MAX_EXAMINED_GAP = 10.0  # s; jumps in longer gaps are not detected, because the motion is unknown
# For positions noisier than RTK, |d| of a jump must also exceed MAX_NOISE [m], or NOISE_FACTOR times the median |d| of
# the previous NOISE_STEPS steps, of which there must be at least MIN_NOISE_STEPS.
NOISE_STEPS, MIN_NOISE_STEPS, NOISE_FACTOR = 20, 5, 6.0
MAX_NOISE = 5.0

# A constant steering angle is frozen if the range of delta' exceeds FROZEN_MIN_VARIATION [rad], about 20 deg at the
# steering wheel, plus FROZEN_RELATIVE_VARIATION times the magnitude of the angle.
FROZEN_MIN_VARIATION, FROZEN_RELATIVE_VARIATION = 0.02, 0.3
FROZEN_MIN_SPEED = 3.0  # m/s; below it the noise of the yaw rate gives large angles
FROZEN_TIME_CONSTANT = 0.2  # s, of the low-pass on delta'
ANGLE_RESOLUTION = 1.0e-9  # rad; a smaller change of the steering angle is rounding

INS_COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "filtered_velocity_x", "velocity_x_dot")
X, Y, YAW, VELOCITY_X, VELOCITY_Y, YAW_RATE, FILTERED_VELOCITY, DERIVATIVE = range(8)


def unexplained_displacement(spacing: float, before: Sequence[float], after: Sequence[float]) -> float:
    """|d| between two samples [m]; 0 within the tolerance, and over a gap longer than MAX_EXAMINED_GAP.

    d: see the module docstring. spacing: dt [s], > 0. before, after: rows that begin with x, y, yaw, v_x, v_y.
    """
    unexplained, distance = _split_displacement(spacing, before, after)
    tolerance = POSITION_TOLERANCE + DISTANCE_TOLERANCE * distance + 0.25 * MAX_ACCELERATION * spacing**2
    return unexplained if unexplained > tolerance and spacing <= MAX_EXAMINED_GAP else 0.0


def _split_displacement(spacing: float, before: Sequence[float], after: Sequence[float]) -> tuple[float, float]:
    """(|d| as defined in the module docstring, distance driven) [m]."""
    east = north = 0.0
    for row in (before, after):
        cosine, sine = math.cos(row[YAW]), math.sin(row[YAW])
        east += 0.5 * spacing * (cosine * row[VELOCITY_X] - sine * row[VELOCITY_Y])
        north += 0.5 * spacing * (sine * row[VELOCITY_X] + cosine * row[VELOCITY_Y])
    return math.hypot(after[X] - before[X] - east, after[Y] - before[Y] - north), math.hypot(east, north)


class PositionJump(NamedTuple):
    """A change of position that the velocity does not explain."""

    time_ns: int  # first sample after the jump
    size: float  # m


class MeasurementHistory:
    """INS and steering samples of the last `span` seconds, in order of time.

    Samples that are late by up to half a second are inserted at their time, with the same result as if they had arrived
    in order; others that are late, repeated or not finite are rejected. When the INS time jumps back (a replay that
    restarts), both signals restart, and `generation` increases. A signal is unknown between samples further apart than
    maximum_gap; the INS also across a position jump. jump_count: number of jumps. last_jump: None after a restart.

    span, maximum_gap [s]; filter_cutoff [Hz], see timeseries.py for the definition and delay of velocity_x_dot.
    """

    def __init__(self, span: float, maximum_gap: float, filter_cutoff: float):
        self._settings = span, maximum_gap, filter_cutoff
        self.ins = TimeSeries(INS_COLUMNS, span, maximum_gap, angles=("yaw",))
        self.steering = TimeSeries(("road_wheel_angle",), span, maximum_gap)
        self.generation = 0
        self.jump_count = 0
        self.last_jump: PositionJump | None = None
        self._detects_jumps = True
        self._corrected_histories: list[tuple[MeasurementHistory, Callable[[InsSample], InsSample]]] = []

    def make_corrected(self, correct: Callable[[InsSample], InsSample]) -> "MeasurementHistory":
        """A history to which all later samples of this one are added, with `correct` applied to those of the INS. Its
        position jumps are those found in this history."""
        history = MeasurementHistory(*self._settings)
        history.ins.breaks, history._detects_jumps = self.ins.breaks, False
        self._corrected_histories.append((history, correct))
        return history

    def add_ins(self, sample: InsSample) -> bool:
        """Add a sample at the INS point; False if it was rejected."""
        for history, correct in self._corrected_histories:
            history.add_ins(correct(sample))
        index, restarted = self.ins.add(sample.time_ns, sample[1:])
        if restarted:
            self.steering.clear()
            self.last_jump = None
            self.generation += 1
        if index is None:
            return False
        # Only the newest sample is filtered, unless a late sample changes the results after it.
        times, rows, (*_, cutoff) = self.ins.times, self.ins.rows, self._settings
        for i in range(index, len(times)):
            spacing_ns = int(times[i] - times[i - 1]) if i else 0
            velocity = float(rows[i, VELOCITY_X])
            if i == 0 or spacing_ns > self.ins.maximum_gap_ns:
                rows[i, FILTERED_VELOCITY], rows[i, DERIVATIVE] = velocity, math.nan
            else:
                filtered, previous = float(rows[i - 1, FILTERED_VELOCITY]), float(rows[i - 1, VELOCITY_X])
                rows[i, FILTERED_VELOCITY], rows[i, DERIVATIVE] = low_pass_step(
                    filtered, previous, velocity, spacing_ns * NANOSECOND, cutoff)
        if self._detects_jumps:
            self._find_jumps(index)
        return True

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> bool:
        """Add a road wheel angle [rad], positive to the left, measured at time_ns; False if it was rejected."""
        for history, _ in self._corrected_histories:
            history.add_steering(time_ns, road_wheel_angle)
        index, _ = self.steering.add(time_ns, (road_wheel_angle,))
        return index is not None

    def _find_jumps(self, index: int) -> None:
        # A late sample changes the steps before and after it.
        for after in range(max(index, 1), min(index + 2, len(self.ins))):
            times, rows = self.ins.times[after - 1:after + 1].tolist(), self.ins.rows[after - 1:after + 1].tolist()
            size = unexplained_displacement((times[1] - times[0]) * NANOSECOND, *rows)
            was_jump = self.ins.breaks.pop(times[1], None) is not None
            is_jump = size > MAX_NOISE
            if 0.0 < size <= MAX_NOISE and after > MIN_NOISE_STEPS:  # compare with the previous steps
                before = slice(max(0, after - 1 - NOISE_STEPS), after)
                times_ns, samples = self.ins.times[before].tolist(), self.ins.rows[before].tolist()
                noise = [_split_displacement((times_ns[i] - times_ns[i - 1]) * NANOSECOND, *samples[i - 1:i + 1])[0]
                         for i in range(1, len(times_ns))]
                is_jump = size > NOISE_FACTOR * median_high(noise)
            if is_jump:
                self.ins.breaks[times[1]] = f"position jumps by {size:.2f} m"
                self.last_jump = PositionJump(times[1], size)
            self.jump_count += is_jump - was_jump

    def ins_at(self, time_ns: int) -> InsSample | None:
        """The INS sample at an instant, interpolated; None where it is unknown."""
        row = self.ins.row_at(time_ns)
        return None if row is None else InsSample(time_ns, *row[:6])

    def inputs_at(self, time_ns: int) -> ControlInput | None:
        """Both inputs at an instant, interpolated; None where one of them is unknown."""
        ins, steering = self.ins.row_at(time_ns), self.steering.row_at(time_ns)
        if ins is None or steering is None or math.isnan(ins[DERIVATIVE]):
            return None
        return ControlInput(steering[0], ins[DERIVATIVE])


class FrozenAngle(NamedTuple):
    """A constant steering angle during changing yaw motion."""

    angle: float  # constant road wheel angle [rad]
    duration: float  # s
    low: float  # smallest delta' [rad]
    high: float  # largest delta' [rad]


class FrozenSteeringDetector:
    """Detects a frozen steering angle from measurements in order of arrival; criterion: see the module docstring."""

    def __init__(self, vehicle: VehicleParameters):
        self._vehicle = vehicle
        self._angle, self._since_ns, self._newest_ns = math.nan, 0, 0
        self._filtered_angle, self._ins_ns = math.nan, 0  # delta' after the low-pass, time of the last INS sample used
        self._low, self._high = math.inf, -math.inf

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> None:
        """Add a road wheel angle [rad], positive to the left, measured at time_ns."""
        self._newest_ns = time_ns
        # NaN, the first angle and a time before `_since_ns` also restart the detection.
        if abs(road_wheel_angle - self._angle) <= ANGLE_RESOLUTION and time_ns >= self._since_ns:
            return
        self._angle, self._since_ns = road_wheel_angle, time_ns
        self._low, self._high = math.inf, -math.inf

    def add_ins(self, sample: InsSample) -> None:
        """Add an INS sample; only its time, speed and yaw rate are used."""
        speed = sample.velocity_x
        if not speed > FROZEN_MIN_SPEED or not math.isfinite(sample.yaw_rate):
            self._filtered_angle = math.nan
            return
        angle = steady_state_steering(speed, sample.yaw_rate / speed, self._vehicle)
        spacing = (sample.time_ns - self._ins_ns) * NANOSECOND
        self._ins_ns = sample.time_ns
        if not 0.0 < spacing < FROZEN_TIME_CONSTANT or math.isnan(self._filtered_angle):
            self._filtered_angle = angle
            return
        self._filtered_angle += (angle - self._filtered_angle) * spacing / FROZEN_TIME_CONSTANT
        time_constant_ns = FROZEN_TIME_CONSTANT / NANOSECOND
        # Before this interval, low-pass and tyres still respond to the previous angle; after it, the sensor is silent.
        if self._since_ns + 3.0 * time_constant_ns < sample.time_ns < self._newest_ns + time_constant_ns:
            self._low, self._high = min(self._low, self._filtered_angle), max(self._high, self._filtered_angle)

    @property
    def frozen_angle(self) -> FrozenAngle | None:
        """The frozen angle; None while the angle changes or the yaw motion of the car is consistent with it."""
        if not self._high - self._low > FROZEN_MIN_VARIATION + FROZEN_RELATIVE_VARIATION * abs(self._angle):
            return None
        return FrozenAngle(self._angle, (self._newest_ns - self._since_ns) * NANOSECOND, self._low, self._high)
