"""Compiled equations of motion of the cars, and their simulation with a driver on a road.

The state q of all equations begins with x, y [m], yaw [rad], v_x, v_y [m/s] at the CG and yaw rate [rad/s]; further
states follow. wheel: road wheel angle that the driver requests [rad]; force: total longitudinal tyre force [N].
"""

import math

import numpy as np
from numba import njit

from .tyres import magic_1994, magic_slope, side_force
from .vehicles import BRISTLE, ELASTIC, FOUR_WHEELS, GRAVITY, RIGID, ROLLING, TABLE, Parameters

STEP = 0.005  # s, between recorded rows; each is integrated in two steps
STATES = 16
ROW = STATES + 5
VX_DOT, VY_DOT, YAW_RATE_DOT, WHEEL, DRIVE_FORCE = range(STATES, ROW)
"""Columns after the states: derivatives of v_x, v_y and yaw rate, requested road wheel angle, longitudinal force."""
DRAG, ROLLING_RESISTANCE, BRAKE_FRONT = 0.38, 0.011, 0.65
HITCH, DRAWBAR, HITCH_SHARE = 1.0, 3.2, 0.07
"""Tow ball behind the rear axle, axle of the trailer behind the ball [m]; share of its weight on the ball [1]."""


@njit(cache=True)
def tyre_stiffness(stiffness, load_ratio, p):
    """Cornering stiffness of one tyre at its load; for tabulated tyres, the table contains the effect of the load."""
    if p.tyre == TABLE:
        return stiffness / 2
    return stiffness / 2 * load_ratio * (1 - p.load_loss * (load_ratio - 1))


@njit(cache=True)
def axle_force(slip, stiffness, static, load, shift, longitudinal, p):
    """Lateral force of an axle [N]. static, load: mean loads of its tyres [N]; shift: load moved to the right [N]."""
    total = 0.0
    for side in (-1.0, 1.0):
        z = max(load + side * shift, 50.0)
        ratio = z / static
        total += side_force(p.tyre, slip, tyre_stiffness(stiffness, ratio, p), z, longitudinal / 2, p.grip, p.sliding,
                            ratio)
    return total


@njit(cache=True)
def planar_rates(q, fx, fy, moment, p, out):
    """Writes the rates of the six planar states from body forces [N] and yaw moment [N m], with drag and rolling
    resistance."""
    vx, vy, r = q[3], q[4], q[5]
    resistance = DRAG * vx * abs(vx) + ROLLING_RESISTANCE * p.mass * GRAVITY * min(vx / 0.3, 1.0)
    out[0] = vx * math.cos(q[2]) - vy * math.sin(q[2])
    out[1] = vx * math.sin(q[2]) + vy * math.cos(q[2])
    out[2], out[3], out[4] = r, (fx - resistance) / p.mass + r * vy, fy / p.mass - r * vx
    out[5] = moment / p.inertia


@njit(cache=True)
def split_drive_force(force, p):
    """Longitudinal forces of front and rear axle [N]."""
    front = force * (p.drive_front if force > 0 else BRAKE_FRONT)
    return front, force - front


@njit(cache=True)
def rolling(q, wheel, force, p, out):
    """Further states: roll, roll rate, road-wheel angle, slip angle front and rear."""
    rear = p.wheelbase - p.front
    delta = q[8] if p.steer_lag > 0 else wheel
    speed = max(q[3], 0.8)
    ffx, frx = split_drive_force(force, p)
    kinematic_f, kinematic_r = math.atan((q[4] + p.front * q[5]) / speed), math.atan((q[4] - rear * q[5]) / speed)
    static_f, static_r = p.mass * GRAVITY * rear / p.wheelbase / 2, p.mass * GRAVITY * p.front / p.wheelbase / 2
    transfer = p.height / p.wheelbase * force / 2
    shift = (p.roll_stiffness * q[6] + p.roll_damping * q[7]) / p.track
    slip_f, slip_r = q[9], q[10]
    if p.relaxation <= 0:
        slip_f, slip_r = kinematic_f - delta, kinematic_r
    fy = axle_force(slip_f, p.stiffness_front, static_f, static_f - transfer, p.roll_front * shift, ffx, p)
    ry = axle_force(slip_r, p.stiffness_rear, static_r, static_r + transfer, (1 - p.roll_front) * shift, frx, p)
    steered = delta - p.compliance * fy
    c, s = math.cos(steered), math.sin(steered)
    front = fy * c + ffx * s
    planar_rates(q, ffx * c - fy * s + frx, front + ry, p.front * front - rear * ry, p, out)
    ay = (front + ry) / p.mass
    out[6] = q[7]
    out[7] = (p.mass * 0.9 * p.height * (ay + GRAVITY * q[6]) - p.roll_stiffness * q[6] - p.roll_damping * q[7]
              ) / p.roll_inertia
    out[8] = (wheel - q[8]) / p.steer_lag if p.steer_lag > 0 else 0.0
    if p.relaxation > 0:
        out[9] = max(speed, 3.0) / p.relaxation * (kinematic_f - steered - q[9])
        out[10] = max(speed, 3.0) / p.relaxation * (kinematic_r - q[10])


