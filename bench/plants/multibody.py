"""The second plant of the benchmark: a multi-body car of 29 states from another project.

    x' = f(x, steering rate, acceleration)  of commonroad-vehicle-models, midpoint rule

It has the same programmes and sensors as the virtual car. Its equations are extended by the steering chain (steering
wheel -> delay -> play -> ratio -> lag -> offset), and by gravity on a slope and wind as in st_sim, which act on the
masses and on the CG of the body. Drives in which the car nearly stops or tips over are rejected.
Checked by: tests/bench/test_discovery_plants.py.
"""

from collections.abc import Mapping
from math import exp, sin, sqrt
from typing import NamedTuple

import numpy as np
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.dynamics import A_X, A_Y, A_Y_RATE, GRAVITY, STATES, VX, VY, WIND_ARM, YAW, YAW_RATE, X, Y, Z, air_force
from st_sim.plant import GUST_TIME, evaluate_road, make_normal_source, make_road
from vehiclemodels.init_mb import init_mb

from .leaf import (
    MAX_STEERING_WHEEL_RATE,
    NO_RELATION,
    RECORDED,
    DriveFailed,
    Programme,
    Recording,
    compile_loop,
    control_pedals,
)
from .multibody_car import (
    complete_settings,
    cornering_stiffness,
    dynamics,
    nominal_car,
    parameters_of,
    rest_pitch,
    static_loads,
)
from .relation_equations import Car as Body
from .relation_equations import Relation, relation_accelerations, reshape_rear_tyre
from .sensing import PERIOD, STEERING_PHASE, make_log

STEP = 0.001
"""Integration step [s]. Half of it changes a path of 9 s by less than 1 mm, 5 ms by 0.3 m, because the spin of a wheel
settles within 2 ms at low speed."""
STEPS_PER_SAMPLE, STEERING_SAMPLE_STEP = round(PERIOD / STEP), round(STEERING_PHASE / STEP) - 1
"""Steps between two samples, at which the driver also acts; the step after which the steering sensor samples."""
MIN_SPEED = 2.5  # m/s
MAX_ROLL = 0.25  # rad; above it wheels lift, for which the package has no equations
SETTLING_TIME = 2.0  # s of straight driving on a level road before the drive begins

# Positions in the state of the package, where they differ from st_sim's.
P_STEER, P_VX, P_YAW, P_YAW_RATE, P_ROLL, P_ROLL_RATE, P_PITCH, P_VY, P_Z, P_VZ = 2, 3, 4, 5, 6, 7, 8, 10, 11, 12
P_VY_FRONT, P_VY_REAR = 15, 20
BODY_STATES = 29


class Options(NamedTuple):
    """Parameters of sensors, steering and air."""

    level: float  # pitch of the car at rest [rad], at which the INS was levelled
    nominal: float  # steering ratio of the programme
    ratio: float  # that of the car
    play: float  # half of the play at the steering wheel [rad]
    memory: float  # fraction of the error of the rack position that remains after a step, for the lag
    offset: float  # at the road wheels [rad]
    to_rear: float  # [m]
    wheelbase: float  # [m]
    drag_area: float  # [m^2]
    still_air: bool  # whether there is no wind
    wind: float  # towards north [m/s]
    gust: float  # standard deviation of the wind [m/s]


def drive_multibody(car: str, settings: Mapping[str, float], programme: Programme, seed: int,
                    later: tuple[Mapping[str, float], int] | None = None,
                    relation: Relation = NO_RELATION) -> Recording:
    """Drives a programme for `nominal_car(car)` with a car of `multibody_car.CARS`.

    settings: changes of HEALTHY. later: (other settings, sample at which they begin). The recording has the
    columns of the virtual car, with roll [rad] as A_Y and pitch [rad] as A_X, so that `sensing.make_log` can be used.
    Raises DriveFailed; ValueError for a setting that this plant does not have.
    """
    count = len(programme.steering_wheel)
    parts = [(settings, 0, count)] if later is None else [(settings, 0, later[1]), (later[0], later[1], count)]
    draw = make_normal_source(np.random.default_rng([seed, 1]))
    out = np.empty((count, RECORDED + 3))
    state = _settle(car, settings, programme)
    state[BODY_STATES + 4] = complete_settings(settings)["gust_speed"] * draw()
    state[BODY_STATES + 5] = complete_settings(settings)["gust_speed"] * draw()
    for chosen, first, end in parts:
        _run(car, complete_settings(chosen), state, programme, slice(first, end), draw, out, relation)
    return Recording(out[:, :RECORDED], out[:, RECORDED], out[:, RECORDED + 1], out[:, RECORDED + 2])


