"""Steering calibration: sign, offset and ratio with known values."""

import math

import pytest
from canedge_bridge.decode import SteeringCalibration


@pytest.mark.parametrize(("sign", "sensor_deg", "steering_wheel_deg", "road_wheel_deg"), [
    (1, -2.7, -2.7, 0.0),
    (1, 14.6, 14.6, 1.0),
    (-1, -14.6, 14.6, 1.0),
    (-1, 2.7, -2.7, 0.0),  # the offset is subtracted after the sign is applied
])
def test_road_wheel_angle(sign, sensor_deg, steering_wheel_deg, road_wheel_deg):
    calibration = SteeringCalibration(sign, math.radians(-2.7), 17.3)
    steering_wheel, road_wheel = calibration.convert(math.radians(sensor_deg))
    assert math.degrees(steering_wheel) == pytest.approx(steering_wheel_deg)
    assert math.degrees(road_wheel) == pytest.approx(road_wheel_deg, abs=1e-12)
