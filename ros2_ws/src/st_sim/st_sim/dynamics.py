"""Equations of motion and tyre forces of the virtual car as pure functions, which bench/plants compiles with numba.

Axes, signs and equations: see `plant`. Checked by: test_plant.py, test_tyres.py.
"""

from collections.abc import Sequence
from math import atan, cos, hypot, sin, sqrt
from typing import Any, NamedTuple

from st_core.tyres import MagicFormula
from st_core.vehicle import VehicleParameters

from .settings import Settings

GRAVITY = 9.81  # m/s^2, as in st_core
TRACK_WIDTH = 1.54  # m, both axles, for every vehicle file; Leaf ZE0 by its manufacturer: 1.540 m front, 1.535 m rear
AIR_DENSITY = 1.2  # kg/m^3
SIDE_FORCE_AREA = 2.5  # m^2, side force coefficient (0.53) times the Leaf's side area (4.7 m^2)
WIND_ARM = 0.25  # m from the CG forward to the point at which the side force of the wind acts
FRONT_BRAKE_FRACTION = 0.65  # fraction of the brake force at the front axle
FRONT_TRANSFER_FRACTION = 0.55  # fraction of the lateral load transfer at the front axle
MIN_LOAD = 50.0  # N, lower limit of a wheel load: a lifted wheel must not cause a division by zero
MAX_PEAK_FRACTION = 0.98  # largest longitudinal force of a tyre as a fraction of its peak force D
MIN_SLIP_SPEED = 0.5  # m/s, lower limit of the denominator of slip; the time step permits no lower one
CREEP_SPEED = 2.5  # m/s; below it a tyre with relaxation has little damping, so CREEP_DAMPING is added
CREEP_DAMPING = 0.17  # s/m, slip per lateral sliding speed
ROLL_FREQUENCY, ROLL_DAMPING = 12.6, 0.4  # rad/s (2 Hz) and damping ratio of body roll and lateral load transfer
PITCH_TIME, COMPLIANCE_TIME = 0.08, 0.01  # s, time constants of pitch and longitudinal load transfer, and of compliance
ROLLING_ONSET = 0.2  # m/s; below it the rolling resistance decreases to 0, so that it cannot move a parked car

# Indices of the state tuple. RACK, COMPLIANCE_ANGLE: road-wheel angles [rad]; S_FL to S_RR: tangents of the transient
# slip angles; A_Y, A_X: specific force at the CG [m/s^2], filtered by the roll and pitch dynamics.
X, Y, Z, YAW, VX, VY, YAW_RATE, RACK, COMPLIANCE_ANGLE, S_FL, S_FR, S_RL, S_RR, A_Y, A_Y_RATE, A_X = range(16)
STATES = A_X + 1

TyreCoefficients = tuple[float, ...]
"""F_z0 [N], C, p_ky1 F_z0 lambda_ky [N/rad], 1 / (p_ky2 F_z0) [1/N], p_ky4, p_dy1, p_dy2 (both scaled by lambda_muy),
p_ey1, p_ey2, p_ey3; see `tyre_force`."""


class Constants(NamedTuple):
    """Parameters of the equations of motion [SI]; see SETTINGS."""

    mass: float
    yaw_inertia: float
    to_front: float  # from the CG to the axle
    to_rear: float  # from the CG to the axle
    steering_lag: float
    steering_offset: float
    steering_compliance: float
    roll_steer: float
    rear_roll_steer: float
    roll_gradient: float
    camber_thrust: float
    ackermann: float  # (left - right front wheel angle) / 2 / squared sine of their mean
    max_relaxation_rate: float  # limit for a stable integration [1/s]
    relaxation_length: float
    combined_slip: float
    rolling_resistance: float
    drag_area: float
    drive_offset: float
    transfer_x: float  # load change of one wheel per a_x [kg]
    transfer_y: float  # load change of both wheels of a side per a_y [kg]
    static_front: float  # static load of one wheel [N]
    static_rear: float  # static load of one wheel [N]
    still_air: bool
    front: TyreCoefficients
    rear: TyreCoefficients


