"""Height of the centre of gravity (CG) from the axle-lift test: rear load versus pitch with the front axle lifted.

The car rests on free-rolling wheels with locked suspension, so each ground force is vertical and passes through the
centre of its wheel. Moments about the front wheel centres, with pitch theta (nose up), wheelbase l, and, for the level
car, the height r of the line between the wheel centres at the CG:

    m_r(theta) = m_r(0) + m (h - r) / l tan(theta)
    one pitch:   h = r + l (m_r(theta) - m_r(0)) / (m tan(theta))          (ISO 10392)
    all:         h = r + l b / m,  b: slope of m_r versus tan(theta), with a separate intercept for each lift
    r = r_front (1 - l_f / l) + r_rear l_f / l
    u(h)^2 = (l / m)^2 u(b)^2 + (h - r)^2 (u(m)^2 / m^2 + u(l)^2 / l^2) + u(r)^2

The radii are those of the level car, because h is its CG height. The deflection of the rear tyres when lifted does not
change h, since the force still passes through the wheel centre, but it changes the pitch computed from the lift.
Source: paper, parameter identification; ISO 10392. Valid for pitch up to 45 deg. Checked by:
test_identification_experiments.py.
"""

import math
from dataclasses import dataclass

import numpy as np

from ..regression import effective_degrees_of_freedom, symmetric_interval
from .result import Coverage, Estimate, Identification, IdentificationError
from .steering_ratio import Line, fit_line

MAX_LEVEL_PITCH = math.radians(0.5)  # rows with a smaller pitch count as level
MIN_PITCH_RANGE = math.radians(3.0)  # in a smaller range the rear load changes by a few kg only
MAX_PITCH = math.radians(45.0)
PITCH_BIN_WIDTH = math.radians(3.0)
RADIUS_UNCERTAINTY = 0.003  # m; standard uncertainty of a wheel radius read from a ruler
MAX_LOAD_DIFFERENCE = 0.02  # largest error of the rear load of the level car, divided by the mass


@dataclass(frozen=True)
class LiftRows:
    """Measurements (n,) of one or more lifts."""

    pitch: np.ndarray  # rad relative to the level car, nose up
    rear_load: np.ndarray  # kg, both wheels
    lifts: tuple[str, ...]  # name of the lift of each row
    front_radius: np.ndarray  # m, height of the wheel centres; NaN where not measured; required for the level rows
    rear_radius: np.ndarray  # m, as front_radius


@dataclass(frozen=True)
class LiftedCar:
    """The car in the state of the test, with standard uncertainties."""

    mass: float  # kg
    wheelbase: float  # m
    cg_to_front_axle: float  # m
    mass_uncertainty: float = 0.0
    wheelbase_uncertainty: float = 0.0


def compute_pitch(lift: np.ndarray, front_radius: np.ndarray, rear_radius: np.ndarray, wheelbase: float) -> np.ndarray:
    """Pitch [rad] relative to the first row, from the lift of the ground under the front wheels [m]; (n,) each.

        theta_k = asin((lift_k + r_front,k - r_rear,k) / l),    pitch_k = theta_k - theta_0

    Raises IdentificationError for a missing radius or too large a pitch.
    """
    rise = (lift + front_radius - rear_radius) / wheelbase
    if not np.isfinite(rise).all() or np.abs(rise).max() >= math.sin(MAX_PITCH):
        raise IdentificationError(f"lift of {np.nanmax(lift):.3f} m on a wheelbase of {wheelbase:.3f} m: every row "
                                  "needs both wheel radii and a pitch below 45 deg; are lift and radii in the units "
                                  "of the header?")
    angle = np.arcsin(rise)
    return angle - angle[0]


