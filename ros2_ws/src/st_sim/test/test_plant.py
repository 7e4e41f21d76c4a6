"""The plant: force and energy balance, symmetry, steady states, step size, standstill."""

import math

import numpy as np
import pytest
from st_sim.dynamics import GRAVITY
from st_sim.plant import STEP, VX, VY, YAW, YAW_RATE, Plant, X, Y, Z
from st_sim.settings import read_vehicle, resolve_settings
from support import LEAF

CAR = read_vehicle(LEAF)
RATIO = CAR.steering_ratio


def simulate(settings, steering_wheel, force, seconds, speed=8.0, step=STEP):
    """Plant after `seconds`. steering_wheel(time) [rad] and force(time, plant) [N] are constant within each STEP."""
    plant = Plant(CAR, settings, step=step)
    plant.place(0.0, 0.0, 0.0, speed)
    per_input = round(STEP / step)
    for i in range(round(seconds / STEP)):
        angle, push = steering_wheel(i * STEP), force(i * STEP, plant)
        for _ in range(per_input):
            plant.step(angle, push)
    return plant


def two_sines(time):
    return 1.5 * math.sin(2 * math.pi * 0.4 * time) + 0.8 * math.sin(2 * math.pi * 1.3 * time)


def hold_speed(speed):
    return lambda time, plant: 3000.0 * (speed - plant.state[VX])


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
def test_left_and_right_turns_are_mirror_images(plant):
    settings = resolve_settings(plant)
    left = simulate(settings, two_sines, hold_speed(8.0), 6.0)
    right = simulate(settings, lambda t: -two_sines(t), hold_speed(8.0), 6.0)
    mirror = np.ones(16)
    for i in (Y, YAW, VY, YAW_RATE):
        mirror[i] = -1
    assert abs(left.state[Y]) > 1.0
    for i in (X, Y, YAW, VX, VY, YAW_RATE):
        assert left.state[i] == pytest.approx(mirror[i] * right.state[i], abs=1e-9)


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
def test_drive_is_independent_of_the_step(plant):
    settings = resolve_settings(plant)
    whole = simulate(settings, two_sines, hold_speed(8.0), 10.0)
    half = simulate(settings, two_sines, hold_speed(8.0), 10.0, step=STEP / 2)
    assert math.dist(whole.state[:2], half.state[:2]) < 1e-3
    assert whole.state[YAW] == pytest.approx(half.state[YAW], abs=1e-4)


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
def test_forces_equal_mass_times_acceleration(plant):
    settings = resolve_settings(plant, ["drag_area=0", "rolling_resistance=0"])
    car = simulate(settings, lambda t: 3.0, hold_speed(8.0), 3.0)
    before, force = car.state, 900.0
    forces = car.observe(force)
    assert sum(forces.load) == pytest.approx(car.mass * GRAVITY, rel=1e-9)
    car.step(3.0, force)
    change = (np.array(car.state) - np.array(before)) / STEP
    # Acceleration over ground in body axes from the states, compared with the input of the sensors.
    assert change[VX] - before[YAW_RATE] * before[VY] == pytest.approx(forces.acceleration_x, abs=0.02)
    assert change[VY] + before[YAW_RATE] * before[VX] == pytest.approx(forces.acceleration_y, abs=0.02)
    assert change[YAW_RATE] == pytest.approx(forces.yaw_acceleration, abs=0.02)
    assert sum(forces.lateral_force) == pytest.approx(car.mass * forces.acceleration_y, rel=0.1)


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
def test_kinetic_energy_decreases_without_drive_force(plant):
    car = Plant(CAR, resolve_settings(plant))
    car.place(0.0, 0.0, 0.0, 15.0)
    energies = []
    for i in range(3000):
        s = car.state
        energies.append(0.5 * car.mass * (s[VX] ** 2 + s[VY] ** 2) + 0.5 * car.constants.yaw_inertia * s[YAW_RATE] ** 2)
        car.step(two_sines(i * STEP), 0.0)
    loss = -np.diff(energies)
    # A tyre with relaxation stores energy and may return at most 0.01 % of the total when the steering reverses.
    assert loss.min() > -1e-4 * energies[0] * STEP * 50
    assert energies[-1] < 0.97 * energies[0]


