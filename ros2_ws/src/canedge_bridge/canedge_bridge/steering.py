"""From what the steering sensor says to the angle of the road wheels."""

import math
from dataclasses import dataclass

from st_core import vehicle
from st_core.types import Number


@dataclass(frozen=True)
class SteeringCalibration:
    """road_wheel_angle = (steering_sign * sensor - steering_wheel_offset) / steering_ratio

    steering_sign: +1 where the sensor, as decoded, counts left turns positive, -1 where right turns; applied first.
    steering_wheel_offset [rad, left +]: what the signed sensor reads when driving straight. steering_ratio [1].
    Source: paper, section on the vehicle; offset and ratio of the Leaf are -2.7 deg and 17.3.
    """

    steering_sign: int
    steering_wheel_offset: float
    steering_ratio: float

    def steering_wheel_angle(self, sensor: Number) -> Number:
        """[rad], left +, offset not removed."""
        return self.steering_sign * sensor

    def road_wheel_angle(self, sensor: Number) -> Number:
        """[rad], left +, mean of the front axle."""
        angle = self.steering_wheel_angle(sensor)
        return vehicle.road_wheel_angle(angle, self.steering_wheel_offset, self.steering_ratio)

    def formula(self) -> str:
        """The equation with its numbers, for people."""
        offset = math.degrees(self.steering_wheel_offset)
        return (f"road_wheel_angle = ({self.steering_sign:+d} * sensor - ({self.steering_wheel_offset:.6f} rad)) / "
                f"{self.steering_ratio:g}, left +; steering_wheel_offset = {offset:.3f} deg, so a sensor at 0 gives "
                f"{math.degrees(self.road_wheel_angle(0.0)):.4f} deg")