def identify_cg_height(data: LiftRows, car: LiftedCar) -> Identification:
    """Estimate of cg_height [m]. Raises IdentificationError for unusable rows."""
    level = _check_rows(data)
    line = fit_line(np.tan(data.pitch), data.rear_load, data.lifts)
    if line.slope <= 0.0:
        raise IdentificationError(f"the rear load changes by {line.slope * math.tan(math.radians(10.0)):+.1f} kg for "
                                  "10 deg of pitch, but must rise when the front axle is lifted: was the rear axle "
                                  "lifted, or are columns exchanged?")
    radius, deflection = _compute_radii(data, car, level)
    height_difference = car.wheelbase * line.slope / car.mass
    height = radius + height_difference
    rear_share = car.cg_to_front_axle / car.wheelbase  # of the load of the level car
    uncertainty = math.hypot(
        car.wheelbase / car.mass * line.uncertainty, height_difference * car.mass_uncertainty / car.mass,
        height_difference * car.wheelbase_uncertainty / car.wheelbase,
        RADIUS_UNCERTAINTY * math.hypot(1.0 - rear_share, rear_share))
    single, usable = _compute_single_heights(data, car, level, radius, line)
    average = float(single[usable].mean())
    # Only the uncertainty of the slope was estimated from a few rows; the other uncertainties are known.
    degrees_of_freedom = effective_degrees_of_freedom((car.wheelbase / car.mass * line.uncertainty) ** 2,
                                                      uncertainty**2, line.degrees_of_freedom)
    interval = symmetric_interval(height, uncertainty, degrees_of_freedom)
    lifts = tuple(dict.fromkeys(data.lifts))
    method = (f"ISO 10392 axle lift, {len(data.pitch)} rows in {len(lifts)} lift{'s' * (len(lifts) != 1)} up to "
              f"{math.degrees(data.pitch.max()):.1f} deg, wheel centres at {radius:.3f} m")
    deflection_note = "" if deflection is None else (
        f" At the steepest pitch the rear tyres deflected by a further {1e3 * deflection:.1f} mm, which does not "
        "change the height of the level car.")
    estimate = Estimate(
        "cg_height", height, "m", uncertainty, interval, method, lifts,
        f"The CG is {height:.3f} m above the ground, {height_difference:.3f} m above the wheel centres; the average "
        f"over the pitch angles, the method of the paper, is {average:.3f} m.{deflection_note}")
    edges = np.arange(0.0, data.pitch.max() + PITCH_BIN_WIDTH, PITCH_BIN_WIDTH)
    counts = np.histogram(data.pitch, edges)[0]
    coverage = Coverage("pitch", "deg", np.degrees(edges), counts, 1, 2)
    warnings = [*_describe_unordered_rows(data), *_describe_load_difference(data, car, level)]
    if abs(average - height) > 2.0 * uncertainty:
        warnings.append(f"The average over the pitch angles, {average:.3f} m, differs from the fit, {height:.3f} m, by "
                        "more than twice the uncertainty of the fit: the average weights all pitch angles equally.")
    figure = {"pitch": data.pitch, "rear_load": data.rear_load, "lifts": data.lifts, "single": single, "usable": usable,
              "average": average, "slope": line.slope, "intercepts": line.intercepts, "radius": radius}
    return Identification("cg-height", (estimate,), lifts, (), None, (coverage,), tuple(warnings), figure)


def _check_rows(data: LiftRows) -> np.ndarray:
    """Mask (n,) of the level rows. Raises IdentificationError for unusable rows."""
    pitch = data.pitch
    if not (np.isfinite(pitch).all() and np.isfinite(data.rear_load).all() and (data.rear_load > 0.0).all()):
        raise IdentificationError("every row needs a pitch and a rear load above 0 kg")
    if np.abs(pitch).max(initial=0.0) > MAX_PITCH:
        raise IdentificationError(f"pitch reaches {np.abs(pitch).max():.3g} rad = "
                                  f"{math.degrees(np.abs(pitch).max()):.0f} deg, limit 45 deg: is the unit in the "
                                  "header right, or are two columns exchanged?")
    level = np.abs(pitch) <= MAX_LEVEL_PITCH
    span = float(np.ptp(pitch)) if len(pitch) else 0.0
    if span < MIN_PITCH_RANGE:
        raise IdentificationError(f"pitch ranges over {math.degrees(span):.3g} deg, at least 3 are needed: lift "
                                  "further; if the column is in radians, name it pitch_rad")
    steps = len(np.unique(np.round(np.degrees(pitch[~level]), 1)))
    if not level.any() or steps < 2:
        raise IdentificationError(f"{int(level.sum())} level rows and {steps} lifted pitch angles: at least one level "
                                  "row and two lifted pitch angles are needed")
    if pitch[~level].max() <= 0.0:
        raise IdentificationError(f"pitch is never positive, down to {math.degrees(pitch.min()):.1f} deg: nose up is "
                                  "positive, with the front axle lifted")
    return level