@njit(cache=True)
def four_wheels(q, wheel, force, p, out):
    """Further states: lateral and longitudinal acceleration that determine the loads, road-wheel angle."""
    rear = p.wheelbase - p.front
    half = p.track / 2
    forces = split_drive_force(force, p)
    total_x, total_y, moment, steered = 0.0, 0.0, 0.0, 0.0
    for axle in range(2):
        front = axle == 0
        x = p.front if front else -rear
        static = p.mass * GRAVITY * (rear if front else p.front) / p.wheelbase / 2
        stiffness = p.stiffness_front if front else p.stiffness_rear
        lateral = (p.roll_front if front else 1 - p.roll_front) * p.mass * q[6] * p.height / p.track
        ahead = p.mass * q[7] * p.height / p.wheelbase / 2
        for side in (-1.0, 1.0):  # right, left
            y = side * half
            z = max(static - side * lateral + (-ahead if front else ahead), 50.0)
            tangent = math.tan(q[8])
            delta = math.atan(tangent / (1 - side * p.ackermann * half / p.wheelbase * tangent)) if front else 0.0
            slip = math.atan((q[4] + q[5] * x) / max(q[3] - q[5] * y, 0.8)) - delta
            ratio = z / static
            fy = side_force(p.tyre, slip, tyre_stiffness(stiffness, ratio, p), z, forces[axle] / 2, p.grip, p.sliding,
                            ratio)
            c, s = math.cos(delta), math.sin(delta)
            bx, by = forces[axle] / 2 * c - fy * s, forces[axle] / 2 * s + fy * c
            total_x, total_y, moment = total_x + bx, total_y + by, moment + x * by - y * bx
            steered += fy if front else 0.0
    planar_rates(q, total_x, total_y, moment, p, out)
    out[6] = (total_y / p.mass - q[6]) / 0.08
    out[7] = (force / p.mass - q[7]) / 0.06
    out[8] = (wheel - p.compliance * steered - q[8]) / max(p.steer_lag, 0.012)


@njit(cache=True)
def elastic(q, wheel, force, p, out):
    """Further states: road-wheel angle without elasticity, slip angle front and rear."""
    rear = p.wheelbase - p.front
    speed = max(q[3], 0.8)
    ffx, frx = split_drive_force(force, p)
    static_f, static_r = p.mass * GRAVITY * rear / p.wheelbase / 2, p.mass * GRAVITY * p.front / p.wheelbase / 2
    transfer = p.height / p.wheelbase * force / 2
    shift = p.mass * q[3] * q[5] * p.height / p.track
    fy = axle_force(q[7], p.stiffness_front, static_f, static_f - transfer, p.roll_front * shift, ffx, p)
    ry = axle_force(q[8], p.stiffness_rear, static_r, static_r + transfer, (1 - p.roll_front) * shift, frx, p)
    sliding_at = 6 * p.grip * static_f / p.stiffness_front
    torque = p.trail * max(1 - abs(math.tan(q[7])) / sliding_at, 0.0) * fy
    delta = q[6] - p.column * torque - p.compliance * fy
    c, s = math.cos(delta), math.sin(delta)
    front = fy * c + ffx * s
    planar_rates(q, ffx * c - fy * s + frx, front + ry, p.front * front - rear * ry - torque, p, out)
    out[6] = (wheel - q[6]) / max(p.steer_lag, 0.012)
    out[7] = max(speed, 3.0) / p.relaxation * (math.atan((q[4] + p.front * q[5]) / speed) - delta - q[7])
    out[8] = max(speed, 3.0) / p.relaxation * (
        math.atan((q[4] - rear * q[5]) / speed) + p.compliance_rear * ry - q[8])


