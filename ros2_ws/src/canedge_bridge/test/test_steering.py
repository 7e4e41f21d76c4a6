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
    sensor = math.radians(sensor_deg)
    assert math.degrees(calibration.steering_wheel_angle(sensor)) == pytest.approx(steering_wheel_deg)
    assert math.degrees(calibration.road_wheel_angle(sensor)) == pytest.approx(road_wheel_deg, abs=1e-12)
