"""Three cars that share no code and no tyre model with the project, on roads with a driver, as files of a user."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

DUGOFF, BURCKHARDT, FIALA = 0, 1, 2
GRAVITY, STEP = 9.81, 0.0025
TRUE_FIELDS = ("mass", "inertia", "wheelbase", "front", "height", "track", "stiffness_front", "stiffness_rear", "grip",
               "tyre", "drive_front", "steer_lag", "compliance", "roll_stiffness", "roll_damping", "roll_inertia",
               "relaxation")


@dataclass(frozen=True)
class Stranger:
    """SI; stiffness: N/rad of an axle. compliance: rad of steering lost per N of front side force.

    ins: m ahead of the CG. steer_lag: s, hand wheel to road wheel. relaxation: m. guess: what people guess for the
    vehicle file.
    """

    name: str
    mass: float
    inertia: float
    wheelbase: float
    front: float
    height: float
    track: float
    stiffness_front: float
    stiffness_rear: float
    grip: float
    tyre: int
    drive_front: float
    ratio: float
    ins: float
    ins_rate: int
    steering_rate: int
    steering_step: float
    guess: dict
    steer_lag: float = 0.0
    compliance: float = 0.0
    roll_stiffness: float = 1e6
    roll_damping: float = 2e4
    roll_inertia: float = 500.0
    relaxation: float = 0.0
    comfort: float = 3.0


SALOON = Stranger(
    "saloon", 1580.0, 2650.0, 2.71, 1.19, 0.55, 1.56, 118e3, 142e3, 0.95, DUGOFF, 1.0, 15.1, -0.35, 100, 100, 0.1,
    {"yaw_inertia": 2500.0, "cornering_stiffness_front": 100e3, "cornering_stiffness_rear": 120e3},
    compliance=2.7e-6, roll_stiffness=62e3, roll_damping=4200.0, roll_inertia=620.0, relaxation=0.45, comfort=3.8)
LIGHT_EV = Stranger(
    "light_ev", 1010.0, 1080.0, 2.49, 1.37, 0.46, 1.38, 62e3, 88e3, 0.9, BURCKHARDT, 0.0, 17.2, 0.22, 200, 50, 0.5,
    {"yaw_inertia": 1200.0, "cornering_stiffness_front": 70e3, "cornering_stiffness_rear": 80e3}, comfort=3.2)
VAN = Stranger(
    "van", 2800.0, 7900.0, 3.66, 1.72, 0.82, 1.73, 145e3, 205e3, 0.85, FIALA, 1.0, 19.0, -1.05, 50, 25, 1.5,
    {"yaw_inertia": 7000.0, "cornering_stiffness_front": 160e3, "cornering_stiffness_rear": 190e3},
    steer_lag=0.06, roll_stiffness=110e3, roll_damping=8000.0, roll_inertia=1500.0, relaxation=0.6, comfort=2.6)
CARS = {car.name: car for car in (SALOON, LIGHT_EV, VAN)}


@njit(cache=True)
def side_force(kind, slip, stiffness, load, longitudinal, grip):
    """N of one tyre, to the left; slip angle positive when the wheel slides to its left."""
    limit = grip * load
    if kind == DUGOFF:
        tangent = math.tan(slip)
        share = limit / (2 * math.hypot(longitudinal, stiffness * tangent) + 1e-9)
        return -stiffness * tangent * (share * (2 - share) if share < 1 else 1.0)
    rest = math.sqrt(max(limit * limit - longitudinal * longitudinal, 0.01 * limit * limit))
    if kind == BURCKHARDT:
        s = math.sin(abs(slip))
        c2 = stiffness / limit * 1.05
        return -math.copysign(rest * (1.02 * (1 - math.exp(-c2 * s)) - 0.1 * s), slip)
    tangent = math.tan(slip)
    sliding = math.atan(3 * rest / stiffness)
    if abs(slip) >= sliding:
        return -math.copysign(rest, slip)
    scaled = stiffness * tangent
    return -scaled + scaled * abs(scaled) / (3 * rest) - scaled**3 / (27 * rest * rest)


@njit(cache=True)
def _derivative(q, wheel, push, p, out):
    """q: x, y, yaw, v_x, v_y, yaw rate, roll, roll rate, road wheel angle, slip angle front and rear."""
    (m, inertia, wheelbase, lf, h, track, cf, cr, grip, tyre, front, lag, compliance, kphi, dphi, iphi, relax) = p
    lr = wheelbase - lf
    vx, vy, r = q[3], q[4], q[5]
    delta = q[8] if lag > 0 else wheel
    speed = max(vx, 0.8)
    ffx = push * (front if push > 0 else 0.65)
    frx = push - ffx
    kinematic_f, kinematic_r = math.atan((vy + lf * r) / speed), math.atan((vy - lr * r) / speed)
    transfer = h / wheelbase * push
    zf, zr = m * GRAVITY * lr / wheelbase - transfer, m * GRAVITY * lf / wheelbase + transfer
    shift = (kphi * q[6] + dphi * q[7]) / track
    slip_f, slip_r = q[9], q[10]
    if relax <= 0:
        slip_f, slip_r = kinematic_f - delta, kinematic_r
    fy, ry = 0.0, 0.0
    for side in (-1.0, 1.0):
        fz = max(zf / 2 + side * 0.55 * shift, 50.0)
        rz = max(zr / 2 + side * 0.45 * shift, 50.0)
        # Stiffness grows less than load.
        cfz = cf / 2 * fz / (zf / 2) * (1 - 0.25 * (fz / (zf / 2) - 1))
        crz = cr / 2 * rz / (zr / 2) * (1 - 0.25 * (rz / (zr / 2) - 1))
        fy += side_force(tyre, slip_f, cfz, fz, ffx / 2, grip)
        ry += side_force(tyre, slip_r, crz, rz, frx / 2, grip)
    bent = delta - compliance * fy
    c, s = math.cos(bent), math.sin(bent)
    left = fy * c + ffx * s + ry
    ahead = ffx * c - fy * s + frx - 0.38 * vx * abs(vx) - 0.011 * m * GRAVITY * min(vx / 0.3, 1.0)
    ay = left / m
    out[0], out[1] = vx * math.cos(q[2]) - vy * math.sin(q[2]), vx * math.sin(q[2]) + vy * math.cos(q[2])
    out[2], out[3], out[4] = r, ahead / m + r * vy, ay - r * vx
    out[5] = (lf * (fy * c + ffx * s) - lr * ry) / inertia
    out[6] = q[7]
    out[7] = (m * 0.9 * h * (ay + GRAVITY * q[6]) - kphi * q[6] - dphi * q[7]) / iphi
    out[8] = (wheel - q[8]) / lag if lag > 0 else 0.0
    if relax > 0:
        out[9] = max(speed, 3.0) / relax * (kinematic_f - bent - q[9])
        out[10] = max(speed, 3.0) / relax * (kinematic_r - q[10])


@njit(cache=True)
def _drive(road, p, seconds, wander):
    """Rows of q, v_x rate, v_y rate, and the asked road wheel angle, every STEP; the driver looks 0.9 s ahead."""
    rows = int(seconds / STEP)
    q, d, mid, found = np.zeros(11), np.zeros(11), np.zeros(11), np.zeros((rows, 14))
    q[0], q[1], q[2], q[3] = road[0, 0], road[0, 1], road[0, 2], 1.0
    wheel, push, near, hold, leaving = 0.0, 0.0, 0, 0.0, False
    for i in range(rows):
        while near < len(road) - 60 and (road[near + 1, 0] - q[0]) ** 2 + (road[near + 1, 1] - q[1]) ** 2 < (
                road[near, 0] - q[0]) ** 2 + (road[near, 1] - q[1]) ** 2:
            near += 1
        if near >= len(road) - 61:
            return found[:i]
        look = max(4.0, 0.9 * q[3])
        goal = min(near + int(look / 0.5), len(road) - 1)
        dx, dy = road[goal, 0] - q[0], road[goal, 1] - q[1]
        side = -math.sin(q[2]) * dx + math.cos(q[2]) * dy
        asked = 2 * side / (dx * dx + dy * dy) * (p[2] + 0.0022 * q[3] ** 2) + wander[i]
        wheel += STEP * min(max((asked - wheel) / 0.15, -0.6), 0.6)
        target = road[near + min(int(q[3]), 40), 3]
        if leaving and target > 3.0:
            leaving, hold = False, 0.0
        elif target < 1.4 and (q[3] < 0.8 or leaving):
            hold += STEP
            leaving = hold > 4.0
            target = 5.0 if leaving else 0.0
        pull = min(max(1.2 * (target - q[3]), -3.0), 2.2)
        push += STEP / 0.3 * (p[0] * pull + 0.38 * q[3] ** 2 + 0.011 * p[0] * GRAVITY - push)
        _derivative(q, wheel, push, p, d)
        for k in range(11):
            mid[k] = q[k] + STEP / 2 * d[k]
        _derivative(mid, wheel, push, p, d)
        for k in range(11):
            found[i, k] = q[k]
            q[k] += STEP * d[k]
        if q[3] < 0.3 and target < 0.2:
            q[3] = q[4] = q[5] = 0.0
        elif q[3] < 0.0:
            q[3] = 0.0
        found[i, 11], found[i, 12], found[i, 13] = d[3], d[4], wheel
    return found


# (length [m], curvature [1/m], speed limit [m/s]); a limit of 0 is a stop.
def _roads(rng: np.random.Generator) -> dict[str, list]:
    def bend(radius, degrees, limit):
        return (radius * math.radians(degrees), rng.choice((-1, 1)) / radius, limit)

    town = [part for _ in range(30) for part in (
        (rng.uniform(60, 160), 0.0, 13.5), bend(rng.uniform(11, 18), 85, 8.0), (rng.uniform(40, 90), 0.0, 13.5),
        bend(rng.uniform(30, 70), 50, 11.0), (3.0, 0.0, rng.choice((0.0, 12.0))))]
    country = [part for _ in range(40) for part in (
        (rng.uniform(30, 150), 0.0, 23.0), bend(rng.uniform(45, 220), rng.uniform(30, 80), 23.0))]
    around = [part for _ in range(30) for part in (
        (rng.uniform(50, 120), 0.0, 14.0), (14.0, -1 / 22, 9.0), (rng.uniform(20, 75), 1 / 17, 9.0),
        (14.0, -1 / 22, 9.0))]
    motorway = 10 * [
        (120.0, 0.0, 14.0), (165.0, -1 / 45, 14.0), (250.0, 0.0, 30.0), (60.0, 1 / 700, 30.0), (60.0, -1 / 700, 30.0),
        (500.0, 1 / 900, 30.0), (600.0, -1 / 650, 30.0), (150.0, 0.0, 16.0), (90.0, 1 / 60, 15.0), (80.0, 0.0, 0.0)]
    return {"town": town, "country": country, "roundabouts": around, "motorway": motorway}


def _line(parts: list, comfort: float) -> np.ndarray:
    """x, y, yaw, speed every 0.5 m; curvature changes over 12 m, braking at 1.8 m/s^2."""
    curvature = np.concatenate([np.full(max(1, int(length / 0.5)), k) for length, k, _ in parts])
    speed = np.concatenate([np.full(max(1, int(length / 0.5)), v) for length, _, v in parts])
    curvature = np.convolve(curvature, np.full(24, 1 / 24), "same")
    speed = np.minimum(speed, np.sqrt(comfort / np.maximum(abs(curvature), 1e-4)))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], math.sqrt(speed[i + 1] ** 2 + 2 * 1.8 * 0.5))
    yaw = np.cumsum(curvature) * 0.5
    return np.column_stack([np.cumsum(np.cos(yaw)) * 0.5, np.cumsum(np.sin(yaw)) * 0.5, yaw, speed])


def drives(car: Stranger, seconds: float, seed: int) -> dict[str, np.ndarray]:
    """Every road driven by the true car."""
    rng = np.random.default_rng(seed)
    p = tuple(float(getattr(car, name)) for name in TRUE_FIELDS)
    found = {}
    for name, parts in _roads(rng).items():
        shaky = np.convolve(rng.standard_normal(int(seconds / STEP)), np.full(320, 1 / 18.0), "same") * 0.002
        found[name] = _drive(_line(parts, car.comfort), p, seconds, shaky)
    return found


def _wandering(rng: np.random.Generator, rows: int, rate: int, deviation: float, seconds: float) -> np.ndarray:
    keep, value, out = math.exp(-1 / (rate * seconds)), deviation * rng.standard_normal(), np.empty(rows)
    for i, kick in enumerate(rng.standard_normal(rows) * deviation * math.sqrt(1 - keep * keep)):
        value = keep * value + kick
        out[i] = value
    return out


def sensed(car: Stranger, truth: np.ndarray, hidden: dict, seed: int) -> dict[str, np.ndarray]:
    """Channels at the rate of the INS and, NaN where it sent nothing, the hand wheel [rad]."""
    rng, every = np.random.default_rng(seed), round(1 / STEP / car.ins_rate)
    q = truth[::every]
    n, t, rate = len(q), np.arange(0, len(q)) / car.ins_rate, car.ins_rate
    skew, arm = hidden.get("heading", 0.0), car.ins + hidden.get("lever", 0.0)
    vx, vy, yaw, r = q[:, 3], q[:, 4] + arm * q[:, 5], q[:, 2], q[:, 5]
    turn = np.gradient(r, t)
    ax, ay = q[:, 11] - r * q[:, 4] - arm * r * r, q[:, 12] + r * vx + arm * turn

    def noise(white: float, slow: float) -> np.ndarray:
        return white * rng.standard_normal(n) + _wandering(rng, n, rate, slow, 40.0)

    c, s = math.cos(skew), math.sin(skew)
    steering = truth[:, 13] * car.ratio
    delay = int(hidden.get("delay", 0.0) / STEP)
    steering = np.concatenate([np.full(delay, steering[0]), steering[:len(steering) - delay]])[::every]
    steering = steering + 0.0005 * rng.standard_normal(n) + hidden.get("offset", 0.0)
    step = math.radians(car.steering_step)
    steering = np.round(steering / step) * step
    slower = max(1, rate // car.steering_rate)
    steering[np.arange(n) % slower != 0] = np.nan
    return {
        "t": t, "x": q[:, 0] + arm * np.cos(yaw) + noise(0.003, 0.008),
        "y": q[:, 1] + arm * np.sin(yaw) + noise(0.003, 0.008),
        "yaw": yaw + skew + noise(2e-4, 1e-3),
        "velocity_x": c * vx + s * vy + noise(0.01, 0.01), "velocity_y": c * vy - s * vx + noise(0.01, 0.01),
        "yaw_rate": r * hidden.get("yaw_rate_scale", 1.0) + noise(5e-4, 5e-5),
        "acceleration_x": c * ax + s * ay + noise(0.05, 0.01), "acceleration_y": c * ay - s * ax + noise(0.05, 0.01),
        "steering_wheel_angle": steering}
