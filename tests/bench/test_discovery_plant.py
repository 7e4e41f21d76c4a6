"""The compiled virtual car of the blind benchmark is the virtual car: same states, same readings, same noise."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.effects import EFFECTS
from st_sim.dynamics import RACK, STATES, VX, VY, YAW, YAW_RATE
from st_sim.plant import STEP, Plant, Truth
from st_sim.sensors import Ins, SteeringSensor
from st_sim.settings import resolve

from bench.discovery import programmes as m
from bench.discovery.compiled import DECIDE, Programme, Stopped, drive
from bench.discovery.effects import BY_NAME, KNOWN
from bench.discovery.plants import LEAF, NOMINAL
from bench.discovery.sensing import CHANNELS, log_of, readings

# Compiling the car takes some seconds.
pytestmark = pytest.mark.slow

EVERYTHING = ["gust_speed=3", "wind_speed=4", "camber_thrust=0.3", "rear_roll_steer=0.02", "steering_backlash=0.02",
              "steering_delay=0.03", "terrain_wave=0.02", "hillside_slope=0.01", "friction_patch=0.8",
              "ins_misalignment=0.01", "ins_lever_error=0.2", "yaw_rate_scale=1.02", "velocity_scale=0.98",
              "lateral_acceleration_bias=0.1", "cg_shift=0.05"]
SEED = 3


def programme(count: int) -> Programme:
    t = 0.01 * np.arange(count)
    return Programme(1.5 * np.sin(4 * t), 0.0 * t, 0.0 * t, 10.0 - 2.0 * t, np.full(count, -2.0))


def by_the_plant(settings, p: Programme):
    """The same drive in Python: states, and what the sensors of st_sim read."""
    plant = Plant(NOMINAL, settings, SEED)
    plant.place(0.0, 0.0, 0.0, float(p.speed[0]))
    ins, steering = Ins(NOMINAL, settings, 0.01, SEED), SteeringSensor(NOMINAL, settings, SEED)
    hand = pedal = 0.0
    states, read, angles = [], [], []
    for k in range(len(p.hand)):
        s, f, here = plant.state, plant.observe(NOMINAL.mass * pedal), plant.here
        truth = Truth(0.01 * k, *s[:4], s[VX], s[VY], s[YAW_RATE], f.acceleration_x, f.acceleration_y,
                      f.yaw_acceleration, hand, 0.0, velocity_z=f.velocity_z, roll=plant.body_roll + here.bank_angle,
                      pitch=plant.body_pitch + here.grade_angle,
                      roll_rate=settings["roll_gradient"] * s[14])
        r = ins.read(truth)
        states.append(s)
        read.append((r.x, r.y, r.z, r.velocity_x, r.velocity_y, r.velocity_z, r.yaw, r.roll, r.pitch, *r.rates,
                     *r.specific_force))
        bend = abs(s[VX] * s[YAW_RATE] * math.sin(s[RACK])) * NOMINAL.cg_to_rear_axle / NOMINAL.wheelbase
        target = p.acceleration[k] + 1.2 * (p.speed[k] - s[VX]) + bend - s[VY] * s[YAW_RATE]
        target = min(max(target, -7.0), 3.5)
        pedal += min(max(target - pedal, -0.1), 0.1)
        for i in range(DECIDE):
            hand += min(max(p.hand[k] - hand, -8.0 * STEP), 8.0 * STEP)
            if i == 0:
                angles.append(steering.read(replace(truth, steering_wheel_angle=hand)))
            plant.step(hand, NOMINAL.mass * pedal)
    return np.array(states), np.array(read), np.array(angles)


def test_compiled_car_and_its_sensors_are_those_of_the_simulation():
    settings, p = resolve("realistic", EVERYTHING), programme(250)
    states, read, angles = by_the_plant(settings, p)
    recording = drive(NOMINAL, settings, p, SEED)
    np.testing.assert_allclose(recording.rows[:, :STATES], states, rtol=0, atol=1e-9)
    assert np.ptp(states[:, YAW]) > 0.1
    mine = readings(recording, NOMINAL, settings, SEED)
    np.testing.assert_allclose(np.array([mine[name] for name in CHANNELS]).T, read, rtol=0, atol=1e-9)
    log = log_of("drive", recording, NOMINAL, LEAF, settings, SEED)
    assert np.abs(log.steering_wheel_angle - angles).max() <= np.radians(0.05) + 1e-12
    assert np.abs(log.yaw_rate - read[:, 11]).max() < 1e-5


def test_an_effect_that_begins_later_is_not_there_before():
    healthy, p = resolve("realistic"), programme(300)
    faulty = {**healthy, "steering_offset": 0.01}
    plain, later, whole = (drive(NOMINAL, first, p, SEED, then).rows for first, then in (
        (healthy, None), (healthy, (faulty, 150)), (faulty, None)))
    np.testing.assert_array_equal(later[:150], plain[:150])
    assert np.abs(later[-1] - plain[-1]).max() > 0.01
    assert np.abs(later[-1] - whole[-1]).max() > 0.01


def test_a_car_that_stops_is_refused():
    t = 0.01 * np.arange(600)
    with pytest.raises(Stopped):
        drive(NOMINAL, resolve("realistic"), Programme(0 * t, 0 * t, 0 * t, 3.0 - 2.0 * t, 0 * t - 2.0), SEED)


def test_ordinary_roads_are_held_by_the_hand():
    b = m.Builder(NOMINAL, np.random.default_rng(1), 10.0)
    b.go_to(10.0)
    m.ordinary(b, 1.5)
    wanted = b.programme()
    for effects in ([], ["steering_offset=0.006"]):
        rows = drive(NOMINAL, resolve("realistic", effects), wanted, SEED).rows
        assert abs(rows[-1, YAW] - wanted.yaw[-1]) < 0.15


def test_the_table_of_effects_names_the_library():
    assert set(BY_NAME) <= set(EFFECTS)
    assert len(BY_NAME) == len(KNOWN) == 26
    settings = {**resolve("realistic"), "yaw_rate_bias": 0.0}
    for hidden in KNOWN:
        start = {**settings, **(hidden.with_ or {})}
        for sign in hidden.signs:
            assert hidden.applied(start, 1.0, sign)[hidden.setting] != start[hidden.setting], hidden
