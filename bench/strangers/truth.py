"""True answers for a case: effects of the library that the car has, their values, and axle force curves."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from st_core.tyres import magic_formula_coefficients, magic_formula_force, magic_formula_peak
from st_core.vehicle import VehicleParameters

from . import simulation
from .cases import Case, file_car, true_car
from .tyres import magic_1994, side_force
from .vehicles import BRISTLE, ELASTIC, FOUR_WHEELS, GRAVITY, MULTI_BODY, RIGID, ROLLING, SPRUNG, Parameters

MIN_DEVIATION = 0.03  # minimum relative deviation from the file for the car to have an effect
MIN_HEIGHT_DEVIATION = 0.03  # m
MIN_ANGLE = 3e-4  # rad, of ply steer and rear axle
OUTER_WHEEL = 0.02
"""Largest relative effect of the laden outer wheel of a parallel linkage, t delta / (2 L) times the load transfer: the
car turns as with a smaller steering ratio."""
PACKAGE_FRICTION = 1.049  # p_dy1 of commonroad-vehicle-models
MAX_YAW_ACCELERATION, MAX_STEER_RATE, MIN_SPEED = 0.15, 0.12, 6.0
"""Limits of the rows for the axle force curves [rad/s^2, rad/s of the road wheels, m/s]."""
POINTS, EDGE = 12, 0.005
"""Points of a curve; fraction of the rows, those with the largest slip angles, that is left out."""
SHAPES = ("front_tyre_curve", "rear_tyre_curve", "tyre_load_sensitivity", "front_saturation", "rear_saturation",
          "tyre_saturation", "combined_slip", "steered_drive_force")
"""Effects that all cars have, but with other equations than in the library, so that no value can be compared."""
ACCEPTED = {
    "ratio": ("steering_ratio",), "offset": ("steering_offset",), "load": ("load", "mass", "cg_position"),
    "lever": ("sensor_lever_arm",), "worn_front": ("front_stiffness", "steering_compliance", "roll_steer"),
    "worn_rear": ("rear_stiffness",), "compliance": ("steering_compliance", "front_stiffness", "roll_steer"),
    "delay": ("steering_delay", "steering_lag"), "gyro_scale": ("yaw_rate_scale",), "gyro_bias": ("yaw_rate_bias",),
    "heading": ("heading_misalignment",), "cg": ("cg_position", "load"), "mass": ("mass", "load"),
    "rear_angle": ("heading_misalignment", "steering_offset"), "trailer": ("load", "mass", "cg_position"),
    "rear_steer": ("rear-wheel steering",)}
"""Effects that count as the answer to a hidden error: its own, and those that act identically."""
CONFOUNDED = (("front_stiffness", "steering_compliance", "roll_steer"), ("steering_delay", "steering_lag"))
"""Effects that act identically at the accelerations driven."""


def find_truth(case: Case, drives: Iterable[np.ndarray], vehicle: VehicleParameters) -> dict[str, Any]:
    """The truth as JSON values. vehicle: the owner's vehicle file.

    effects: name -> range [low, high] of the first parameter, null if no value can be compared. hidden: error -> size
    and accepted names. axles: axle -> slip angle [rad, >= 0], force of the car [N, against the slip], and force of the
    file at the same slip angle. tyre_stiffness_front: factor of the front tyres alone, a correct front stiffness if
    compliance is reported as well.
    """
    car, file = true_car(case), file_car(case)
    crab, steered = straight_line(car)
    drives = [_without_crab(rows, crab, steered) for rows in drives]
    curves = axle_curves(car.parameters, drives, vehicle)
    effects = {name: value and [float(edge) for edge in value]
               for name, value in _true_effects(case, car, file, vehicle, curves).items()}
    return {
        "car": car.name, "description": car.equations, "origin": car.origin,
        "hidden": {name: {"size": size, "accepted": list(ACCEPTED[name])} for name, size in case.hidden.items()},
        "effects": effects, "confounded": [list(group) for group in CONFOUNDED], "axles": curves,
        "tyre_stiffness_front": car.parameters.stiffness_front / vehicle.cornering_stiffness_front,
        "body": {"mass": car.parameters.mass, "inertia": car.parameters.inertia, "wheelbase": car.parameters.wheelbase,
                 "front": car.parameters.front},
        "stiffness_over_load": _over_axle_load(car.parameters, vehicle, curves),
        "uncertainty": dict(case.uncertainty), "drives": [list(one) for one in case.drives]}


def straight_line(car) -> tuple[float, float]:
    """Sideslip, and angle of the front wheels, in straight driving at 15 m/s [rad]: the car acts like one without ply
    steer and rear angle, with the INS turned by minus the former and the steering offset by minus the latter."""
    if car.equations != RIGID:
        return 0.0, 0.0
    n, wheel, (k, mid) = car.parameters, 0.0, (np.zeros((4, simulation.STATES)), np.zeros(simulation.STATES))
    for _ in range(4):
        q = np.zeros(simulation.STATES)
        q[3] = 15.0
        for _ in range(4000):
            force = simulation.DRAG * q[3] ** 2 + simulation.ROLLING_RESISTANCE * n.mass * GRAVITY
            simulation.step(car.equations, q, wheel, force, n, 0.0025, k, mid)
        sideslip = q[4] / q[3]
        wheel -= q[5] * n.wheelbase / q[3]
    return float(sideslip), float(wheel)


def _without_crab(rows: np.ndarray, crab: float, steered: float) -> np.ndarray:
    rows = rows.copy()
    rows[:, 4] -= crab * rows[:, 3]
    rows[:, simulation.WHEEL] -= steered
    return rows


def _over_axle_load(n: Parameters, vehicle: VehicleParameters, curves: dict) -> dict[str, list[float]]:
    """By axle: range of the stiffness over the axle load, over that of the file [1]."""
    loads = {"front": vehicle.mass * vehicle.cg_to_rear_axle / (n.mass * (n.wheelbase - n.front)),
             "rear": vehicle.mass * vehicle.cg_to_front_axle / (n.mass * n.front)}
    return {axle: [float(edge * load) for edge in _stiffness(curves[axle])] for axle, load in loads.items()}


def _true_effects(case: Case, car, file, vehicle: VehicleParameters, curves: dict) -> dict[str, list[float] | None]:
    n, hidden, found = car.parameters, case.hidden, dict.fromkeys(SHAPES)
    front, rear = _stiffness(curves["front"]), _stiffness(curves["rear"])
    both = [min(front[0], rear[0]), max(front[1], rear[1])]
    inertia = n.inertia / vehicle.yaw_inertia
    friction = _friction(car.equations, n, vehicle)
    for name, value in (("front_stiffness", front), ("rear_stiffness", rear), ("friction", friction),
                        ("yaw_inertia", [inertia, inertia]), ("mass", [n.mass / vehicle.mass] * 2)):
        if value[0] < 1 - MIN_DEVIATION or value[1] > 1 + MIN_DEVIATION:
            found[name] = value
    if "front_stiffness" in found and "rear_stiffness" in found:
        found["tyre_stiffness"] = both
    shift = file.parameters.front + hidden.get("cg", 0.0) - n.front
    height_error = n.height - vehicle.cg_height
    if abs(shift) > 1e-3:
        found["cg_position"] = [shift, shift]
    if abs(height_error) > MIN_HEIGHT_DEVIATION:
        found["longitudinal_load_transfer"] = [height_error, height_error]
    if car.equations != BRISTLE:
        found["lateral_load_transfer"] = None
    if car.equations in (FOUR_WHEELS, RIGID):
        found["steering_map"] = None  # the mean wheel of an Ackermann linkage
    found.update(_dynamics(car))
    crab, steered = straight_line(car)
    turned = {"heading": crab, "offset": steered}
    errors = {**{name: 0.0 for name, angle in turned.items() if abs(angle) > MIN_ANGLE}, **hidden, **case.sensors}
    for name, effect, value in (
            ("ratio", "steering_ratio", lambda s: 1 / (1 + s)), ("heading", "heading_misalignment", lambda s: s - crab),
            ("offset", "steering_offset", lambda s: -s / car.ratio - steered),
            ("lever", "sensor_lever_arm", lambda s: s), ("delay", "steering_delay", lambda s: -s),
            ("gyro_scale", "yaw_rate_scale", lambda s: 1 + s),
            ("gyro_bias", "yaw_rate_bias", lambda s: s)):
        if name in errors:
            found[effect] = [value(errors[name])] * 2
    if "load" in hidden:
        # The load of the library is above the rear axle, where a smaller one shifts the CG equally.
        behind = vehicle.wheelbase - file.parameters.front
        found["load"] = [(n.mass - hidden["load"]) * -shift / (behind + shift), hidden["load"]]
    if "steering_ratio" in found and car.equations in (FOUR_WHEELS, RIGID):
        found["steering_ratio"][0] *= 1 - OUTER_WHEEL * (1 - n.ackermann)
    if "steering_delay" in found and found.get("steering_lag"):
        found["steering_delay"][1] += found["steering_lag"][1]  # the lag of the wheels compensates a late sensor
    return found


def _dynamics(car) -> dict[str, list[float] | None]:
    """Lags, compliance and trailer; the range of lags is 20 % to both sides if the equations are not the library's."""
    n, found = car.parameters, {}
    tolerance = 0.0 if car.equations == ROLLING else 0.2
    if n.relaxation > 0:
        found["tyre_relaxation"] = [n.relaxation * (1 - tolerance), n.relaxation * (1 + tolerance)]
    lag = n.steer_lag
    if car.equations in (FOUR_WHEELS, ELASTIC, RIGID, SPRUNG):
        lag = max(lag, 0.012 if car.equations != SPRUNG else 0.015)
    if lag > 0:
        found["steering_lag"] = [lag * (1 - tolerance), lag * (1 + tolerance)]
    compliance = n.compliance + n.column * n.trail
    if compliance > 0:
        # The pneumatic trail decreases with slip.
        found["steering_compliance"] = [n.compliance + 0.5 * n.column * n.trail, compliance]
        found["roll_steer"] = None
    if n.trailer > 0:
        ball = simulation.HITCH_SHARE * n.trailer
        found["load"] = [ball, ball * (1 + simulation.HITCH / n.wheelbase) ** 2]
    if n.roll_steer > 0 or car.equations == RIGID:  # RIGID: camber and toe under roll and load transfer
        found["roll_steer"] = None
    return found


