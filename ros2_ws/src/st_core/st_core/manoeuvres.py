"""Manoeuvres of the virtual car, of the drives that `st discover` suggests, and of the benchmark of discovery.

A manoeuvre is defined by speed and target lateral acceleration, so that any car can drive it:

    curvature(t) = lateral * profile(t) / speed^2          profile: -1 to 1
    road wheel angle(t) = (L + K speed^2) curvature(t)     L: wheelbase, K: understeer gradient

Left is positive everywhere; a negative lateral acceleration mirrors the manoeuvre. Checked by: test_manoeuvres.py,
tests/bench/test_discovery_manoeuvres.py.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

UNDERSTEER_GRADIENT = 0.004  # rad s^2/m, understeer gradient K assumed for an unknown car
Profile = Callable[[np.ndarray], np.ndarray]  # lateral acceleration divided by its target, -1 to 1, at times [s]


@dataclass(frozen=True)
class PiecewiseLinear:
    """Piecewise linear function of time; parts: (duration [s], value at its start, value at its end)."""

    parts: tuple[tuple[float, float, float], ...]

    def __call__(self, time: np.ndarray) -> np.ndarray:
        return np.interp(time, *self._corners)

    @property
    def duration(self) -> float:
        return float(self._corners[0][-1])

    @cached_property
    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """(times, values) at both ends of each part; at a jump, a time occurs twice, and its second value applies."""
        parts = np.array(self.parts)
        return np.repeat(np.cumsum([0.0, *parts[:, 0]]), 2)[1:-1], parts[:, 1:].ravel()


@dataclass(frozen=True)
class SineSweep:
    """A sine with a frequency that increases exponentially from `low` to `high` [Hz] over `duration` [s]; then 0."""

    low: float
    high: float
    duration: float

    def __call__(self, time: np.ndarray) -> np.ndarray:
        rate = math.log(self.high / self.low) / self.duration
        cycles = self.low * (np.expm1(rate * time) / rate if rate else time)
        return np.where(time < self.duration, np.sin(2 * np.pi * cycles), 0.0)


@dataclass(frozen=True)
class Manoeuvre:
    """Steering and pedal inputs over time.

    closed_loop: the driver follows a road with this `curvature`; otherwise the steering is open loop. A closed-loop
    manoeuvre with pedals is on a circle, and the steering is held while braking.
    """

    name: str  # also the name of the scenario
    speed: float  # at the start [m/s]
    lateral_acceleration: float  # peak target value at the initial speed [m/s^2]
    profile: Profile  # over one period
    period: float  # time after which the manoeuvre repeats [s]
    repetitions: int = 1  # periods in one drive
    pedals: tuple[tuple[float, float], ...] = ()  # (duration [s], acceleration [m/s^2]) in order; top speed: `speed`
    closed_loop: bool = False
    description: str = field(default="", compare=False)  # one line

    @property
    def duration(self) -> float:
        """Duration of a drive [s]."""
        return self.repetitions * self.period

    def curvature(self, time: np.ndarray | float) -> np.ndarray:
        """Curvature of the path at the initial speed [1/m]; time [s] >= 0."""
        return self.lateral_acceleration / self.speed**2 * self.profile(np.asarray(time) % self.period)

    def steering(self, time: np.ndarray | float, wheelbase: float,
                 understeer: float = UNDERSTEER_GRADIENT) -> np.ndarray:
        """Road wheel angle [rad] for a wheelbase [m] and an understeer gradient K [rad s^2/m]; time [s] >= 0."""
        return (wheelbase + understeer * self.speed**2) * self.curvature(time)

    def speed_at(self, time: np.ndarray | float) -> np.ndarray:
        """Target speed [m/s]; time [s] >= 0."""
        times, speeds = self._speeds
        return np.interp(np.asarray(time) % self.period, times, speeds)

    def acceleration_at(self, time: np.ndarray | float) -> np.ndarray:
        """Target forward acceleration [m/s^2]; time [s] >= 0."""
        times, speeds = self._speeds
        slopes = np.diff(speeds) / np.diff(times)
        i = np.searchsorted(times, np.asarray(time) % self.period, side="right") - 1
        return slopes[np.clip(i, 0, len(slopes) - 1)]

    @cached_property
    def _speeds(self) -> tuple[np.ndarray, np.ndarray]:
        times, speeds = [0.0], [self.speed]
        for seconds, acceleration in self.pedals or ((self.period, 0.0),):
            until_top_speed = (self.speed - speeds[-1]) / acceleration if acceleration > 0.0 else seconds
            for duration in (min(seconds, until_top_speed), seconds - until_top_speed):
                if duration > 1e-9:
                    speeds.append(min(speeds[-1] + acceleration * duration, self.speed))
                    times.append(times[-1] + duration)
        return np.array(times), np.array(speeds)


def sweep(speed: float, lateral: float, duration: float = 26.0, pause: float = 4.0) -> Manoeuvre:
    """Sine steering, 0.2 to 2.8 Hz over `duration` [s], then straight for `pause` [s]."""
    return Manoeuvre("sweep", speed, lateral, SineSweep(0.2, 2.8, duration), duration + pause,
                     description=f"sine steering 0.2 to 2.8 Hz at {speed:g} m/s")


def step(speed: float, lateral: float, hold: float = 4.0, pause: float = 3.0) -> Manoeuvre:
    """Step steer to one side, then to the other, each held for `hold` [s] after driving straight for `pause` [s]."""
    parts = ((pause, 0.0, 0.0), (hold, 1.0, 1.0), (pause, 0.0, 0.0), (hold, -1.0, -1.0))
    return Manoeuvre("step", speed, lateral, PiecewiseLinear(parts), 2 * (hold + pause), repetitions=2,
                     description=f"step steers to both sides at {speed:g} m/s")


def ramp_to_limit(speed: float, lateral: float, rise: float = 25.0, fall: float = 2.0, pause: float = 4.0) -> Manoeuvre:
    """Ramp steer over `rise` [s], back over `fall` [s], straight for `pause` [s]; then the same to the other side.
    lateral [m/s^2]: above the limit of the tyres."""
    profile = _both_sides((rise, 0.0, 1.0), (fall, 1.0, 0.0), (pause, 0.0, 0.0))
    return Manoeuvre("ramp_to_limit", speed, lateral, profile, profile.duration,
                     description=f"steering slowly increased to the limit at {speed:g} m/s")


def brake_in_turn(speed: float, lateral: float, cruise_time: float = 8.0, deceleration: float = 4.0,
                  end_speed: float = 3.0, acceleration: float = 2.0, acceleration_time: float = 6.0) -> Manoeuvre:
    """Circle at constant speed for cruise_time [s], deceleration to end_speed [m/s], then acceleration [m/s^2]."""
    pedals = ((cruise_time, 0.0), ((speed - end_speed) / deceleration, -deceleration),
              (acceleration_time, acceleration))
    period = sum(seconds for seconds, _ in pedals)
    constant = PiecewiseLinear(((period, 1.0, 1.0),))
    return Manoeuvre("brake_in_turn", speed, lateral, constant, period, 2, pedals, closed_loop=True,
                     description=f"R = {speed**2 / abs(lateral):.0f} m at {abs(lateral):g} m/s^2, braking at "
                                 f"{deceleration:g} m/s^2 with the steering wheel held")


def lane_change(speed: float, lateral: float) -> Manoeuvre:
    """Double lane change: 40 m straight, 3.5 m to the side, 25 m in the other lane, back, 35 m straight. Within the
    length s of one change, the curvature is linear between 0, k, -k and 0: width = 2 k (s / 4)^2 for small angles."""
    quarter = math.sqrt(3.5 * speed**2 / (2 * abs(lateral)))
    change = ((quarter, 0.0, 1.0), (2 * quarter, 1.0, -1.0), (quarter, -1.0, 0.0))
    return_change = tuple((length, -first, -last) for length, first, last in change)
    parts = ((40.0, 0.0, 0.0), *change, (25.0, 0.0, 0.0), *return_change, (35.0, 0.0, 0.0))  # lengths in m
    profile = PiecewiseLinear(tuple((length / speed, first, last) for length, first, last in parts))
    return Manoeuvre("lane_change", speed, lateral, profile, profile.duration, repetitions=2, closed_loop=True,
                     description=f"double lane changes at {speed:g} m/s")


def slalom(speed: float, lateral: float, frequency: float = 0.5, cycles: int = 12) -> Manoeuvre:
    """Sine steering at one frequency [Hz], for a number of cycles."""
    return Manoeuvre("slalom", speed, lateral, SineSweep(frequency, frequency, cycles / frequency), cycles / frequency,
                     description=f"sine steering of {frequency:g} Hz to {abs(lateral):g} m/s^2 at {speed:g} m/s")


def weave(speed: float, lateral: float, cycles: float = 6.0) -> Manoeuvre:
    """Sine steering at 0.25 Hz with a small amplitude about the centre, for a number of cycles."""
    return Manoeuvre("weave", speed, lateral, SineSweep(0.25, 0.25, 4 * cycles), 4 * cycles,
                     description=f"gentle sine steering of 0.25 Hz about the centre at {speed:g} m/s")


def circle(speed: float, lateral: float, hold: float = 10.0, ramp: float = 2.0) -> Manoeuvre:
    """Circle for `hold` [s] between ramps of `ramp` [s], then straight for 1 s; then the same to the other side."""
    profile = _both_sides((ramp, 0.0, 1.0), (hold, 1.0, 1.0), (ramp, 1.0, 0.0), (1.0, 0.0, 0.0))
    return Manoeuvre("circle", speed, lateral, profile, profile.duration,
                     description=f"steady circles to both sides, {speed:g} m/s and {abs(lateral):g} m/s^2, with the "
                                 "steering wheel held")


def there_and_back(speed: float, lateral: float) -> Manoeuvre:
    """Straights of 10 s in opposite directions, so that a steady wind acts from both sides; U-turns to one side."""
    half = ((10.0, 0.0, 0.0), (1.0, 0.0, 1.0), (math.pi * speed / abs(lateral) - 1.0, 1.0, 1.0), (1.0, 1.0, 0.0))
    profile = PiecewiseLinear(half + half)
    return Manoeuvre("there_and_back", speed, lateral, profile, profile.duration, closed_loop=True,
                     description=f"straights in opposite directions at {speed:g} m/s")


def figure_eight() -> Manoeuvre:
    """Scenario S1 of the paper: 240 deg loops to both sides, transitions of 6 m, straights that close the path."""
    speed, radius, ramp, straight = 4.0, 11.5, 6.0, 34.3015  # m/s, then m
    arc = math.radians(240.0) * radius - ramp
    half = ((straight / 2, 0.0, 0.0), (ramp, 0.0, 1.0), (arc, 1.0, 1.0), (ramp, 1.0, 0.0), (straight / 2, 0.0, 0.0))
    profile = _both_sides(*((length / speed, first, last) for length, first, last in half))  # lengths in m
    return Manoeuvre("S1", speed, speed**2 / radius, profile, profile.duration, closed_loop=True,
                     description=f"figure eight at {speed:g} m/s, R = {radius:g} m")


def _both_sides(*parts: tuple[float, float, float]) -> PiecewiseLinear:
    return PiecewiseLinear((*parts, *((length, -first, -last) for length, first, last in parts)))


CATALOGUE = (
    sweep(14.0, 3.09),
    step(12.0, 3.96),
    ramp_to_limit(11.0, 15.2),
    brake_in_turn(math.sqrt(4.0 * 30.0), 4.0),
    lane_change(12.0, 4.48),
    slalom(12.0, 4.0),
    weave(14.0, 1.0),
    circle(6.5, 3.6),
    there_and_back(8.0, 3.0),
    figure_eight(),
)
"""Manoeuvres that `st discover` suggests and the virtual car drives by name."""
