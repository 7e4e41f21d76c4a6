"""The virtual car under an external controller: commands become motion, within the limits of steering and tyres."""

import math
import runpy

import pytest
from st_sim.driver import MAX_BRAKING, MAX_STEERING_WHEEL_RATE
from st_sim.settings import PRESETS, read_vehicle, resolve_settings
from support import LEAF, ROOT

ControlledCar = runpy.run_path(str(ROOT / "examples" / "mpc" / "controlled_car.py"))["ControlledCar"]
CAR = read_vehicle(LEAF)


def make_car(speed=8.0, curvature=0.0):
    car = ControlledCar(CAR, PRESETS["ideal"])
    car.place(10.0, -5.0, 0.5, speed, curvature)
    return car


def test_car_starts_at_its_initial_pose_and_drives_straight():
    car = make_car()
    assert car.time == 0.0 and car.state[:3] == (10.0, -5.0, 8.0) and car.state[4] == 0.5
    car.advance(1.5, 0.0, 0.0)
    x, y, speed, *_ = car.state
    assert car.time == pytest.approx(1.5)
    assert (x, y, speed) == pytest.approx((10.0 + 12.0 * math.cos(0.5), -5.0 + 12.0 * math.sin(0.5), 8.0), abs=1e-9)


@pytest.mark.parametrize("acceleration", [-3.0, 1.5])
@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_acceleration_is_as_commanded_on_straights_and_in_bends(acceleration, angle):
    car = make_car(curvature=math.tan(angle) / CAR.wheelbase)
    car.advance(1.0, angle, 0.0)
    initial_speed = car.state[2]
    car.advance(1.0, angle, acceleration)
    assert car.state[2] - initial_speed == pytest.approx(acceleration, rel=0.05, abs=0.05)


def test_positive_steering_turns_left_on_the_kinematic_radius():
    car = make_car(speed=3.0, curvature=math.tan(0.15) / CAR.wheelbase)
    car.advance(4.0, 0.15, 0.0)
    _, _, speed, _, _, yaw_rate = car.state
    assert yaw_rate / speed == pytest.approx(math.tan(0.15) / CAR.wheelbase, rel=0.05)


def test_steering_rate_and_braking_are_limited():
    car = make_car(speed=15.0)
    car.advance(0.1, 0.5, 0.0)
    assert car.steering_wheel_angle == pytest.approx(0.1 * MAX_STEERING_WHEEL_RATE)
    car = make_car(speed=15.0)
    car.advance(1.0, 0.0, -30.0)
    assert car.state[2] == pytest.approx(15.0 - MAX_BRAKING, abs=0.1)


def test_air_drag_decelerates_the_realistic_car():
    car = ControlledCar(CAR, resolve_settings("realistic"))
    car.place(0.0, 0.0, 0.0, 20.0)
    car.advance(2.0, 0.0, 0.0)
    assert car.state[2] < 19.8
