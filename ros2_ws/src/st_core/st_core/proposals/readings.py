"""A curve in words and formulas: which simple shape it is, and what in textbooks has that shape at that place."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

MOST = 3
SIMPLER, COARSEST = 0.01, 0.1  # of the explained part: a shape with one number more must explain so much more
LEAST = 0.5  # of the curve: a shape that explains less is none

Formula = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Reading:
    """shape: its name. text: the formula with its numbers, y the law and u the quantity, SI. explained [1]: share of
    the curve's square, weighted with how often each value was driven. causes: from textbooks."""

    shape: str
    text: str
    explained: float
    causes: str = ""


SHAPES: dict[str, tuple[str, int, Formula]] = {
    "constant": ("y = {0:.3g}", 1, lambda u, p: p[0] + 0.0 * u),
    "linear": ("y = {0:.3g} u", 1, lambda u, p: p[0] * u),
    "cubic": ("y = {0:.3g} u^3", 1, lambda u, p: p[0] * u**3),
    "square": ("y = {0:.3g} u |u|", 1, lambda u, p: p[0] * u * np.abs(u)),
    "saturating": ("y = {0:.3g} tanh(u / {1:.3g})", 2, lambda u, p: p[0] * np.tanh(u / _apart(p[1]))),
    "dead zone": ("y = {0:.3g} (|u| - {1:.3g}) sign u beyond {1:.3g}, 0 within", 2,
                  lambda u, p: p[0] * np.sign(u) * np.maximum(np.abs(u) - np.abs(p[1]), 0.0)),
    "linear and cubic": ("y = {0:.3g} u + {1:.3g} u^3", 2, lambda u, p: p[0] * u + p[1] * u**3),
}
ONE_SIDED: dict[str, tuple[str, int, Formula]] = {
    "constant": SHAPES["constant"], "linear": SHAPES["linear"], "dead zone": SHAPES["dead zone"],
    "straight line": ("y = {0:.3g} + {1:.3g} u", 2, lambda u, p: p[0] + p[1] * u),
    "square": ("y = {0:.3g} + {1:.3g} u |u|", 2, lambda u, p: p[0] + p[1] * u * np.abs(u)),
    "inverse": ("y = {0:.3g} + {1:.3g} / u", 2, lambda u, p: p[0] + p[1] / np.where(np.abs(u) < 1e-9, 1e-9, u)),
    "saturating": ("y = {0:.3g} + {1:.3g} tanh(u / {2:.3g})", 3,
                   lambda u, p: p[0] + p[1] * np.tanh(u / _apart(p[2]))),
}
"""Of a curve without a mirror image: a constant is what a parameter of the vehicle file can do as well, so that the
curve is known but for one."""

CAUSES = {
    ("front_steer", "acceleration_y"): "roll steer or compliance of the front suspension",
    ("rear_steer", "acceleration_y"): "roll steer or compliance of the rear suspension",
    ("front_steer", "steering"): "a steering ratio that depends on the angle, play, or a wrong angle sensor",
    ("rear_steer", "steering"): "rear-wheel steering, or a twist of the car under steering",
    ("front_steer", "speed"): "toe that changes with speed; a steering offset under load",
    ("front_steer", "acceleration_x"): "brake or drive steer of the front axle, torque steer",
    ("rear_steer", "acceleration_x"): "brake or drive steer of the rear axle",
    ("rear_steer", "speed"): "lift that raises the rear and changes its toe",
    ("front_force", "slip_front"): "another curve of the front tyres, camber thrust",
    ("rear_force", "slip_rear"): "another curve of the rear tyres, camber thrust",
    ("front_grip", "speed"): "lift or downforce at the front axle (with v^2), tyres that change with speed",
    ("rear_grip", "speed"): "lift or downforce at the rear axle (with v^2), tyres that change with speed",
    ("front_grip", "acceleration_x"): "load transfer, combined slip of a driven or braked front axle",
    ("rear_grip", "acceleration_x"): "load transfer, combined slip of a driven or braked rear axle",
    ("yaw_moment", "acceleration_x"): "torque steer, unequal brakes, a differential",
    ("yaw_moment", "speed"): "aerodynamic yaw moment (with v^2), unequal drag of the wheels",
    ("yaw_moment", "yaw_rate"): "yaw damping, scrub of twin wheels, a locked differential",
    ("yaw_moment", "acceleration_y"): "load transfer on steered or driven wheels, a differential",
    ("side_force", "speed"): "aerodynamic side force (with v^2), wind, banked road",
    ("side_force", "acceleration_x"): "thrust or brake force that is not along the car",
    ("side_force", "acceleration_y"): "camber thrust of both axles, roll of the body",
    ("sensor_yaw_rate", "acceleration_y"): "a gyroscope that feels acceleration (g-sensitivity)",
    ("sensor_yaw_rate", "yaw_rate"): "a gyroscope whose scale is not constant",
    ("sensor_acceleration_y", "acceleration_y"): "an accelerometer that rolls with the body",
    ("sensor_velocity_y", "acceleration_y"): "a velocity taken at another point, or turned axes under roll",
    ("sensor_velocity_y", "yaw_rate"): "a lever arm of the unit along the car",
    ("sensor_velocity_y", "speed"): "a unit mounted askew",
    ("sensor_heading", "speed"): "a heading that depends on speed: an antenna baseline askew",
    ("sensor_heading", "acceleration_y"): "a heading that leans with the body",
    ("front_steer", "steering_rate"): "a damper or play in the steering, a late or early angle",
    ("front_steer", "lagging_steering"): "a steering map with a lag, give in the column",
    ("front_steer", "lean"): "roll steer of the front suspension",
    ("front_steer", "run_time"): "an angle sensor that drifts, a linkage that settles",
    ("rear_steer", "lagging_steering"): "rear-wheel steering with a lag, a body that twists",
    ("rear_steer", "lean"): "roll steer of the rear suspension",
    ("both_grip", "run_time"): "tyres that warm up or wear, a road that dries",
    ("both_grip", "position_x"): "a road whose grip changes from place to place",
    ("both_grip", "position_y"): "a road whose grip changes from place to place",
    ("side_force", "north"): "wind or a slope, by the course", ("side_force", "east"): "wind or a slope, by the course",
    ("side_force", "position_x"): "a banked road or wind at a place",
    ("side_force", "position_y"): "a banked road or wind at a place",
}

