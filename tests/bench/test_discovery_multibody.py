"""The second plant of the benchmark: the package's own equations, driven and read as the virtual car is."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.batch import predict_log
from st_core.vehicle import VehicleParameters
from st_sim.dynamics import AIR_DENSITY, LEAN, SIDE_AREA, STATES, VX, VY, YAW, YAW_RATE, Y
from vehiclemodels.init_mb import init_mb
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from bench.discovery import programmes as m
from bench.discovery.compiled import Programme, Stopped
from bench.discovery.multibody import BODY_STATES, P_VY, P_VY_FRONT, P_VY_REAR, drive_multibody, log_multibody, rates
from bench.discovery.multibody_car import (
    CARS,
    GRAVITY,
    HEALTHY,
    dynamics,
    fitted_tyre,
    nominal_car,
    parameters_of,
    static_loads,
    vehicle_of,
)

# Compiling the car takes some seconds.
driven = pytest.mark.slow
QUIET = {"ins_noise": 0.0, "steering_sensor_noise": 0.0}
CALM = (0.0, 0.0, 0.0, 0.0)
SPEED = 10.0
# Tyres on camber and a body that leans, which the single track does not know, are worth so much of the yaw rate.
CAMBER = 0.025


def states(p, count: int = 50) -> np.ndarray:
    """Cars at 10 m/s in all kinds of motion."""
    draw = np.random.default_rng(7)
    start = np.array(init_mb([0.0, 0.0, 0.0, SPEED, 0.3, 0.0, 0.0], p), float)
    spread = np.full(BODY_STATES, 0.03)
    spread[23:27] = 1.0
    return start + spread * draw.standard_normal((count, BODY_STATES))


def circle(angle: float, count: int = 800) -> Programme:
    """Into a circle within a second; angle: of the road wheels by the nominal ratio times 15.5 [rad]."""
    still = np.zeros(count)
    return Programme(np.minimum(0.01 * np.arange(count), 1.0) * angle * 15.5, still, still, still + SPEED, still)


def single_track(v: VehicleParameters, hand: float) -> float:
    """Steady yaw rate [rad/s] of the linear single track at SPEED for a hand-wheel angle [rad]."""
    front, rear = v.cornering_stiffness_front, v.cornering_stiffness_rear
    gradient = v.mass * (v.cg_to_rear_axle * rear - v.cg_to_front_axle * front) / (v.wheelbase**2 * front * rear)
    return SPEED * v.road_wheel_angle(hand) / (v.wheelbase * (1 + gradient * SPEED**2))


@pytest.mark.parametrize("car", CARS)
def test_the_equations_are_those_of_the_package(car):
    p, own = setup_vehicle_parameters(CARS[car].number), parameters_of(car, {})
    for x in states(p):
        # Within the steering rate the package allows; ours is wider.
        for u in ((0.0, 0.0), (0.3, 2.0), (-0.2, -5.0)):
            np.testing.assert_array_equal(dynamics(x.copy(), u, own), vehicle_dynamics_mb(list(x), list(u), p))
            np.testing.assert_array_equal(rates(x.copy(), *u, CALM, own, 0.0, True),
                                          vehicle_dynamics_mb(list(x), list(u), p))


def test_each_axle_has_its_own_tyres():
    x = states(parameters_of("bmw_320i", {}), 1)[0]
    plain = np.array(dynamics(x.copy(), (0.0, 0.0), parameters_of("bmw_320i", {})))
    for axle, own, other in (("front", P_VY_FRONT, P_VY_REAR), ("rear", P_VY_REAR, P_VY_FRONT)):
        p = parameters_of("bmw_320i", {f"{axle}_stiffness_factor": 1.3})
        changed = np.array(dynamics(x.copy(), (0.0, 0.0), p)) - plain
        assert abs(changed[own]) > 0.1
        assert changed[other] == 0.0


def test_slope_and_wind_push_as_they_should():
    p = parameters_of("escort", {})
    x = np.array(init_mb([0.0, 0.0, 0.0, SPEED, 0.0, 0.0, 0.0], p), float)
    calm = np.array(rates(x.copy(), 0.0, 0.0, CALM, p, 0.0, True))
    banked = np.array(rates(x.copy(), 0.0, 0.0, (0.03, 0.0, 0.0, 0.0), p, 0.0, True)) - calm
    assert banked[[P_VY, P_VY_FRONT, P_VY_REAR]] == pytest.approx([-GRAVITY * np.sin(0.03)] * 3)
    assert np.count_nonzero(banked) == 3
    wind = np.array(rates(x.copy(), 0.0, 0.0, (0.0, 0.0, 0.0, 15.0), p, 0.0, False)) - calm
    force = 0.5 * AIR_DENSITY * SIDE_AREA * np.hypot(SPEED, 15.0) * 15.0
    assert wind[P_VY] * p.m_s == pytest.approx(force)
    assert wind[5] > 0


def test_what_this_car_does_not_have_is_refused():
    with pytest.raises(ValueError, match="camber_thrust"):
        parameters_of("escort", {"camber_thrust": 0.5})
    assert parameters_of("escort", {"camber_thrust": HEALTHY["camber_thrust"]}) == parameters_of("escort", {})


@pytest.mark.parametrize("car", CARS)
def test_the_vehicle_file_is_the_cars_own(car):
    p, v = parameters_of(car, {}), vehicle_of(car)
    loads = static_loads(p)
    assert sum(loads) * 2 == pytest.approx(v.mass * GRAVITY)
    # The package's stiffness is |p_ky1| per load.
    assert v.cornering_stiffness_front == pytest.approx(2 * 21.92 * loads[0], rel=1e-4)
    assert v.cornering_stiffness_rear == pytest.approx(2 * 21.92 * loads[1], rel=1e-4)
    for load, tyre in zip(loads, (p.tire_front, p.tire_rear), strict=True):
        assert fitted_tyre(load, tyre)[1] < 0.001
    assert VehicleParameters.from_yaml(v.to_yaml()) == v
    changed = vehicle_of(car, {"mass_factor": 1.2, "cg_shift": 0.1, "ins_lever_error": 0.3, "friction_factor": 0.8})
    assert changed.mass == pytest.approx(1.2 * v.mass)
    assert changed.cg_to_front_axle == pytest.approx(v.cg_to_front_axle - 0.1)
    assert changed.cg_to_ins_x == pytest.approx(v.cg_to_ins_x + 0.2)
    assert changed.tyre_front.p_dy1 == pytest.approx(0.8 * v.tyre_front.p_dy1, rel=1e-3)


@driven
@pytest.mark.parametrize("car", CARS)
def test_in_a_gentle_circle_the_car_turns_as_its_vehicle_file_says(car):
    for angle in (0.05, -0.05):
        p = circle(angle)
        healthy, wanted = drive_multibody(car, {}, p, 1).rows[-1, YAW_RATE], single_track(vehicle_of(car), p.hand[-1])
        assert healthy == pytest.approx(wanted, rel=CAMBER)
        for hidden in ({"cg_shift": 0.2}, {"front_stiffness_factor": 0.7}, {"rear_stiffness_factor": 0.75},
                       {"steering_ratio_factor": 1.1}, {"steering_offset": 0.006}):
            change = drive_multibody(car, hidden, p, 1).rows[-1, YAW_RATE] / healthy
            foretold = single_track(vehicle_of(car, hidden), p.hand[-1]) / wanted
            assert change == pytest.approx(foretold, abs=CAMBER), hidden
            # The stiffness of these tyres goes with the load, so a shifted centre of gravity changes next to nothing.
            assert abs(change - 1) > (0.05 if "cg_shift" not in hidden else 0.001), hidden


@driven
def test_left_and_right_are_alike():
    # Not exactly: the package's tyre pulls aside a little when it drives.
    p = m.mixed(nominal_car("escort"), (1,), (m.SLALOM, m.STEPS))
    left, right = (drive_multibody("escort", {}, replace(p, hand=sign * p.hand, yaw=sign * p.yaw), 1).rows
                   for sign in (1, -1))
    for column in (YAW_RATE, VY, LEAN, STATES + 1):
        size = left[:, column].std()
        assert np.abs(np.corrcoef(left[:, column], right[:, column])[0, 1] + 1) < 0.01
        assert np.std(left[:, column] + right[:, column]) < 0.1 * size
    np.testing.assert_allclose(left[:, VX], right[:, VX], atol=0.02)


@driven
def test_the_body_leans_out_of_the_turn_and_dives_and_the_accelerometer_feels_it():
    p = circle(0.05)
    log = log_multibody("circle", "bmw_320i", QUIET, p, 1, vehicle_of("bmw_320i"))
    row = drive_multibody("bmw_320i", QUIET, p, 1).rows[-1]
    felt = log.acceleration_y[-1] - log.yaw_rate[-1] * log.velocity_x[-1]
    assert row[VX] * row[YAW_RATE] > 1.8 and 0.02 < row[LEAN] < 0.1
    assert abs(row[STATES + 1]) < 0.01
    assert felt == pytest.approx(GRAVITY * np.sin(row[LEAN]), abs=0.03)
    still = np.zeros(300)
    brake = Programme(still, still, still, SPEED - 2.0 * 0.01 * np.arange(300), still - 2.0)
    log = log_multibody("brake", "bmw_320i", QUIET, brake, 1, vehicle_of("bmw_320i"))
    slope = (log.velocity_x[-1] - log.velocity_x[150]) / 1.49
    assert slope == pytest.approx(-2.0, abs=0.1)
    assert -0.6 < log.acceleration_x[-100:].mean() - slope < -0.05


@driven
def test_what_is_wrong_at_the_wire_comes_late_or_loose():
    p = circle(0.05)
    plain = drive_multibody("vanagon", {}, p, 1)
    r = plain.rows[-1, YAW_RATE]
    for hidden in ({"steering_lag": 0.1}, {"steering_delay": 0.1}):
        late = drive_multibody("vanagon", hidden, p, 1)
        # What comes late by 0.1 s has turned that much less when all is steady again.
        assert (plain.rows[-1, YAW] - late.rows[-1, YAW]) / r == pytest.approx(0.1, abs=0.004)
        np.testing.assert_array_equal(late.hand, plain.hand)
    loose = drive_multibody("vanagon", {"steering_backlash": 0.2}, p, 1).rows[-1, YAW_RATE]
    assert loose / r == pytest.approx(1 - 0.1 / p.hand[-1], rel=0.01)


@driven
def test_inertia_and_friction_show_where_they_should():
    still = np.zeros(400)
    kick = Programme(still + 1.0, still, still, still + SPEED, still)
    slow, fast = (drive_multibody("bmw_320i", {"yaw_inertia_factor": f}, kick, 1).rows[:30, STATES + 2].max()
                  for f in (1.5, 1.0))
    assert slow < 0.9 * fast
    hard = circle(0.4, 300)
    grips = [(rows[:, STATES + 1] + rows[:, VX] * rows[:, YAW_RATE]).max() for rows in (
        drive_multibody("escort", {"friction_factor": f}, hard, 1).rows for f in (1.0, 0.8))]
    assert grips[1] / grips[0] == pytest.approx(0.8, abs=0.06)


@driven
def test_the_sensors_are_wrong_by_what_is_hidden():
    p, v = circle(0.05), vehicle_of("escort")

    def log(**hidden: float):
        return log_multibody("circle", "escort", {**QUIET, **hidden}, p, 1, v)

    plain = log()
    r = plain.yaw_rate
    assert np.abs(np.gradient(plain.yaw, 0.01) - r)[5:-5].max() < 0.02
    assert np.abs(np.hypot(*np.gradient(np.stack([plain.x, plain.y]), 0.01, axis=1))
                  - np.hypot(plain.velocity_x, plain.velocity_y))[5:-5].max() < 0.01
    np.testing.assert_allclose(log(yaw_rate_scale=1.05).yaw_rate, 1.05 * r, atol=2e-5)
    np.testing.assert_allclose(log(yaw_rate_bias=0.01).yaw_rate, r + 0.01, atol=2e-5)
    np.testing.assert_allclose(log(lateral_acceleration_bias=0.2).acceleration_y, plain.acceleration_y + 0.2, atol=2e-4)
    np.testing.assert_allclose(log(velocity_scale=1.02).velocity_x, 1.02 * plain.velocity_x, atol=2e-3)
    ahead = log(ins_lever_error=0.5)
    np.testing.assert_allclose(ahead.velocity_y - plain.velocity_y, 0.5 * r, atol=2e-3)
    np.testing.assert_allclose(ahead.x - plain.x, 0.5 * np.cos(plain.yaw), atol=1e-4)
    turned = log(ins_misalignment=0.01)
    np.testing.assert_allclose(turned.yaw, plain.yaw + 0.01, atol=2e-6)
    np.testing.assert_allclose(turned.velocity_y - plain.velocity_y, -0.01 * plain.velocity_x, atol=2e-3)
    noisy = log_multibody("circle", "escort", {}, p, 1, v)
    assert 0.001 < np.std(noisy.yaw_rate - r) < 0.01


@driven
def test_an_effect_that_begins_later_is_not_there_before():
    p = circle(0.05)
    plain, later = (drive_multibody("escort", {}, p, 1, then).rows for then in (None, ({"steering_offset": 0.01}, 300)))
    np.testing.assert_array_equal(later[:300], plain[:300])
    assert later[-1, Y] - plain[-1, Y] > 0.1


@driven
def test_a_car_that_nearly_stops_is_refused():
    still = np.zeros(800)
    with pytest.raises(Stopped):
        drive_multibody("escort", {}, Programme(still, still, still, np.linspace(8.0, 1.0, 800), still - 0.9), 1)


@driven
def test_the_single_track_with_that_file_predicts_a_healthy_drive():
    v = vehicle_of("vanagon")
    log = log_multibody("slalom", "vanagon", {}, m.mixed(nominal_car("vanagon"), (3,), (m.SLALOM, m.ORDINARY)), 3, v)
    start = log.ins_time_ns[0]
    starts = start + np.arange(10**9, int(log.ins_time_ns[-1] - start) - 6 * 10**9, 5 * 10**8)
    p = predict_log("nonlinear", v, log, starts, points=[5.0])
    seen = (starts + 5 * 10**9 - start) * 1e-9
    seconds = (log.ins_time_ns - start) * 1e-9
    x, y = (p.states[:, 0, i] + v.cg_to_ins_x * turn(p.yaw[:, 0]) for i, turn in ((0, np.cos), (1, np.sin)))
    error = np.hypot(x - np.interp(seen, seconds, log.x), y - np.interp(seen, seconds, log.y))
    assert np.isfinite(error).all() and error.mean() < 0.4