@njit(cache=True)
def bristle(q, wheel, force, p, out):
    """Further states: bristle deflection front and rear [m], road-wheel angle and its rate."""
    rear = p.wheelbase - p.front
    loads = (p.mass * GRAVITY * rear / p.wheelbase, p.mass * GRAVITY * p.front / p.wheelbase)
    transfer = p.height / p.wheelbase * force
    ffx, frx = split_drive_force(force, p)
    c, s = math.cos(q[8]), math.sin(q[8])
    forces = np.zeros(2)
    for axle in range(2):
        side, ahead = q[4] - rear * q[5], q[3]
        if axle == 0:
            across = q[4] + p.front * q[5]
            side, ahead = across * c - q[3] * s, q[3] * c + across * s
        load = loads[axle] + (-transfer if axle == 0 else transfer)
        along = (ffx, frx)[axle]
        hardness = (p.stiffness_front, p.stiffness_rear)[axle] / (loads[axle] * p.relaxation)
        friction = p.grip * (p.sliding + (1 - p.sliding) * math.exp(-math.sqrt(abs(side) / 3.5)))
        friction *= math.sqrt(max(1 - (along / (p.grip * load)) ** 2, 0.05))
        fading = hardness * abs(side) / friction + max(ahead, 0.8) / p.relaxation
        out[6 + axle] = side - fading * q[6 + axle]
        forces[axle] = -load * hardness * q[6 + axle]
    front = forces[0] * c + ffx * s
    planar_rates(q, ffx * c - forces[0] * s + frx, front + forces[1], p.front * front - rear * forces[1], p, out)
    omega = 1.4 / p.steer_lag
    out[8] = q[9]
    out[9] = omega * (omega * (wheel - p.compliance * forces[0] - q[8]) - 1.4 * q[9])


@njit(cache=True)
def sprung(q, wheel, force, p, out):
    """Further states: roll, roll rate, pitch (nose up +), pitch rate, road-wheel angle, slip angle front and rear."""
    rear = p.wheelbase - p.front
    half, speed = p.track / 2, max(q[3], 0.8)
    ffx, frx = split_drive_force(force, p)
    pitch_inertia = 0.92 * p.inertia
    pitch_stiffness, pitch_damping = pitch_inertia * 10.5**2, pitch_inertia * 2 * 0.3 * 10.5
    shift = (p.roll_stiffness * q[6] + p.roll_damping * q[7]) / p.track
    ahead = (pitch_stiffness * q[8] + pitch_damping * q[9]) / p.wheelbase / 2
    turned = p.roll_steer * q[6]
    total_x, total_y, moment, axles = 0.0, 0.0, 0.0, np.zeros(2)
    for axle in range(2):
        front = axle == 0
        x, along = (p.front, ffx) if front else (-rear, frx)
        static = p.mass * GRAVITY * (rear if front else p.front) / p.wheelbase / 2
        delta = q[10] if front else turned
        c, s = math.cos(delta), math.sin(delta)
        for side in (-1.0, 1.0):
            lateral = (p.roll_front if front else 1 - p.roll_front) * shift
            z = max(static - side * lateral + (-ahead if front else ahead), 50.0)
            fy = side_force(TABLE, q[11 + axle], (p.stiffness_front if front else p.stiffness_rear) / 2, z, along / 2,
                            p.grip, p.sliding, z / static)
            bx, by = along / 2 * c - fy * s, along / 2 * s + fy * c
            total_x, total_y, moment = total_x + bx, total_y + by, moment + x * by - side * half * bx
            axles[axle] += fy
    planar_rates(q, total_x, total_y, moment, p, out)
    ay, ax = total_y / p.mass, total_x / p.mass
    out[6] = q[7]
    out[7] = (0.85 * p.mass * 0.8 * p.height * (ay + GRAVITY * q[6]) - p.roll_stiffness * q[6] - p.roll_damping * q[7]
              ) / p.roll_inertia
    out[8] = q[9]
    out[9] = (p.mass * p.height * ax - pitch_stiffness * q[8] - pitch_damping * q[9]) / pitch_inertia
    out[10] = (wheel - p.compliance * axles[0] - q[10]) / max(p.steer_lag, 0.015)
    pace = max(speed, 3.0) / p.relaxation
    out[11] = pace * (math.atan((q[4] + p.front * q[5]) / speed) - q[10] - q[11])
    out[12] = pace * (math.atan((q[4] - rear * q[5]) / speed) - turned - q[12])