def log_multibody(name: str, car: str, settings: Mapping[str, float], programme: Programme, seed: int,
                  vehicle: VehicleParameters, later: tuple[Mapping[str, float], int] | None = None,
                  relation: Relation = NO_RELATION) -> DriveLog:
    """The log of such a drive. vehicle: the vehicle file of the reader."""
    recording = drive_multibody(car, settings, programme, seed, later, relation)
    after = None if later is None else (complete_settings(later[0]), later[1])
    return make_log(name, recording, nominal_car(car), vehicle, complete_settings(settings), seed, after)


def _settle(car: str, settings: Mapping[str, float], programme: Programme) -> np.ndarray:
    """State of body, driver and steering after the springs have settled, at the origin and straight ahead."""
    s = complete_settings(settings)
    body = {name: s[name] for name in ("mass_factor", "cg_shift")}
    p = parameters_of(car, body)
    speed = float(programme.speed[0])
    # Body; then steering wheel, pedal, position within the play, rack, two gusts, heading error, gain.
    state = np.array([*init_mb([0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0], p), *np.zeros(7), 1.0], float)
    still = np.zeros(round(SETTLING_TIME / PERIOD))
    straight = Programme(still, still, still, still + speed, still)
    _run(car, complete_settings(body), state, straight, slice(None), None, np.empty((len(still), RECORDED + 3)))
    state[[0, 1, P_STEER, P_YAW_RATE, P_VY, P_VY_FRONT, P_VY_REAR]] = 0.0
    state[[P_VX, P_YAW]] = speed, programme.yaw[0]
    state[BODY_STATES:] = [0.0] * 7 + [1.0]
    return state


def _run(car: str, s: Mapping[str, float], state: np.ndarray, programme: Programme, part: slice, draw,
         out: np.ndarray, relation: Relation = NO_RELATION) -> None:
    """Drives a part of the programme; changes `state` and `out`."""
    p, slippery = (parameters_of(car, {**s, "friction_factor": factor})
                   for factor in (s["friction_factor"], s["friction_factor"] * s["friction_patch"]))
    p, slippery = (one._replace(tire_rear=reshape_rear_tyre(one.tire_rear, relation)) for one in (p, slippery))
    stiffness = 2.0 * cornering_stiffness(static_loads(p)[1], p.tire_rear)
    body = Body(p.a, p.b, p.I_z / p.m, stiffness / p.m)
    arrays = [np.ascontiguousarray(getattr(programme, name)[part], float)
              for name in ("steering_wheel", "yaw", "gain", "speed", "acceleration")]
    gust = s["gust_speed"]
    gusts = np.array([draw() for _ in range(2 * STEPS_PER_SAMPLE * len(arrays[0]))]) if gust else np.zeros(2)
    nominal = nominal_car(car).steering_ratio
    lag = s["steering_lag"]
    options = Options(
        level=rest_pitch(p), nominal=nominal, ratio=nominal * s["steering_ratio_factor"],
        play=s["steering_backlash"] / 2, memory=exp(-STEP / lag) if lag else 0.0, offset=s["steering_offset"],
        to_rear=p.b, wheelbase=p.a + p.b, drag_area=s["drag_area"], still_air=not (s["wind_speed"] or gust),
        wind=s["wind_speed"], gust=gust)
    delayed = np.full(round(s["steering_delay"] / STEP), state[BODY_STATES])
    if not compile_loop(_loop)(state, options, p, slippery, make_road(s), relation, body, part.start or 0, delayed,
                               gusts, *arrays, out[part]):
        raise DriveFailed


def _add_relation(f, x, relation, body, time, ax):
    """Adds the accelerations of a relation to the rates f."""
    lateral, turning = relation_accelerations(relation, body, time, x[P_VX], x[P_YAW_RATE], ax, f[P_VY], f[P_YAW_RATE])
    f[P_VY] += lateral
    f[P_VY_FRONT] += lateral
    f[P_VY_REAR] += lateral
    f[P_YAW_RATE] += turning


def rates(x, steering_rate, acceleration, surroundings, p, drag_area, still_air):
    """The 29 rates of the package with slope and wind. surroundings: bank, grade [rad], wind towards x and y of the
    map [m/s]."""
    bank, grade, wind_x, wind_y = surroundings
    f = dynamics(x, (steering_rate, acceleration), p)
    air_x, air_y = air_force(still_air, drag_area, x[P_YAW], x[P_VX], x[P_VY], wind_x, wind_y)
    lateral = -GRAVITY * sin(bank)
    f[P_VX] += air_x / p.m - GRAVITY * sin(grade)
    f[P_VY] += air_y / p.m_s + lateral
    f[P_VY_FRONT] += lateral
    f[P_VY_REAR] += lateral
    f[P_YAW_RATE] += WIND_ARM * air_y / p.I_z
    return f