def make_constants(car: VehicleParameters, settings: Settings, step: float) -> Constants:
    """Parameters of a car with its settings, for integration with a time step [s]."""
    s = settings
    mass = car.mass * s["mass_factor"]
    to_front = car.cg_to_front_axle - s["cg_shift"]
    to_rear = car.wheelbase - to_front
    values: dict[str, Any] = {name: s[name] for name in Constants._fields if name in s} | dict(
        mass=mass, yaw_inertia=car.yaw_inertia * s["yaw_inertia_factor"], to_front=to_front, to_rear=to_rear,
        steering_lag=max(s["steering_lag"], step) if s["steering_lag"] else 0.0,  # a lag below half a step is unstable
        ackermann=s["ackermann"] * TRACK_WIDTH / (2 * car.wheelbase), max_relaxation_rate=1.0 / step,
        transfer_x=s["longitudinal_load_transfer"] * mass * car.cg_height / car.wheelbase / 2,
        transfer_y=s["lateral_load_transfer"] * mass * car.cg_height / TRACK_WIDTH,
        static_front=mass * GRAVITY * to_rear / car.wheelbase / 2,
        static_rear=mass * GRAVITY * to_front / car.wheelbase / 2,
        still_air=not (s["wind_speed"] or s["gust_speed"]),
        front=make_tyre_coefficients(car.tyre_front, s["front_stiffness_factor"]),
        rear=make_tyre_coefficients(car.tyre_rear, s["rear_stiffness_factor"]))
    return Constants(**values)


def make_tyre_coefficients(tyre: MagicFormula, stiffness_factor: float) -> TyreCoefficients:
    """Coefficients of one tyre with its cornering stiffness K scaled by a factor."""
    nominal = tyre.nominal_load
    stiffness = tyre.p_ky1 * nominal * tyre.lambda_ky * stiffness_factor
    return (nominal, tyre.p_cy1 * tyre.lambda_cy, stiffness, 1.0 / (tyre.p_ky2 * nominal), tyre.p_ky4,
            tyre.p_dy1 * tyre.lambda_muy, tyre.p_dy2 * tyre.lambda_muy, tyre.p_ey1, tyre.p_ey2, tyre.p_ey3)


def tyre_force(tyre: TyreCoefficients, slip_angle: float, load: float, friction_factor: float) -> tuple[float, float]:
    """Lateral force F_y and its peak D [N] of one tyre; slip_angle a [rad], load F_z [N].

        F_y = D sin(C atan(B a - E (B a - atan(B a)))),  D = mu F_z,  B = K / (C D)
        K = p_ky1 F_z0 sin(p_ky4 atan(F_z / (p_ky2 F_z0))) lambda
        mu = p_dy1 + p_dy2 df_z,  E = (p_ey1 + p_ey2 df_z)(1 - p_ey3 sgn a) <= 1,  df_z = F_z / F_z0 - 1

    A slip angle is positive when the wheel slides to its left; the force is then negative (to the right). The friction
    factor scales the peak D but not the slope K.

    Source: the paper's appendix. Checked by: test_tyres.py (slope, peak, load dependency, lambda).
    """
    nominal, shape, stiffness, inverse_load, p_ky4, p_dy1, p_dy2, p_ey1, p_ey2, p_ey3 = tyre
    excess = load / nominal - 1.0
    peak = (p_dy1 + p_dy2 * excess) * friction_factor * load
    curvature = p_ey1 + p_ey2 * excess
    if p_ey3 != 0.0:
        curvature *= 1.0 - p_ey3 * ((slip_angle > 0) - (slip_angle < 0))
    # E > 1, possible at loads lower than measured, would make the force decrease and change its sign beyond the peak.
    curvature = min(curvature, 1.0)
    b_alpha = stiffness * sin(p_ky4 * atan(load * inverse_load)) / (shape * peak) * slip_angle
    return peak * sin(shape * atan(b_alpha - curvature * (b_alpha - atan(b_alpha)))), peak


def lateral_fraction(longitudinal: float, peak: float) -> float:
    """sqrt(1 - (F_x / D)^2), the fraction of the lateral force that remains under F_x; 0 if |F_x| >= D, the peak."""
    ratio = longitudinal / peak
    return sqrt(1.0 - ratio * ratio) if -1.0 < ratio < 1.0 else 0.0


