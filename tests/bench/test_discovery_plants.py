"""Plants of the discovery benchmark against the equations of the package vehiclemodels and against the virtual car."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.log_evaluation import evaluate_log
from st_core.vehicle import VehicleParameters
from st_sim.dynamics import RACK, STATES, VX, VY, YAW, YAW_RATE
from st_sim.plant import STEP, Plant
from st_sim.sensors import Ins, SteeringSensor
from st_sim.settings import resolve_settings
from vehiclemodels.init_mb import init_mb
from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

from bench.plants import relation_equations
from bench.plants.leaf import STEPS_PER_SAMPLE, Programme, drive
from bench.plants.multibody import BODY_STATES, drive_multibody, rates
from bench.plants.multibody_car import CARS, dynamics, parameters_of, vehicle_of
from bench.plants.record import LEAF_VEHICLE as LEAF
from bench.plants.record import NOMINAL, RunPlan, healthy_car, record_run
from bench.plants.record import vehicle_of as vehicle_of_plant
from bench.plants.relation_equations import Relation
from bench.plants.resimulated import resimulate
from bench.plants.sensing import CHANNELS, make_log, make_readings

FLAT_AND_CALM = (0.0, 0.0, 0.0, 0.0)  # bank, grade [rad], wind [m/s]
SPEED = 10.0  # m/s
TOLERANCE = 0.025  # share of the yaw rate from camber and roll, which the single-track model lacks
ALL_EFFECTS = ["gust_speed=3", "wind_speed=4", "camber_thrust=0.3", "rear_roll_steer=0.02", "steering_backlash=0.02",
               "steering_delay=0.03", "terrain_wave=0.02", "hillside_slope=0.01", "friction_patch=0.8",
               "ins_misalignment=0.01", "ins_lever_error=0.2", "yaw_rate_scale=1.02", "velocity_scale=0.98",
               "lateral_acceleration_bias=0.1", "cg_shift=0.05"]
SEED = 3


def states(p, count: int = 50) -> np.ndarray:
    """Random states about straight driving at SPEED."""
    draw = np.random.default_rng(7)
    start = np.array(init_mb([0.0, 0.0, 0.0, SPEED, 0.3, 0.0, 0.0], p), float)
    spread = np.full(BODY_STATES, 0.03)
    spread[23:27] = 1.0
    return start + spread * draw.standard_normal((count, BODY_STATES))


def circle(angle: float, count: int = 800) -> Programme:
    """A circle reached within a second. angle: of the road wheels with a steering ratio of 15.5 [rad]."""
    zero = np.zeros(count)
    return Programme(np.minimum(0.01 * np.arange(count), 1.0) * angle * 15.5, zero, zero, zero + SPEED, zero)


def steady_yaw_rate(v: VehicleParameters, steering_angle: float) -> float:
    """Steady yaw rate [rad/s] of the linear single-track model at SPEED for a steering wheel angle [rad]."""
    front, rear = v.cornering_stiffness_front, v.cornering_stiffness_rear
    gradient = v.mass * (v.cg_to_rear_axle * rear - v.cg_to_front_axle * front) / (v.wheelbase**2 * front * rear)
    return SPEED * v.road_wheel_angle(steering_angle) / (v.wheelbase * (1 + gradient * SPEED**2))


@pytest.mark.parametrize("car", CARS)
def test_multibody_equations_equal_those_of_vehiclemodels(car):
    p, own = setup_vehicle_parameters(CARS[car].number), parameters_of(car, {})
    for x in states(p):
        # Within the limit of the steering rate in the package; here it is wider.
        for u in ((0.0, 0.0), (0.3, 2.0), (-0.2, -5.0)):
            np.testing.assert_array_equal(dynamics(x.copy(), u, own), vehicle_dynamics_mb(list(x), list(u), p))
            np.testing.assert_array_equal(rates(x.copy(), *u, FLAT_AND_CALM, own, 0.0, True),
                                          vehicle_dynamics_mb(list(x), list(u), p))


@pytest.mark.slow
@pytest.mark.parametrize("car", ["escort"])
def test_steady_yaw_rate_of_the_multibody_car_is_that_of_its_vehicle_file(car):
    for angle in (0.05, -0.05):
        p = circle(angle)
        healthy = drive_multibody(car, {}, p, 1).rows[-1, YAW_RATE]
        expected = steady_yaw_rate(vehicle_of(car), p.steering_wheel[-1])
        assert healthy == pytest.approx(expected, rel=TOLERANCE)
        for hidden in ({"cg_shift": 0.2}, {"front_stiffness_factor": 0.7}, {"rear_stiffness_factor": 0.75},
                       {"steering_ratio_factor": 1.1}, {"steering_offset": 0.006}):
            change = drive_multibody(car, hidden, p, 1).rows[-1, YAW_RATE] / healthy
            predicted = steady_yaw_rate(vehicle_of(car, hidden), p.steering_wheel[-1]) / expected
            assert change == pytest.approx(predicted, abs=TOLERANCE), hidden
            # The stiffness of these tyres is proportional to the load, so a shift of the CG has almost no effect.
            assert abs(change - 1) > (0.05 if "cg_shift" not in hidden else 0.001), hidden


def programme(count: int) -> Programme:
    t = 0.01 * np.arange(count)
    return Programme(1.5 * np.sin(4 * t), 0.0 * t, 0.0 * t, 10.0 - 2.0 * t, np.full(count, -2.0))


def simulate_in_python(settings, p: Programme):
    """The same drive with the classes of st_sim: states, INS readings, steering wheel angles."""
    plant = Plant(NOMINAL, settings, SEED)
    plant.place(0.0, 0.0, 0.0, float(p.speed[0]))
    ins, steering = Ins(NOMINAL, settings, 0.01, SEED), SteeringSensor(NOMINAL, settings, SEED)
    steering_angle = pedal = 0.0
    states, readings, angles = [], [], []
    for k in range(len(p.steering_wheel)):
        s, truth = plant.state, plant.observe(NOMINAL.mass * pedal, 0.01 * k, steering_angle)
        r = ins.read(truth)
        states.append(s)
        readings.append((r.x, r.y, r.z, r.velocity_x, r.velocity_y, r.velocity_z, r.yaw, r.roll, r.pitch, *r.rates,
                         *r.specific_force))
        bend = abs(s[VX] * s[YAW_RATE] * math.sin(s[RACK])) * NOMINAL.cg_to_rear_axle / NOMINAL.wheelbase
        target = p.acceleration[k] + 1.2 * (p.speed[k] - s[VX]) + bend - s[VY] * s[YAW_RATE]
        target = min(max(target, -7.0), 3.5)
        pedal += min(max(target - pedal, -0.1), 0.1)
        for i in range(STEPS_PER_SAMPLE):
            steering_angle += min(max(p.steering_wheel[k] - steering_angle, -8.0 * STEP), 8.0 * STEP)
            if i == 0:
                angles.append(steering.read(replace(truth, steering_wheel_angle=steering_angle)))
            plant.step(steering_angle, NOMINAL.mass * pedal)
    return np.array(states), np.array(readings), np.array(angles)


@pytest.mark.slow
def test_compiled_car_and_sensors_equal_the_virtual_car():
    settings, p = resolve_settings("realistic", ALL_EFFECTS), programme(250)
    states, readings, angles = simulate_in_python(settings, p)
    recording = drive(NOMINAL, settings, p, SEED)
    np.testing.assert_allclose(recording.rows[:, :STATES], states, rtol=0, atol=1e-9)
    assert np.ptp(states[:, YAW]) > 0.1
    compiled = make_readings(recording, NOMINAL, settings, SEED)
    np.testing.assert_allclose(np.array([compiled[name] for name in CHANNELS]).T, readings, rtol=0, atol=1e-9)
    log = make_log("drive", recording, NOMINAL, LEAF, settings, SEED)
    assert np.abs(log.steering_wheel_angle - angles).max() <= np.radians(0.05) + 1e-12
    assert np.abs(log.yaw_rate - readings[:, 11]).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["leaf", "escort"])
def test_both_plants_respond_to_a_hidden_relation(plant):
    car = healthy_car(plant, (1, 2))
    vehicle = vehicle_of_plant(plant, car.settings)
    order = RunPlan("run", (5, 6), car.settings)
    reference = record_run(plant, vehicle, order)
    without, with_moment = (record_run(plant, vehicle, replace(order, relation=Relation(kind, 0.001)))
                    for kind in (relation_equations.NOTHING, relation_equations.AIR_MOMENT))
    assert np.array_equal(reference.yaw_rate, without.yaw_rate)
    yaw_acceleration = np.gradient((with_moment.yaw_rate - reference.yaw_rate)[:30], 0.01)[:8].mean()
    # The axles of the multi-body car are separate masses, connected by springs.
    assert 0.4 < yaw_acceleration / (0.001 * float(reference.velocity_x[0]) ** 2) < 1.1


def test_resimulated_drive_is_predicted_by_its_model() -> None:
    recorded = record_run("leaf", LEAF, RunPlan("drive", (SEED,), healthy_car("leaf", (SEED,)).settings))
    log = resimulate(recorded, LEAF, SEED)
    assert np.ptp(log.yaw) > 0.5 and log.duration > recorded.duration - 2.0
    error = evaluate_log(("nonlinear",), LEAF, log).errors["nonlinear", "hindsight"]
    assert error.n_starts > 50 and error.statistics("lateral")[2] < 0.05
