"""A curve in words and formulas: which simple shape it is, and what in textbooks has that shape at that place."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ..discovery.loss import Quadratic
from .places import NEITHER, Candidate

MOST, POINTS = 3, 61
LEAST = 0.5  # of what the curve explains: a shape that explains less is none
SAME = 1e-3  # of what the curve explains: a shape with more numbers that gains less is one with fewer
FULLY, NEARLY = 0.98, 0.9  # of what the best shape explains: enough to stand for the curve; what it takes at least

Formula = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Reading:
    """shape: its name. text: the formula with its numbers, y the law and u the quantity, SI. explained [1]: share of
    what the curve takes off the loss. causes: from textbooks."""

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
    "constant": SHAPES["constant"], "linear": SHAPES["linear"],
    "straight line": ("y = {0:.3g} + {1:.3g} u", 2, lambda u, p: p[0] + p[1] * u),
    "square": ("y = {0:.3g} + {1:.3g} u |u|", 2, lambda u, p: p[0] + p[1] * u * np.abs(u)),
    "dead zone": SHAPES["dead zone"],
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


def readings(law: Candidate, coefficients: np.ndarray, seen: Quadratic, fold: np.ndarray) -> Sequence[Reading]:
    """Up to three shapes, best first. seen: of the loss about the coefficients (8,), by block; fold: (b,) of held-out.

    The numbers of a shape are those that lose least. What a parameter of the vehicle file can do as well is no
    information: a curve without a mirror image may be known but for a constant. Of shapes that explain at least LEAST,
    the best is the one that loses least on driving its numbers were not fitted to. Another may stand for the curve
    where it explains FULLY as much; or NEARLY as much, and loses no more than one standard error more there, by the
    differences of blocks (Breiman et al. 1984). The one of fewest numbers that may is first, of several the one
    that holds out best; the others follow as they hold out.
    """
    at = np.linspace(law.low, law.high, POINTS)
    into, value = np.linalg.pinv(law.splines(at).T, rcond=1e-6), coefficients @ law.splines(at)

    def lost(away: np.ndarray) -> np.ndarray:
        """(b,) against the curve, with coefficients that far from its."""
        return np.einsum("i,bij,j->b", away, seen.hessian, away) - 2.0 * seen.gradient @ away

    total = float(lost(-coefficients).sum())
    if total <= 1e-20:
        return ()
    found: dict[Reading, tuple[int, np.ndarray]] = {}
    for shape, (text, count, formula) in (SHAPES if law.parity != NEITHER else ONE_SIDED).items():
        if shape == "inverse" and np.abs(at).min() < 0.05 * np.abs(at).max():
            continue

        def numbers(known: np.ndarray, count: int = count, formula: Formula = formula) -> np.ndarray:
            h, g = seen.hessian[known].sum(axis=0), seen.gradient[known].sum(axis=0)
            h = h + (1e-6 * np.trace(h) / len(h) + 1e-9) * np.eye(len(h))
            root, wanted = np.linalg.cholesky(h), coefficients + np.linalg.solve(h, g)
            return _fitted(lambda p: (into @ formula(at, p) - wanted) @ root, count, at, value)

        def away(p: np.ndarray, formula: Formula = formula) -> np.ndarray:
            return into @ formula(at, p) - coefficients

        best = numbers(np.ones(len(fold), bool))
        if shape == "dead zone":
            best[1] = abs(best[1])
        explained = min(1.0 - float(lost(away(best)).sum()) / total, 1.0)
        if explained >= LEAST:
            held_out = np.zeros(len(fold))
            for k in np.unique(fold):
                held_out[fold == k] = lost(away(numbers(fold != k)))[fold == k]
            found[Reading(shape, text.format(*best), explained, _causes(law, shape))] = count, held_out
    return _ordered(found)


def _ordered(found: Mapping[Reading, tuple[int, np.ndarray]]) -> Sequence[Reading]:
    """The simplest that may stand for the curve first. found: numbers of each, and (b,) loss held out."""
    if not found:
        return ()
    order = sorted((one for one in found if not any(
        found[o][0] < found[one][0] and o.explained > one.explained - SAME for o in found)),
        key=lambda r: float(found[r][1].sum()))
    best, least = order[0], found[order[0]][1]

    def stands(one: Reading) -> bool:
        worse, share = found[one][1] - least, one.explained / best.explained
        alike = float(worse.sum()) <= float(worse.std(ddof=1)) * np.sqrt(len(worse))
        return share >= FULLY or (share >= NEARLY and alike)

    first = min(filter(stands, order), key=lambda r: found[r][0])
    return (first, *(one for one in order if one is not first))[:MOST]


def _causes(law: Candidate, shape: str) -> str:
    if law.by:
        return PAIRED.get((law.place, law.quantity, law.by), "")
    return CONSTANT.get(law.place, "") if shape == "constant" else CAUSES.get((law.place, law.quantity), "")


def _apart(number: float) -> float:
    return number if abs(number) > 1e-9 else 1e-9


def _fitted(missed: Callable[[np.ndarray], np.ndarray], count: int, at: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Least squares of what a shape misses, from several starts where the shape is not linear in its numbers."""
    size, reach = float(np.abs(value).max()), float(np.abs(at).max())
    sign = float(np.sign(np.sum(value * np.sign(at)))) or 1.0
    best = None
    for share in (0.15, 0.4, 0.8):
        start = np.array([sign * size / max(reach, 1e-9), share * reach, share * reach][:count])
        done = least_squares(missed, start, x_scale=np.abs(start) + 1e-9)
        if best is None or done.cost < best.cost:
            best = done
    assert best is not None
    return best.x
