"""Detects a steering angle that stays constant while the car's turn changes: a sensor that repeats one value.

    delta' = l (1 + K v^2) r / v

is the angle of a steady turn, filtered; with a constant steering angle it is nearly constant at any speed. The bounds
are wide: bank, wind, braking and tyres at their limit change it as well. Checked by: test_frozen_steering.py.
"""

import math
from dataclasses import dataclass

from .filtering import NANOSECOND
from .handling import understeer_coefficient
from .types import InsSample
from .vehicle import VehicleParameters

# delta' may move by this much [rad], about 20 deg of the steering wheel, and by this share of the angle itself.
LEAST, SHARE = 0.02, 0.3
SLOWEST = 3.0  # m/s; below it the noise of the yaw rate turns into large angles
TIME_CONSTANT = 0.2  # s, of the low-pass on delta'
# A moving wheel changes by a step of the sensor; what is below is rounding [rad].
RESOLUTION = 1.0e-9


@dataclass(frozen=True)
class FrozenAngle:
    """angle: constant road wheel angle [rad]; seconds: its duration; low, high: range of delta' meanwhile [rad]."""

    angle: float
    seconds: float
    low: float
    high: float


class FrozenSteering:
    """Consumes measurements in the order of arrival; `found` is the angle that is frozen at present."""

    def __init__(self, vehicle: VehicleParameters):
        self._wheelbase, self._understeer = vehicle.wheelbase, understeer_coefficient(vehicle)
        self._angle, self._since_ns, self._newest_ns = math.nan, 0, 0
        self._implied, self._implied_ns = math.nan, 0
        self._low, self._high = math.inf, -math.inf

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> None:
        """road_wheel_angle [rad], left +, measured at time_ns."""
        self._newest_ns = time_ns
        # NaN, the first angle and a time that runs backward restart the detection too.
        if abs(road_wheel_angle - self._angle) <= RESOLUTION and time_ns >= self._since_ns:
            return
        self._angle, self._since_ns = road_wheel_angle, time_ns
        self._low, self._high = math.inf, -math.inf

    def add_ins(self, sample: InsSample) -> None:
        speed = sample.velocity_x
        if not speed > SLOWEST or not math.isfinite(sample.yaw_rate):
            self._implied = math.nan
            return
        implied = self._wheelbase * (1.0 + self._understeer * speed * speed) * sample.yaw_rate / speed
        spacing = (sample.time_ns - self._implied_ns) * NANOSECOND
        self._implied_ns = sample.time_ns
        if not 0.0 < spacing < TIME_CONSTANT or math.isnan(self._implied):
            self._implied = implied
            return
        self._implied += (implied - self._implied) * spacing / TIME_CONSTANT
        # The low-pass and the tyres still follow the steering before it became constant.
        if sample.time_ns > self._since_ns + 3.0 * TIME_CONSTANT / NANOSECOND:
            self._low, self._high = min(self._low, self._implied), max(self._high, self._implied)

    @property
    def found(self) -> FrozenAngle | None:
        """None while the angle changes, or while the turn of the car agrees with it."""
        if not self._high - self._low > LEAST + SHARE * abs(self._angle):
            return None
        return FrozenAngle(self._angle, (self._newest_ns - self._since_ns) * NANOSECOND, self._low, self._high)