@njit(cache=True)
def rigid(q, wheel, force, p, out):
    """Further states: roll, roll rate, pitch (nose up +), pitch rate, heave, heave rate, road-wheel angle, yaw of the
    trailer. The wheels have no mass; the trailer's axle does not slip, its yaw inertia is neglected."""
    rear, half = p.wheelbase - p.front, p.track / 2
    forces = split_drive_force(force, p)
    ball, down = HITCH_SHARE * p.trailer * GRAVITY, p.downforce * q[3] ** 2
    fx, fy, moment, steered, lift, roll, pitch = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for axle in range(2):
        front = axle == 0
        x = p.front if front else -rear
        static = p.mass * GRAVITY * (rear if front else p.front) / p.wheelbase / 2
        spring, damper, bar, camber, toe, stiffness = (
            (p.spring_front, p.damper_front, p.bar_front, p.camber_front, p.toe_front, p.stiffness_front) if front else
            (p.spring_rear, p.damper_rear, p.bar_rear, p.camber_rear, p.toe_rear, p.stiffness_rear))
        scale = stiffness / (2 * magic_slope(p.tyre, static))
        for side in (-1.0, 1.0):  # right, left
            y = side * half
            load = max(50.0, static - spring * (q[10] + y * q[6] + x * q[8]) - 2 * bar * y * q[6]
                       - damper * (q[11] + y * q[7] + x * q[9]))
            tangent = math.tan(q[12])
            delta = p.rear_angle + p.rear_steer * q[12]
            if front:
                delta = math.atan(tangent / (1 - side * p.ackermann * half / p.wheelbase * tangent))
            delta += side * math.radians(toe)
            slip = math.atan((q[4] + q[5] * x) / max(q[3] - q[5] * y, 0.8)) - delta
            lean = side * math.radians(camber) - q[6]
            lateral = magic_1994(p.tyre, slip, lean, load, forces[axle] / 2, scale, p.grip)
            c, s = math.cos(delta), math.sin(delta)
            bx, by = forces[axle] / 2 * c - lateral * s, forces[axle] / 2 * s + lateral * c
            fx, fy, moment = fx + bx, fy + by, moment + x * by - y * bx
            steered += lateral if front else 0.0
            lift, roll, pitch = lift + load, roll + y * load, pitch + x * load
    out[7] = (roll + p.height * fy + p.mass * GRAVITY * p.height * q[6]) / p.roll_inertia
    out[9] = (pitch + p.height * fx + (rear + HITCH) * ball + rear * down) / p.pitch_inertia
    out[11] = (lift - p.mass * GRAVITY - ball - down) / p.mass
    out[6], out[8], out[10] = q[7], q[9], q[11]
    out[12] = (wheel - p.compliance * steered - q[12]) / max(p.steer_lag, 0.012)
    if p.trailer > 0:
        angle = q[13] - q[2]
        pull = p.trailer * (force / (p.mass + p.trailer) + 0.015 * GRAVITY * min(q[3] / 0.3, 1.0))
        across = -pull * math.sin(angle) - ball / GRAVITY * q[3] * q[5]
        fx, fy, moment = fx - pull * math.cos(angle), fy + across, moment - (rear + HITCH) * across
        out[13] = ((q[4] - (rear + HITCH) * q[5]) * math.cos(angle) - q[3] * math.sin(angle)) / DRAWBAR
    planar_rates(q, fx, fy, moment, p, out)


@njit(cache=True)
def derivative(equations, q, wheel, force, p, out):
    if equations == ROLLING:
        rolling(q, wheel, force, p, out)
    elif equations == FOUR_WHEELS:
        four_wheels(q, wheel, force, p, out)
    elif equations == ELASTIC:
        elastic(q, wheel, force, p, out)
    elif equations == BRISTLE:
        bristle(q, wheel, force, p, out)
    elif equations == RIGID:
        rigid(q, wheel, force, p, out)
    else:
        sprung(q, wheel, force, p, out)


