"""The compiled virtual car: the equations of st_sim, driven by a programme instead of a driver.

The order is that of `Plant.step`: steering wheel -> delay -> play -> ratio -> lag, step of Heun's method. Standstill
is not simulated: the drive of a car that stops is rejected. Checked by: tests/bench/test_discovery_plants.py.
"""

from dataclasses import dataclass
from functools import cache
from math import exp, sin, sqrt

import numba
import numpy as np
from numba.extending import register_jitable
from st_core.backends import numba_cache
from st_core.vehicle import VehicleParameters
from st_sim.dynamics import RACK, STATES, VX, VY, YAW, YAW_RATE, X, Z, derivative, make_constants
from st_sim.plant import GUST_TIME, STANDSTILL_SPEED, STEP, Plant, evaluate_road, make_normal_source, make_road
from st_sim.settings import Settings

from .relation_equations import Car as Body
from .relation_equations import Relation, relation_accelerations

STEPS_PER_SAMPLE = 5
"""Integration steps between two samples, 0.01 s apart, at which the driver also acts."""
MAX_STEERING_WHEEL_RATE = 8.0  # rad/s
SPEED_GAIN, MAX_BRAKING, MAX_DRIVE, JERK = 1.2, 7.0, 3.5, 10.0
"""[1/s, m/s^2, m/s^2, m/s^3] of the pedals, as for the driver of st_sim."""
RECORDED = STATES + 4
"""State, then the derivatives of v_x, v_y, yaw rate and z."""
NO_RELATION = Relation()


class DriveFailed(Exception):
    """A drive that cannot be used: the car stopped, spun or tipped over."""


@dataclass(frozen=True)
class Programme:
    """Commands of the driver every 0.01 s from the start; all arrays have the same length."""

    steering_wheel: np.ndarray  # steering wheel angle, left + [rad]
    yaw: np.ndarray  # target heading [rad], relative to the heading at which its control begins
    gain: np.ndarray  # road wheel angle per heading error [1], 0 without control of the heading
    speed: np.ndarray  # [m/s]
    acceleration: np.ndarray  # derivative of the speed [m/s^2]


@dataclass(frozen=True)
class Recording:
    """True motion every 0.01 s."""

    rows: np.ndarray  # (n, RECORDED)
    steering_wheel: np.ndarray  # angle one step after each row [rad], at which the steering sensor samples
    bank: np.ndarray  # angle of the road [rad]
    grade: np.ndarray  # angle of the road [rad]


def drive(car: VehicleParameters, settings: Settings, programme: Programme, seed: int,
          later: tuple[Settings, int] | None = None, relation: Relation = NO_RELATION) -> Recording:
    """Drives a programme. later: (other settings, sample at which they begin). relation: see
    `relation_equations`. Raises DriveFailed."""
    parts = [(settings, len(programme.steering_wheel))] if later is None else [
        (settings, later[1]), (later[0], len(programme.steering_wheel) - later[1])]
    plant = Plant(car, settings, seed)
    plant.place(0.0, 0.0, float(programme.yaw[0]), float(programme.speed[0]))
    # State, steering wheel, pedal, position within the play, two gusts, heading offset, gain; the plant has used
    # four random numbers for the gusts.
    state = np.array([*plant.state, 0.0, 0.0, 0.0, plant.conditions.wind_x,
                      plant.conditions.wind_y - settings["wind_speed"], 0.0, 1.0])
    draw = make_normal_source(np.random.default_rng([seed, 1]))
    for _ in range(4):
        draw()
    out = np.empty((len(programme.steering_wheel), RECORDED + 3))
    kernel = compile_loop(_loop)
    first = 0
    for s, count in parts:
        steps = count * STEPS_PER_SAMPLE
        gusts = np.array([draw() for _ in range(2 * steps)]) if s["gust_speed"] else np.zeros(2)
        delayed = np.full(round(s["steering_delay"] / STEP), state[STATES])
        options = np.array([car.mass, car.wheelbase, car.cg_to_rear_axle, car.steering_ratio,
                            car.steering_ratio * s["steering_ratio_factor"], s["steering_backlash"] / 2,
                            s["wind_speed"], s["gust_speed"]])
        part = slice(first, first + count)
        arrays = [np.ascontiguousarray(getattr(programme, name)[part], float)
                  for name in ("steering_wheel", "yaw", "gain", "speed", "acceleration")]
        c = make_constants(car, s, STEP)
        body = Body(c.to_front, c.to_rear, c.yaw_inertia / c.mass, car.cornering_stiffness_rear / c.mass)
        finished = kernel(state, options, c, make_road(s), relation, body, first, delayed, gusts, *arrays, out[part])
        if not finished:
            raise DriveFailed
        first += count
    return Recording(out[:, :RECORDED], out[:, RECORDED], out[:, RECORDED + 1], out[:, RECORDED + 2])


@cache
def compile_loop(loop):
    """Compiles a loop and all functions that it calls; the machine code is cached on the disk."""
    for function in numba_cache.find_reachable_functions(loop)[:-1]:
        register_jitable(function)
    kernel = numba.njit(error_model="numpy")(loop)
    numba_cache.enable_cache(kernel, numba_cache.compute_fingerprint(loop))
    return kernel