def wheel_forces(contact: tuple[float, float, float], tyre: TyreCoefficients, friction: float, load: float, slip: float,
                 across: float, along: float, drive: float) -> tuple[float, float, float]:
    """Lateral and longitudinal force of one wheel [N], and the time derivative of its transient slip [1/s].

    contact: relaxation length [m], weight of combined slip, largest relaxation rate [1/s]. friction: factor on the
    peak. slip: transient slip (state). across, along: velocity of the contact patch perpendicular to and in the wheel
    plane [m/s]. drive: requested F_x [N], which is limited to MAX_PEAK_FRACTION of the peak.
    """
    relaxation, combined, max_rate = contact
    speed = abs(along)
    slip_speed = speed if speed > MIN_SLIP_SPEED else MIN_SLIP_SPEED
    steady_slip = across / slip_speed
    if relaxation:
        inverse_time = slip_speed / relaxation
        rate = (inverse_time if inverse_time < max_rate else max_rate) * (steady_slip - slip)
        if speed < CREEP_SPEED:
            slip += CREEP_DAMPING * across * (1.0 - speed / CREEP_SPEED)
    else:
        rate, slip = 0.0, steady_slip
    lateral, peak = tyre_force(tyre, atan(slip), load, friction)
    if abs(drive) > MAX_PEAK_FRACTION * peak:
        drive = MAX_PEAK_FRACTION * peak if drive > 0 else -MAX_PEAK_FRACTION * peak
    if combined:
        lateral *= 1.0 - combined + combined * lateral_fraction(drive, peak)
    return lateral, drive, rate


def air_force(still_air: bool, drag_area: float, yaw: float, vx: float, vy: float, wind_x: float,
              wind_y: float) -> tuple[float, float]:
    """Force of the air along body x and y [N], from wind in map axes [m/s]; in still air, sideslip causes no F_y."""
    along, across, speed = -vx, -vy, hypot(vx, vy)
    if still_air:
        return 0.5 * AIR_DENSITY * speed * drag_area * along, 0.0
    cosine, sine = cos(yaw), sin(yaw)
    along, across = along + wind_x * cosine + wind_y * sine, across + wind_y * cosine - wind_x * sine
    airspeed = hypot(along, across)
    side = 0.5 * AIR_DENSITY * SIDE_FORCE_AREA * (airspeed * across + speed * vy)
    return 0.5 * AIR_DENSITY * airspeed * drag_area * along, side


def bring_to_rest(s: Sequence[float], step: float) -> tuple[float, ...]:
    """The state with zero velocity, slip and compliance angle; roll and pitch decay with PITCH_TIME over a step [s]."""
    values = list(s)
    for i in (VX, VY, YAW_RATE, COMPLIANCE_ANGLE, S_FL, S_FR, S_RL, S_RR):
        values[i] = 0.0
    for i in (A_Y, A_Y_RATE, A_X):
        values[i] *= 1.0 - step / PITCH_TIME
    return tuple(values)


