"""Sign, offset and ratio with known values."""

import math

import pytest
from canedge_bridge.decode import SteeringCalibration


@pytest.mark.parametrize(("sign", "sensor_deg", "steering_wheel_deg", "road_wheel_deg"), [
    (1, -2.7, -2.7, 0.0),
    (1, 14.6, 14.6, 1.0),
    (-1, -14.6, 14.6, 1.0),
    (-1, 2.7, -2.7, 0.0),   # the offset belongs to the signed reading: not (2.7 + 2.7)
])
def test_road_wheel_angle(sign, sensor_deg, steering_wheel_deg, road_wheel_deg):
    calibration = SteeringCalibration(sign, math.radians(-2.7), 17.3)
    sensor = math.radians(sensor_deg)
    assert math.degrees(calibration.steering_wheel_angle(sensor)) == pytest.approx(steering_wheel_deg)
    assert math.degrees(calibration.road_wheel_angle(sensor)) == pytest.approx(road_wheel_deg, abs=1e-12)


def test_the_formula_shows_its_numbers():
    text = SteeringCalibration(-1, math.radians(-2.7), 17.3).formula()
    assert "(-1 * sensor - (-0.047124 rad)) / 17.3" in text
    assert "-2.700 deg" in text and "0.1561 deg" in text