def test_drive_force_accelerates_the_car_on_a_straight():
    car = simulate(resolve_settings("ideal"), lambda t: 0.0, lambda t, p: 1590.0, 4.0, speed=5.0)
    assert car.state[VX] == pytest.approx(5.0 + 4.0, rel=1e-3)
    assert car.state[Y] == 0.0


def steady_circle(plant, road_wheel_angle, speed):
    """Steady-state v_y [m/s], yaw rate [rad/s] and lateral acceleration [m/s^2] at v_x = speed."""
    integral = 0.0
    plant.place(0.0, 0.0, 0.0, speed, math.tan(road_wheel_angle) / CAR.wheelbase)
    for _ in range(6000):
        error = speed - plant.state[VX]
        integral += error * STEP
        plant.step(road_wheel_angle * RATIO, plant.mass * (8 * error + 8 * integral))
    return plant.state[VY], plant.state[YAW_RATE], plant.observe(0.0).acceleration_y


@pytest.mark.parametrize(
    ("speed", "road_wheel_deg", "nonlinear_yaw_rate", "nonlinear_v_y"),
    # Steady state of the nonlinear single-track model of the paper for S3 and S4, which paper_notes.md derives from the
    # error table. The yaw rate of the plant is up to 4 % higher: the drive force of its steered front wheels has a
    # lateral component, which the model, whose input is the acceleration, neglects.
    [(6.59, 14.20, 0.5506, 0.6710), (8.56, 15.21, 0.7050, 0.6472)],
)
def test_ideal_plant_is_close_to_the_nonlinear_single_track_model(
    speed, road_wheel_deg, nonlinear_yaw_rate, nonlinear_v_y):
    v_y, yaw_rate, _ = steady_circle(Plant(CAR, resolve_settings("ideal")), math.radians(road_wheel_deg), speed)
    assert yaw_rate == pytest.approx(nonlinear_yaw_rate, rel=0.04)
    assert v_y == pytest.approx(nonlinear_v_y, abs=0.03)


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
@pytest.mark.parametrize("effects", [[], ["grade_angle=0.08"], ["bank_angle=0.05"]])
def test_car_braked_to_rest_remains_at_rest(plant, effects):
    car = simulate(resolve_settings(plant, effects), lambda t: 2.0, lambda t, p: -3000.0, 8.0, speed=4.0)
    pose = car.state[:4]
    assert car.is_at_rest and car.state[VX] == car.state[VY] == car.state[YAW_RATE] == 0.0
    for _ in range(500):
        car.step(2.0, -3000.0)
    assert car.state[:4] == pose
    assert car.observe(-3000.0).acceleration_x == 0.0


def test_car_accelerates_from_rest():
    car = simulate(resolve_settings("realistic"), lambda t: 2.0, lambda t, p: -3000.0 if t < 4 else 1500.0, 8.0,
                 speed=4.0)
    assert car.state[VX] > 2.0


def test_height_increases_by_the_grade():
    car = simulate(resolve_settings("ideal", ["grade_angle=0.05"]), lambda t: 0.0, hold_speed(10.0), 5.0, speed=10.0)
    assert car.state[Z] / car.state[X] == pytest.approx(math.tan(0.05), rel=1e-6)


@pytest.mark.parametrize("effects", [[], ["friction_factor=0.2"], ["relaxation_length=2.0"], ["mass_factor=2"]])
def test_state_remains_finite_in_a_spin(effects):
    car = simulate(resolve_settings("realistic", effects), lambda t: 9.0, lambda t, p: 4000.0 * math.sin(3 * t), 12.0,
                 speed=18.0)
    assert all(map(math.isfinite, car.state))
    assert abs(car.state[VX]) < 40.0