def control_pedals(pedal, speed, acceleration, motion, rear, wheelbase):
    """The next longitudinal acceleration that the pedals request [m/s^2].

    pedal: the previous one. speed [m/s], acceleration [m/s^2]: targets. motion: v_x, v_y [m/s], yaw rate [rad/s], road
    wheel angle [rad]. rear: distance from CG to rear axle [m]. The longitudinal force of the steered wheels in a bend
    is compensated.
    """
    vx, vy, r, steer = motion
    bend = abs(vx * r * sin(steer)) * rear / wheelbase
    target = acceleration + SPEED_GAIN * (speed - vx) + bend - vy * r
    target = min(max(target, -MAX_BRAKING), MAX_DRIVE)
    max_change = JERK * STEPS_PER_SAMPLE * STEP
    return pedal + min(max(target - pedal, -max_change), max_change)


def _tuple(s):
    return (s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11], s[12], s[13], s[14], s[15])


def _add_relation(rates, s, relation, body, time, ax):
    """The rates of the state with the accelerations of a relation."""
    lateral, yaw = relation_accelerations(relation, body, time, s[VX], s[YAW_RATE], ax, rates[VY], rates[YAW_RATE])
    return (rates[0], rates[1], rates[2], rates[3], rates[4], rates[5] + lateral, rates[6] + yaw, rates[7], rates[8],
            rates[9], rates[10], rates[11], rates[12], rates[13], rates[14], rates[15])


# One kernel compiled as a whole: its parts share the state of driver, actuator, gusts and body.
def _loop(state, options, c, road, relation, body, first, delayed, gusts,  # noqa: PLR0912, PLR0915
          steering, yaw, gain, speed, acceleration, out):
    mass, wheelbase, rear, nominal_ratio, ratio, play, wind, gust = options
    memory = exp(-STEP / GUST_TIME)
    kick = gust * sqrt(1.0 - memory * memory)
    s, middle, k1 = state[:STATES].copy(), state[:STATES].copy(), state[:STATES].copy()
    angle, pedal, after_play, gust_x, gust_y, heading_offset, previous_gain = state[STATES:]
    oldest, drawn = 0, 0
    force = mass * pedal
    friction, bank, grade = evaluate_road(road, s[X], s[YAW])
    for k in range(len(steering)):
        rates, _ = derivative(_tuple(s), s[RACK], force, (friction, bank, grade, gust_x, wind + gust_y), c)
        if relation[0]:
            rates = _add_relation(rates, s, relation, body, (first + k) * STEPS_PER_SAMPLE * STEP, pedal)
        for i in range(STATES):
            out[k, i] = s[i]
        out[k, STATES], out[k, STATES + 1], out[k, STATES + 2] = rates[VX], rates[VY], rates[YAW_RATE]
        out[k, STATES + 3] = rates[Z]
        out[k, RECORDED + 1], out[k, RECORDED + 2] = bank, grade
        if gain[k] and not previous_gain:
            heading_offset = s[YAW] - yaw[k]
        previous_gain = gain[k]
        target = steering[k] + gain[k] * (yaw[k] + heading_offset - s[YAW]) * nominal_ratio
        pedal = control_pedals(pedal, speed[k], acceleration[k], (s[VX], s[VY], s[YAW_RATE], s[RACK]), rear, wheelbase)
        force = mass * pedal
        for step in range(STEPS_PER_SAMPLE):
            angle += min(max(target - angle, -MAX_STEERING_WHEEL_RATE * STEP), MAX_STEERING_WHEEL_RATE * STEP)
            if step == 0:
                out[k, RECORDED] = angle
            friction, bank, grade = evaluate_road(road, s[X], s[YAW])
            if gust:
                gust_x, gust_y = memory * gust_x + kick * gusts[drawn], memory * gust_y + kick * gusts[drawn + 1]
                drawn += 2
            conditions = (friction, bank, grade, gust_x, wind + gust_y)
            late = angle
            if len(delayed):
                late, delayed[oldest] = delayed[oldest], angle
                oldest = (oldest + 1) % len(delayed)
            if play:
                after_play = min(max(after_play, late - play), late + play)
                late = after_play
            rack = late / ratio
            if c.steering_lag == 0.0:
                s[RACK] = rack
            rates, _ = derivative(_tuple(s), rack, force, conditions, c)
            if relation[0]:
                rates = _add_relation(rates, s, relation, body, (first + k) * STEPS_PER_SAMPLE * STEP, pedal)
            for i in range(STATES):
                k1[i] = rates[i]
                middle[i] = s[i] + STEP * rates[i]
            rates, _ = derivative(_tuple(middle), rack, force, conditions, c)
            if relation[0]:
                rates = _add_relation(rates, middle, relation, body, (first + k) * STEPS_PER_SAMPLE * STEP, pedal)
            for i in range(STATES):
                s[i] += STEP / 2 * (k1[i] + rates[i])
            if s[VX] < STANDSTILL_SPEED:
                return False
    for i in range(STATES):
        state[i] = s[i]
    state[STATES], state[STATES + 1], state[STATES + 2] = angle, pedal, after_play
    state[STATES + 3], state[STATES + 4] = gust_x, gust_y
    state[STATES + 5], state[STATES + 6] = heading_offset, previous_gain
    return True