# One kernel compiled as a whole: its parts share the state of driver, actuator, gusts and body.
def _loop(state, o, p, slippery, road, relation, body, first, delayed, gusts,  # noqa: PLR0912, PLR0915
          steering, yaw, gain, speed, acceleration, out):
    fading = exp(-STEP / GUST_TIME)
    kick = o.gust * sqrt(1.0 - fading * fading)
    x, middle = state[:BODY_STATES].copy(), state[:BODY_STATES].copy()
    angle, pedal, after_play, rack, gust_x, gust_y, heading_offset, previous_gain = state[BODY_STATES:]
    oldest, drawn = 0, 0
    for k in range(len(steering)):
        friction, bank, grade = evaluate_road(road, x[0], x[P_YAW])
        tyres = p if friction == road.friction_factor else slippery
        f = rates(x, 0.0, pedal, (bank, grade, gust_x, o.wind + gust_y), tyres, o.drag_area, o.still_air)
        time = (first + k) * STEPS_PER_SAMPLE * STEP
        if relation[0]:
            _add_relation(f, x, relation, body, time, pedal)
        row = out[k]
        row[:] = 0.0
        row[X], row[Y], row[Z], row[YAW] = x[0], x[1], -x[P_Z], x[P_YAW]
        row[VX], row[VY], row[YAW_RATE] = x[P_VX], x[P_VY], x[P_YAW_RATE]
        row[A_Y], row[A_Y_RATE], row[A_X] = -x[P_ROLL], -x[P_ROLL_RATE], x[P_PITCH] - o.level
        row[STATES], row[STATES + 1], row[STATES + 2], row[STATES + 3] = f[P_VX], f[P_VY], f[P_YAW_RATE], -x[P_VZ]
        row[RECORDED + 1], row[RECORDED + 2] = bank, grade
        if gain[k] and not previous_gain:
            heading_offset = x[P_YAW] - yaw[k]
        previous_gain = gain[k]
        target = steering[k] + gain[k] * (yaw[k] + heading_offset - x[P_YAW]) * o.nominal
        motion = (x[P_VX], x[P_VY], x[P_YAW_RATE], x[P_STEER])
        pedal = control_pedals(pedal, speed[k], acceleration[k], motion, o.to_rear, o.wheelbase)
        for step in range(STEPS_PER_SAMPLE):
            angle += min(max(target - angle, -MAX_STEERING_WHEEL_RATE * STEP), MAX_STEERING_WHEEL_RATE * STEP)
            if step == STEERING_SAMPLE_STEP:
                row[RECORDED] = angle
            friction, bank, grade = evaluate_road(road, x[0], x[P_YAW])
            tyres = p if friction == road.friction_factor else slippery
            if o.gust:
                gust_x, gust_y = fading * gust_x + kick * gusts[drawn], fading * gust_y + kick * gusts[drawn + 1]
                drawn += 2
            surroundings = (bank, grade, gust_x, o.wind + gust_y)
            late = angle
            if len(delayed):
                late, delayed[oldest] = delayed[oldest], angle
                oldest = (oldest + 1) % len(delayed)
            if o.play:
                after_play = min(max(after_play, late - o.play), late + o.play)
                late = after_play
            rack = late / o.ratio + o.memory * (rack - late / o.ratio)
            # The rate that brings the wheels to the rack position within the step.
            turn = (rack + o.offset - x[P_STEER]) / STEP
            f = rates(x, turn, pedal, surroundings, tyres, o.drag_area, o.still_air)
            if relation[0]:
                _add_relation(f, x, relation, body, time, pedal)
            for i in range(BODY_STATES):
                middle[i] = x[i] + STEP / 2 * f[i]
            f = rates(middle, turn, pedal, surroundings, tyres, o.drag_area, o.still_air)
            if relation[0]:
                _add_relation(f, middle, relation, body, time, pedal)
            for i in range(BODY_STATES):
                x[i] += STEP * f[i]
            if not (x[P_VX] > MIN_SPEED and abs(x[P_ROLL]) < MAX_ROLL):
                return False
    for i in range(BODY_STATES):
        state[i] = x[i]
    state[BODY_STATES], state[BODY_STATES + 1], state[BODY_STATES + 2] = angle, pedal, after_play
    state[BODY_STATES + 3], state[BODY_STATES + 4], state[BODY_STATES + 5] = rack, gust_x, gust_y
    state[BODY_STATES + 6], state[BODY_STATES + 7] = heading_offset, previous_gain
    return True