PAIRED = {
    ("front_steer", "speed", "steering_rate"): "a delay of the steering that changes with speed (- later)",
    ("front_steer", "speed", "steering"): "a steering ratio that changes with speed, power steering, an active rack",
    ("rear_steer", "speed", "acceleration_y"): "roll steer or compliance of the rear that changes with speed",
    ("yaw_moment", "acceleration_x", "steering"): "torque steer of turned wheels, a differential",
}
CONSTANT = {
    "front_steer": "a steering offset, toe", "rear_steer": "a rear axle askew", "yaw_moment": "unequal drag or brakes",
    "side_force": "steady wind, a banked road", "sensor_yaw_rate": "a bias of the sensor",
    "sensor_acceleration_y": "a bias or tilt of the sensor", "sensor_velocity_y": "a unit mounted askew",
    "sensor_heading": "a unit mounted askew",
}


def readings(place: str, quantity: str, at: np.ndarray, value: np.ndarray, weight: np.ndarray, by: str = "",
             mirrored: bool = True, deviation: np.ndarray | float = 0.0) -> Sequence[Reading]:
    """Up to three shapes, best first. at, value: (k,) the curve; weight: (k,) how often each value was driven. by: what
    the curve is multiplied with. mirrored: whether it is odd by nature. deviation: of the curve; a shape with one
    number more has to explain more than that."""
    weight = weight / max(float(weight.sum()), 1e-30)
    total = float(weight @ np.square(value))
    if total <= 0.0:
        return ()
    simpler = min(max(SIMPLER, float(weight @ np.square(deviation + 0.0 * value)) / total), COARSEST)
    found = []
    for shape, (text, count, formula) in (SHAPES if mirrored else ONE_SIDED).items():
        if shape == "inverse" and np.abs(at).min() < 0.05 * np.abs(at).max():
            continue
        numbers = _fitted(formula, count, at, value, weight)
        if shape == "dead zone":
            numbers[1] = abs(numbers[1])
        explained = 1.0 - float(weight @ np.square(value - formula(at, numbers))) / total
        if explained >= LEAST:
            causes = (PAIRED.get((place, quantity, by), "") if by else CONSTANT.get(place, "") if shape == "constant"
                      else CAUSES.get((place, quantity), ""))
            found.append((explained - simpler * (count - 1), Reading(shape, text.format(*numbers), explained, causes)))
    return tuple(reading for _, reading in sorted(found, key=lambda f: -f[0])[:MOST])


def _apart(number: float) -> float:
    return number if abs(number) > 1e-9 else 1e-9


def _fitted(formula: Formula, count: int, at: np.ndarray, value: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted least squares, from several starts where the shape is not linear in its numbers."""
    size, reach = float(np.abs(value).max()), float(np.abs(at).max())
    root = np.sqrt(weight)
    sign = float(np.sign(weight @ (value * np.sign(at)))) or 1.0
    best = None
    for share in (0.15, 0.4, 0.8):
        start = np.array([sign * size / max(reach, 1e-9), share * reach, share * reach][:count])
        done = least_squares(lambda p: root * (formula(at, p) - value) / size, start, x_scale=np.abs(start) + 1e-9)
        if best is None or done.cost < best.cost:
            best = done
    assert best is not None
    return best.x