# long: the equations share two dozen symbols, and a call per equation would slow down every time step
def derivative(s: Sequence[float], rack_target: float, drive_force: float, conditions: tuple,  # noqa: PLR0915
               c: Constants) -> tuple[tuple, tuple]:
    """(time derivative of the state; mean front road-wheel angle [rad] and, for FL, FR, RL, RR, lateral forces,
    longitudinal forces, loads [N], velocities across and along the wheel plane [m/s]).

    rack_target: [rad]. drive_force: of all wheels [N], < 0: braking. conditions: fields of `plant.Conditions`.
    """
    (mass, yaw_inertia, to_front, to_rear, lag, steering_offset, compliance, roll_steer, rear_roll_steer, roll_gradient,
     camber, ackermann, max_rate, relaxation, combined, rolling, drag_area, drive_offset, transfer_x, transfer_y,
     static_front, static_rear, still_air, front, rear) = c
    (_, _, _, yaw, vx, vy, r, rack, compliance_angle, s_fl, s_fr, s_rl, s_rr, a_y, a_y_rate, a_x) = s
    friction, bank, grade, wind_x, wind_y = conditions
    half_track = TRACK_WIDTH / 2
    roll = roll_gradient * a_y

    steer = rack + steering_offset + roll_steer * roll - compliance_angle
    sine = sin(steer)
    split = ackermann * sine * sine
    steer_l, steer_r = steer + split, steer - split
    cos_l, sin_l, cos_r, sin_r = cos(steer_l), sin(steer_l), cos(steer_r), sin(steer_r)
    steer_rear = rear_roll_steer * roll

    # Loads: static, plus the transfer due to the filtered accelerations.
    normal = cos(bank) * cos(grade)
    pitch_load = transfer_x * a_x
    transfer = transfer_y * a_y
    transfer_front, transfer_rear = FRONT_TRANSFER_FRACTION * transfer, (1.0 - FRONT_TRANSFER_FRACTION) * transfer
    load_front, load_rear = static_front * normal - pitch_load, static_rear * normal + pitch_load
    load_fl, load_fr = max(load_front - transfer_front, MIN_LOAD), max(load_front + transfer_front, MIN_LOAD)
    load_rl, load_rr = max(load_rear - transfer_rear, MIN_LOAD), max(load_rear + transfer_rear, MIN_LOAD)

    # Velocity of each contact patch, rotated into the axes of its wheel.
    left_x, right_x, front_y, rear_y = vx - r * half_track, vx + r * half_track, vy + r * to_front, vy - r * to_rear
    along_fl, across_fl = left_x * cos_l + front_y * sin_l, front_y * cos_l - left_x * sin_l
    along_fr, across_fr = right_x * cos_r + front_y * sin_r, front_y * cos_r - right_x * sin_r
    across_rl, across_rr = rear_y - left_x * steer_rear, rear_y - right_x * steer_rear

    if drive_force >= 0.0:
        drive_front, drive_rear = drive_force / 2, 0.0
    else:
        drive_front, drive_rear = drive_force * FRONT_BRAKE_FRACTION / 2, drive_force * (1.0 - FRONT_BRAKE_FRACTION) / 2
    contact = relaxation, combined, max_rate
    y_fl, x_fl, rate_fl = wheel_forces(contact, front, friction, load_fl, s_fl, across_fl, along_fl, drive_front)
    y_fr, x_fr, rate_fr = wheel_forces(contact, front, friction, load_fr, s_fr, across_fr, along_fr, drive_front)
    y_rl, x_rl, rate_rl = wheel_forces(contact, rear, friction, load_rl, s_rl, across_rl, left_x, drive_rear)
    y_rr, x_rr, rate_rr = wheel_forces(contact, rear, friction, load_rr, s_rr, across_rr, right_x, drive_rear)
    axle_front = y_fl + y_fr
    if camber:
        thrust = camber * roll
        y_fl, y_fr = y_fl - thrust * load_fl, y_fr - thrust * load_fr
        y_rl, y_rr = y_rl - thrust * load_rl, y_rr - thrust * load_rr

    # Forces in body axes. A first-order rotation of the rear wheels is accurate to 2e-4 up to 1 deg of rear steer.
    bx_fl, by_fl = x_fl * cos_l - y_fl * sin_l, x_fl * sin_l + y_fl * cos_l
    bx_fr, by_fr = x_fr * cos_r - y_fr * sin_r, x_fr * sin_r + y_fr * cos_r
    bx_rl, by_rl = x_rl - y_rl * steer_rear, y_rl + x_rl * steer_rear
    bx_rr, by_rr = x_rr - y_rr * steer_rear, y_rr + x_rr * steer_rear

    air_x, air_y = air_force(still_air, drag_area, yaw, vx, vy, wind_x, wind_y)
    resistance = rolling * mass * GRAVITY * normal * min(max(vx / ROLLING_ONSET, -1.0), 1.0)
    specific_x = (bx_fl + bx_fr + bx_rl + bx_rr + air_x - resistance) / mass
    specific_y = (by_fl + by_fr + by_rl + by_rr + air_y) / mass
    moment = (to_front * (by_fl + by_fr) - to_rear * (by_rl + by_rr) + half_track * (bx_fr - bx_fl + bx_rr - bx_rl)
              + WIND_ARM * air_y + drive_offset * drive_force)

    vx_dot = specific_x - GRAVITY * sin(grade) + r * vy
    vy_dot = specific_y - GRAVITY * sin(bank) - r * vx
    r_dot = moment / yaw_inertia
    cos_yaw, sin_yaw = cos(yaw), sin(yaw)
    climb, level_vx = vx * sin(grade) + vy * sin(bank), vx * cos(grade)
    rates = (
        level_vx * cos_yaw - vy * sin_yaw, level_vx * sin_yaw + vy * cos_yaw, climb, r, vx_dot, vy_dot, r_dot,
        (rack_target - rack) / lag if lag else 0.0,
        (compliance * axle_front - compliance_angle) / COMPLIANCE_TIME if compliance else 0.0,
        rate_fl, rate_fr, rate_rl, rate_rr,
        a_y_rate, ROLL_FREQUENCY * (ROLL_FREQUENCY * (specific_y - a_y) - 2 * ROLL_DAMPING * a_y_rate),
        (specific_x - a_x) / PITCH_TIME)
    wheels = (steer, (y_fl, y_fr, y_rl, y_rr), (x_fl, x_fr, x_rl, x_rr), (load_fl, load_fr, load_rl, load_rr),
              (across_fl, across_fr, across_rl, across_rr), (along_fl, along_fr, left_x, right_x))
    return rates, wheels