@njit(cache=True)
def step(equations, q, wheel, force, p, h, k, mid):
    """Advances q by one Runge-Kutta step. The first row of k (4, STATES) is then the rates at the start of the step."""
    derivative(equations, q, wheel, force, p, k[0])
    for stage in range(1, 4):
        part = h if stage == 3 else h / 2
        for i in range(STATES):
            mid[i] = q[i] + part * k[stage - 1, i]
        derivative(equations, mid, wheel, force, p, k[stage])
    for i in range(STATES):
        q[i] += h / 6 * (k[0, i] + 2 * k[1, i] + 2 * k[2, i] + k[3, i])


@njit(cache=True)
def drive(equations, road, p, seconds, wander):
    """Rows (n, ROW) of a drive, one per STEP. road: x, y, yaw and speed every 0.5 m; wander: steering tremor of the
    driver [rad at the road wheels].

    The driver looks 0.9 s ahead, at least 4 m; where the speed of the road is below 1.4 m/s, the car stops for 4 s.
    """
    rows = int(seconds / STEP)
    q, k, mid, out = np.zeros(STATES), np.zeros((4, STATES)), np.zeros(STATES), np.zeros((rows, ROW))
    q[0], q[1], q[2], q[3] = road[0, 0], road[0, 1], road[0, 2], max(1.0, min(road[0, 3], 6.0))
    wheel, force, near, hold, leaving = 0.0, 0.0, 0, 0.0, False
    for i in range(rows):
        while near < len(road) - 60 and (road[near + 1, 0] - q[0]) ** 2 + (road[near + 1, 1] - q[1]) ** 2 < (
                road[near, 0] - q[0]) ** 2 + (road[near, 1] - q[1]) ** 2:
            near += 1
        if near >= len(road) - 61:
            return out[:i]
        goal = min(near + int(max(4.0, 0.9 * q[3]) / 0.5), len(road) - 1)
        dx, dy = road[goal, 0] - q[0], road[goal, 1] - q[1]
        side = -math.sin(q[2]) * dx + math.cos(q[2]) * dy
        requested = 2 * side / (dx * dx + dy * dy) * (p.wheelbase + 0.0022 * q[3] ** 2) + wander[i]
        wheel += STEP * min(max((requested - wheel) / 0.15, -0.6), 0.6)
        target = road[near + min(int(q[3]), 40), 3]
        if leaving and target > 3.0:
            leaving, hold = False, 0.0
        elif target < 1.4 and (q[3] < 0.8 or leaving):
            hold += STEP
            leaving = hold > 4.0
            target = 5.0 if leaving else 0.0
        pull = min(max(1.2 * (target - q[3]), -3.0), 2.2)
        force += STEP / 0.3 * (p.mass * pull + DRAG * q[3] ** 2 + ROLLING_RESISTANCE * p.mass * GRAVITY - force)
        for n in range(STATES):
            out[i, n] = q[n]
        out[i, WHEEL], out[i, DRIVE_FORCE] = wheel, force
        for half in range(2):
            step(equations, q, wheel, force, p, STEP / 2, k, mid)
            if half == 0:
                out[i, VX_DOT], out[i, VY_DOT], out[i, YAW_RATE_DOT] = k[0, 3], k[0, 4], k[0, 5]
        if q[3] < 0.3 and target < 0.2:
            q[3] = q[4] = q[5] = 0.0
        elif q[3] < 0.0:
            q[3] = 0.0
    return out


def axle_forces(rows: np.ndarray, p: Parameters) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(front slip angle, front force, rear slip angle, rear force) [rad, N] of each row.

        F_f = (m a_y l_r + I r_dot) / L,  F_r = (m a_y l_f - I r_dot) / L,  a_y = v_y_dot + v_x r

    The slip angle follows from the motion of the body and the steering wheel; compliance, roll steer and lag therefore
    affect the force, not the slip angle. Valid above a few m/s.
    """
    rear = p.wheelbase - p.front
    vx = np.maximum(rows[:, 3], 0.8)
    ay = rows[:, VY_DOT] + rows[:, 3] * rows[:, 5]
    front = (p.mass * ay * rear + p.inertia * rows[:, YAW_RATE_DOT]) / p.wheelbase
    back = (p.mass * ay * p.front - p.inertia * rows[:, YAW_RATE_DOT]) / p.wheelbase
    return (np.arctan((rows[:, 4] + p.front * rows[:, 5]) / vx) - rows[:, WHEEL], front,
            np.arctan((rows[:, 4] - rear * rows[:, 5]) / vx), back)