def _stiffness(curve: dict) -> list[float]:
    """Range of the stiffness factor of an axle, including compliance, from fits to the smallest third of the measured
    slip angles and to all of them."""
    force, file = np.array(curve["force"]), np.array(curve["file"])
    small = slice(0, max(2, len(force) // 3))
    slope, fitted = (float(force[part] @ file[part] / (file[part] @ file[part])) for part in (small, slice(None)))
    return [min(slope, fitted), max(slope, fitted)]


def _friction(equations: int, n: Parameters, vehicle: VehicleParameters) -> list[float]:
    """Range, over the axles, of the largest lateral force divided by that of the tyre in the file."""
    found = []
    for stiffness, lever, tyre in ((n.stiffness_front, n.wheelbase - n.front, vehicle.tyre_front),
                                   (n.stiffness_rear, n.front, vehicle.tyre_rear)):
        load = 0.5 * n.mass * GRAVITY * lever / n.wheelbase
        if equations in (BRISTLE, MULTI_BODY):
            peak_force = load * n.grip * (1.0 if equations == BRISTLE else PACKAGE_FRICTION)
        elif equations == RIGID:
            peak_force = max(abs(magic_1994(n.tyre, slip, 0.0, load, 0.0, 1.0, n.grip))
                             for slip in np.linspace(0.01, 0.5, 100))
        else:
            peak_force = max(abs(side_force(n.tyre, slip, 0.5 * stiffness, load, 0.0, n.grip, n.sliding, 1.0))
                             for slip in np.linspace(0.01, 0.5, 100))
        found.append(peak_force / magic_formula_peak(load, tyre))
    return [min(found), max(found)]


def axle_curves(n: Parameters, drives: Iterable[np.ndarray], vehicle: VehicleParameters) -> dict[str, dict]:
    """By axle: slip angle, force, force of the file, and number of rows of each point.

    The points are medians over rows of nearly steady driving; left and right turns are combined.
    """
    columns: list[list[np.ndarray]] = [[], [], [], []]
    for rows in drives:
        steady = (np.abs(rows[:, simulation.YAW_RATE_DOT]) < MAX_YAW_ACCELERATION) & (rows[:, 3] > MIN_SPEED) & (
            np.abs(np.gradient(rows[:, simulation.WHEEL], simulation.STEP)) < MAX_STEER_RATE)
        for column, values in zip(columns, simulation.axle_forces(rows[steady], n), strict=True):
            column.append(values)
    slip_f, force_f, slip_r, force_r = (np.concatenate(one) for one in columns)
    return {"front": _curve(slip_f, force_f, n.wheelbase - n.front, vehicle, vehicle.tyre_front),
            "rear": _curve(slip_r, force_r, n.front, vehicle, vehicle.tyre_rear)}


def _curve(slip: np.ndarray, force: np.ndarray, lever: float, vehicle: VehicleParameters, tyre) -> dict:
    side, size = -np.sign(slip), np.abs(slip)
    edges = np.linspace(0.0, float(np.quantile(size, 1 - EDGE)), POINTS + 1)[1:]
    width = edges[1] - edges[0]
    points, forces, counts = [], [], []
    for middle in edges[:-1]:
        near = np.abs(size - middle) < width / 2
        if near.sum() >= 20:
            points.append(float(np.median(size[near])))
            forces.append(float(np.median((side * force)[near])))
            counts.append(int(near.sum()))
    load = 0.5 * vehicle.mass * GRAVITY * (
        vehicle.cg_to_rear_axle if tyre is vehicle.tyre_front else vehicle.cg_to_front_axle) / vehicle.wheelbase
    file = -2 * magic_formula_force(np.array(points), *magic_formula_coefficients(load, tyre), tyre)
    return {"slip": points, "force": forces, "file": file.tolist(), "rows": counts}