def _compute_radii(data: LiftRows, car: LiftedCar, level: np.ndarray) -> tuple[float, float | None]:
    """(height of the line between the wheel centres at the CG, further deflection of the lifted rear tyres) [m]."""
    front, rear = (radius[level & np.isfinite(radius)] for radius in (data.front_radius, data.rear_radius))
    if not len(front) or not len(rear):
        raise IdentificationError("the level rows have no wheel radius: measure the height of the front and rear wheel "
                                  "centres above the ground with the car loaded and level")
    for name, values in (("front", front), ("rear", rear)):
        if not (values.min() > 0.1 and values.max() < 1.0):
            raise IdentificationError(f"{name} wheel radius {values.min():.3g} to {values.max():.3g} m is not within "
                                      "0.1 to 1 m: is the unit in the header right?")
    rear_share = car.cg_to_front_axle / car.wheelbase
    height = float(front.mean() * (1.0 - rear_share) + rear.mean() * rear_share)
    steepest = int(np.argmax(data.pitch))
    lifted = data.rear_radius[steepest]
    return height, float(rear.mean() - lifted) if math.isfinite(lifted) and not level[steepest] else None


def _compute_single_heights(data: LiftRows, car: LiftedCar, level: np.ndarray, radius: float,
                            line: Line) -> tuple[np.ndarray, np.ndarray]:
    """(height from each row alone (n,), mask of the rows that determine a height). The level load of a lift is the
    mean of its level rows."""
    groups = np.asarray(data.lifts)
    level_load = np.array([data.rear_load[level & (groups == name)].mean() if (level & (groups == name)).any()
                           else line.intercepts[name] for name in data.lifts])
    usable = data.pitch >= MIN_PITCH_RANGE
    if not usable.any():
        usable = data.pitch == data.pitch.max()
    single = np.full(len(data.pitch), np.nan)
    transfer = (data.rear_load - level_load)[usable] / car.mass
    single[usable] = radius + car.wheelbase * transfer / np.tan(data.pitch[usable])
    return single, usable


def _describe_unordered_rows(data: LiftRows) -> list[str]:
    sentences, groups = [], np.asarray(data.lifts)
    for name in dict.fromkeys(data.lifts):
        pitch = np.degrees(data.pitch[groups == name])
        back = np.flatnonzero(np.diff(pitch) < -0.05)
        if len(back):
            k = int(back[0])
            sentences.append(f"Lift {name}: pitch does not rise row by row, it falls from {pitch[k]:.1f} to "
                             f"{pitch[k + 1]:.1f} deg at row {k + 2}. The order does not affect the fit, but friction "
                             "changes the load on the way down: enter such rows as a separate lift.")
    return sentences


def _describe_load_difference(data: LiftRows, car: LiftedCar, level: np.ndarray) -> list[str]:
    measured = float(data.rear_load[level].mean())
    expected = car.mass * car.cg_to_front_axle / car.wheelbase
    if abs(measured - expected) <= MAX_LOAD_DIFFERENCE * car.mass:
        return []
    return [f"With the car level, the rear wheels carry {measured:.1f} kg, but mass and CG position of the vehicle "
            f"file give {expected:.1f} kg: the car was loaded differently. The height applies to the car as lifted, "
            f"and only if its mass was {car.mass:.1f} kg."]
