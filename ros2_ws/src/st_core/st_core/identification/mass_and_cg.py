"""Mass and position of the centre of gravity (CG) from four wheel scales, and its height from the axle-lift test.

    m = sum of the four readings,                l_f = l (sum of the two rear readings) / m
    u(m)^2   = s_m^2 / n + 4 u_s^2
    u(l_f)^2 = s_l^2 / n + 2 u_s^2 (l_f^2 + l_r^2) / m^2 + (l_f / l)^2 u(l)^2

s: standard deviation of the n weighings, between which the car is rolled off the scales and on again; the scatter is
due to friction in tyres and suspension. u_s: standard uncertainty of one scale, whose error is the same in every
weighing. l: wheelbase. Student's t for the interval has the degrees of freedom of Welch and Satterthwaite. Source:
paper, parameter identification. Checked by: test_identification_experiments.py.

The height h of the CG follows from the rear load versus pitch with the front axle lifted. The car rests on free-rolling
wheels with locked suspension, so each ground force is vertical and passes through the centre of its wheel. The moments
about the front wheel centres give, with pitch theta (nose up), wheelbase l, and height r of the line between front and
rear wheel centres, measured at the CG of the level car:

    m_r(theta) = m_r(0) + m (h - r) / l tan(theta)
    one pitch:   h = r + l (m_r(theta) - m_r(0)) / (m tan(theta))          (ISO 10392)
    all:         h = r + l b / m,  b: slope of m_r versus tan(theta), with a separate intercept for each lift
    r = r_front (1 - l_f / l) + r_rear l_f / l
    u(h)^2 = (l / m)^2 u(b)^2 + (h - r)^2 (u(m)^2 / m^2 + u(l)^2 / l^2) + u(r)^2

The radii are those of the level car, because h is its CG height. The deflection of the rear tyres when lifted does not
change h, since the force still passes through the wheel centre, but it changes the pitch computed from the lift.
Source: paper, parameter identification; ISO 10392. Valid for pitch up to 45 deg.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..regression import correlation_matrix, effective_degrees_of_freedom, symmetric_interval
from ..vehicle import VehicleParameters
from .result import Coverage, Identification, IdentificationError, ParameterEstimate, get_stated_uncertainty
from .steering import Line, fit_line

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
SCALE_UNCERTAINTY = 0.5  # kg; standard uncertainty of one scale: class III wheel pads with a resolution of 0.5 kg
MAX_SIDE_DIFFERENCE = 0.2  # left-right difference divided by the axle load; below 0.12 with one person in the car
MAX_MASS_RANGE = 0.02  # largest difference between weighings with equal loading, divided by the mass
MAX_LEVEL_PITCH = math.radians(0.5)  # rows with a smaller pitch count as level
MIN_PITCH_RANGE = math.radians(3.0)  # in a smaller range the rear load changes by only a few kg
MAX_PITCH = math.radians(45.0)
PITCH_BIN_WIDTH = math.radians(3.0)
RADIUS_UNCERTAINTY = 0.003  # m; standard uncertainty of a wheel radius read from a ruler
MAX_LOAD_DIFFERENCE = 0.02  # largest difference of the level car's rear load from the expected one, divided by the mass


@dataclass(frozen=True)
class Weighings:
    """Readings of four wheel scales in n weighings."""

    readings: np.ndarray  # (n, 4) [kg], columns as WHEELS
    names: tuple[str, ...]  # (n,) names of the weighings
    loads: tuple[str, ...]  # (n,) descriptions of the loading of the car
    scale_uncertainty: float = SCALE_UNCERTAINTY  # standard uncertainty of one scale [kg]


def identify_mass_and_cg(weighings: Weighings, vehicle: VehicleParameters) -> Identification:
    """Estimates of mass [kg] and cg_to_front_axle [m] for the most frequent loading (the first one in a tie).

    vehicle: its wheelbase and the uncertainty of the wheelbase are used; its CG position is only compared with the
    estimate. Raises IdentificationError for impossible or missing readings.
    """
    readings = _check_readings(weighings)
    load = max(weighings.loads, key=weighings.loads.count)
    is_used = np.array([other == load for other in weighings.loads])
    loadings = list(zip(weighings.names, weighings.loads, strict=True))
    used = tuple(name for name, other in loadings if other == load)
    rejected = tuple((name, f"different loading: {other or 'not noted'}") for name, other in loadings if other != load)
    used_readings, wheelbase, all_masses = readings[is_used], vehicle.wheelbase, readings.sum(axis=1)
    all_distances = wheelbase * readings[:, 2:].sum(axis=1) / all_masses
    masses, distances = all_masses[is_used], all_distances[is_used]
    n, mass, l_f = len(used_readings), float(masses.mean()), float(distances.mean())
    if np.ptp(masses) > MAX_MASS_RANGE * mass:
        raise IdentificationError(f"the weighings with equal loading differ by {np.ptp(masses):.1f} kg, with "
                                  f"a mean of {mass:.1f} kg, too much for one car: weigh again, or note the loading")
    variation = np.cov(masses, distances) / n if n > 1 else np.zeros((2, 2))
    # d l_f / d reading: -l_f / m at the front, (l - l_f) / m at the rear.
    gradient = np.stack([np.ones(4), np.array([-l_f, -l_f, wheelbase - l_f, wheelbase - l_f]) / mass])
    covariance = variation + weighings.scale_uncertainty**2 * gradient @ gradient.T
    covariance[1, 1] += (l_f / wheelbase * get_stated_uncertainty(vehicle, "wheelbase")) ** 2
    uncertainties = np.sqrt(np.diag(covariance)).tolist()
    degrees_of_freedom = [effective_degrees_of_freedom(variation[i, i], covariance[i, i], n - 1) for i in (0, 1)]
    intervals = list(map(symmetric_interval, (mass, l_f), uncertainties, degrees_of_freedom))
    method = (f"four wheel scales, {n} weighing{'s' * (n != 1)}, {weighings.scale_uncertainty:g} kg per scale"
              + (f", {load}" if load else ""))
    left_fraction = float(used_readings[:, [0, 2]].sum() / used_readings.sum())
    estimates = (
        ParameterEstimate(
            "mass", mass, "kg", uncertainties[0], intervals[0], method, used,
            f"The car weighs {mass:.1f} kg{f' with {load}' if load else ''}."),
        ParameterEstimate(
            "cg_to_front_axle", l_f, "m", uncertainties[1], intervals[1], method, used,
            f"{100 * (1 - l_f / wheelbase):.1f} % of the load is on the front axle and {100 * left_fraction:.1f} % on "
            f"the left wheels, so the CG is {l_f:.3f} m behind the front axle."))
    warnings = tuple(_check_scales(used_readings, len(rejected), l_f, vehicle))
    figure = {"is_used": is_used, "names": weighings.names, "masses": all_masses, "distances": all_distances}
    return Identification("scales", estimates, used, rejected, correlation_matrix(covariance), (), warnings, figure)


def _check_readings(weighings: Weighings) -> np.ndarray:
    readings = np.asarray(weighings.readings, dtype=float)
    if readings.ndim != 2 or readings.shape[1] != len(WHEELS) or not len(readings):
        raise IdentificationError(f"readings of shape {readings.shape}: expected four wheels for at least one weighing")
    for row, name in zip(readings, weighings.names, strict=True):
        for wheel, value in zip(WHEELS, row, strict=True):
            if not (math.isfinite(value) and value > 0.0):
                raise IdentificationError(f"weighing {name}: {wheel} reads {value:g} kg; each wheel must be on a scale")
        for axle, (a, b) in (("front", row[:2]), ("rear", row[2:])):
            if abs(a - b) > MAX_SIDE_DIFFERENCE * (a + b):
                raise IdentificationError(
                    f"weighing {name}: the {axle} wheels carry {a:.1f} and {b:.1f} kg, "
                    f"a difference of {100 * abs(a - b) / (a + b):.0f} % of the axle load; are two "
                    "columns exchanged, or is a wheel not on its scale?")
    if not (math.isfinite(weighings.scale_uncertainty) and weighings.scale_uncertainty > 0.0):
        raise IdentificationError(f"scale uncertainty {weighings.scale_uncertainty:g} kg: give that of one scale, > 0")
    return readings


def _check_scales(readings: np.ndarray, rejected_count: int, l_f: float, vehicle: VehicleParameters) -> Iterator[str]:
    """Warnings on the weighings. readings: those used, (n, 4) [kg]. rejected_count: weighings not used. l_f [m]."""
    mean = readings.mean(axis=0)
    cross_weight = (mean[0] + mean[3]) / mean.sum()
    if abs(cross_weight - 0.5) > 0.02:
        yield (f"The front-left and rear-right wheels carry {100 * cross_weight:.1f} % of the weight: the "
               "springs are preloaded unequally, or the floor under the scales is uneven; mass and CG position "
               "remain valid.")
    if len(readings) == 1:
        yield ("With one weighing, the interval does not include the scatter between weighings. Roll the car off and "
               "on, and weigh it at least three times.")
    if rejected_count:
        yield f"{rejected_count} of {len(readings) + rejected_count} weighings had a different load and were excluded."
    wheelbase, expected = vehicle.wheelbase, vehicle.cg_to_front_axle
    if abs(l_f - expected) > 0.05 * wheelbase and abs(wheelbase - l_f - expected) < 0.02 * wheelbase:
        yield (f"cg_to_front_axle is estimated as {l_f:.3f} m, the vehicle file has {expected:.3f} m; with front and "
               f"rear columns exchanged it would be {wheelbase - l_f:.3f} m. Check which columns are which.")


@dataclass(frozen=True)
class LiftRows:
    """Measurements (n,) of one or more lifts."""

    pitch: np.ndarray  # rad relative to the level car, nose up
    rear_load: np.ndarray  # kg, both wheels
    lifts: tuple[str, ...]  # name of the lift of each row
    front_radius: np.ndarray  # m, height of the wheel centres; NaN where not measured; required in a level row
    rear_radius: np.ndarray  # m, as front_radius

    @property
    def is_level(self) -> np.ndarray:
        """Mask (n,) of the rows in which the car is level."""
        return np.abs(self.pitch) <= MAX_LEVEL_PITCH


def compute_pitch(lift: np.ndarray, front_radius: np.ndarray, rear_radius: np.ndarray, wheelbase: float) -> np.ndarray:
    """Pitch [rad] relative to the first row, from the height of the platform under the front wheels [m]; (n,) each.

        theta_k = asin((lift_k + r_front,k - r_rear,k) / l),    pitch_k = theta_k - theta_0

    Raises IdentificationError for a missing radius or too large a pitch.
    """
    rise = (lift + front_radius - rear_radius) / wheelbase
    if not np.isfinite(rise).all() or np.abs(rise).max() >= math.sin(MAX_PITCH):
        raise IdentificationError(f"lift of {np.nanmax(lift):.3f} m on a wheelbase of {wheelbase:.3f} m: every row "
                                  "needs both wheel radii and a pitch below 45 deg; are the units correct?")
    angle = np.arcsin(rise)
    return angle - angle[0]


def identify_cg_height(data: LiftRows, vehicle: VehicleParameters, weighed_mass: float | None = None) -> Identification:
    """Estimate of cg_height [m]. Raises IdentificationError for unusable rows.

    vehicle: its wheelbase, the uncertainty of the wheelbase, and its CG position are used. weighed_mass: mass of the
    lifted car, assumed exact [kg]; None: mass of the vehicle, with its uncertainty.
    """
    _check_rows(data)
    line = fit_line(np.tan(data.pitch), data.rear_load, data.lifts)
    if line.slope <= 0.0:
        raise IdentificationError(f"the rear load changes by {line.slope * math.tan(math.radians(10.0)):+.1f} kg for "
                                  "10 deg of pitch, but must rise when the front axle is lifted: was the rear axle "
                                  "lifted, or are columns exchanged?")
    mass, wheelbase = weighed_mass or vehicle.mass, vehicle.wheelbase
    mass_uncertainty = 0.0 if weighed_mass else get_stated_uncertainty(vehicle, "mass")
    rear_fraction = vehicle.cg_to_front_axle / wheelbase  # of the load of the level car, on the rear axle
    radius, deflection_note = _compute_radii(data, rear_fraction)
    height_difference = wheelbase * line.slope / mass
    height = radius + height_difference
    slope_uncertainty = wheelbase / mass * line.uncertainty
    uncertainty = math.hypot(
        slope_uncertainty, height_difference * mass_uncertainty / mass,
        height_difference * get_stated_uncertainty(vehicle, "wheelbase") / wheelbase,
        RADIUS_UNCERTAINTY * math.hypot(1.0 - rear_fraction, rear_fraction))
    heights = radius + wheelbase * (_compute_load_transfers(data, line) / mass) / np.tan(data.pitch)
    average = float(heights[np.isfinite(heights)].mean())
    # Of all uncertainties, only that of the slope was estimated from a few rows.
    interval = symmetric_interval(height, uncertainty, effective_degrees_of_freedom(
        slope_uncertainty**2, uncertainty**2, line.degrees_of_freedom))
    lifts = tuple(dict.fromkeys(data.lifts))
    method = (f"ISO 10392 axle lift, {len(data.pitch)} rows in {len(lifts)} lift{'s' * (len(lifts) != 1)} up to "
              f"{math.degrees(data.pitch.max()):.1f} deg, wheel centres at {radius:.3f} m")
    estimate = ParameterEstimate(
        "cg_height", height, "m", uncertainty, interval, method, lifts,
        f"The CG is {height:.3f} m above the ground, {height_difference:.3f} m above the wheel centres; the mean "
        f"of the heights computed at each pitch angle is {average:.3f} m.{deflection_note}")
    edges = np.arange(0.0, data.pitch.max() + PITCH_BIN_WIDTH, PITCH_BIN_WIDTH)
    coverage = Coverage("pitch", "deg", np.degrees(edges), np.histogram(data.pitch, edges)[0], 1, 2)
    warnings = list(_check_lifts(data, mass, rear_fraction))
    if abs(average - height) > 2.0 * uncertainty:
        warnings.append(f"The average over the pitch angles, {average:.3f} m, differs from the fit, {height:.3f} m, by "
                        "more than twice the uncertainty of the fit: the average weights all pitch angles equally.")
    figure = {"pitch": data.pitch, "rear_load": data.rear_load, "lifts": data.lifts, "height_per_row": heights,
              "average": average, "slope": line.slope, "intercepts": line.intercepts}
    return Identification("cg-height", (estimate,), lifts, (), None, (coverage,), tuple(warnings), figure)


def _check_rows(data: LiftRows) -> None:
    pitch, is_level = data.pitch, data.is_level
    if not (np.isfinite(pitch).all() and np.isfinite(data.rear_load).all() and (data.rear_load > 0.0).all()):
        raise IdentificationError("every row needs a pitch and a rear load above 0 kg")
    if np.abs(pitch).max(initial=0.0) > MAX_PITCH:
        raise IdentificationError(f"pitch reaches {np.abs(pitch).max():.3g} rad = "
                                  f"{math.degrees(np.abs(pitch).max()):.0f} deg, limit 45 deg: is the unit in the "
                                  "header correct, or are two columns exchanged?")
    span = float(np.ptp(pitch)) if len(pitch) else 0.0
    if span < MIN_PITCH_RANGE:
        raise IdentificationError(f"pitch ranges over {math.degrees(span):.3g} deg, at least 3 are needed: lift "
                                  "further; if the column is in radians, name it pitch_rad")
    steps = len(np.unique(np.round(np.degrees(pitch[~is_level]), 1)))
    if not is_level.any() or steps < 2:
        raise IdentificationError(f"{int(is_level.sum())} level rows and {steps} lifted pitch angles: at least one "
                                  "level row and two lifted pitch angles are needed")
    if pitch[~is_level].max() <= 0.0:
        raise IdentificationError(f"pitch is never positive, but as low as {math.degrees(pitch.min()):.1f} deg: nose "
                                  "up is positive, with the front axle lifted")


def _compute_radii(data: LiftRows, rear_fraction: float) -> tuple[float, str]:
    """(height r of the module docstring [m], sentence on the deflection of the rear tyres)."""
    front, rear = (radius[data.is_level & np.isfinite(radius)] for radius in (data.front_radius, data.rear_radius))
    if not len(front) or not len(rear):
        raise IdentificationError("the level rows have no wheel radius: measure the height of the front and rear wheel "
                                  "centres above the ground with the car loaded and level")
    for name, values in (("front", front), ("rear", rear)):
        if not (values.min() > 0.1 and values.max() < 1.0):
            raise IdentificationError(f"{name} wheel radius {values.min():.3g} to {values.max():.3g} m is not within "
                                      "0.1 to 1 m: is the unit in the header correct?")
    deflection = float(rear.mean() - data.rear_radius[np.argmax(data.pitch)])
    text = (f" At the steepest pitch the rear tyres deflected by a further {1e3 * deflection:.1f} mm, which does not "
            "change the height of the level car.") if math.isfinite(deflection) else ""
    return float(front.mean() * (1.0 - rear_fraction) + rear.mean() * rear_fraction), text


def _compute_load_transfers(data: LiftRows, line: Line) -> np.ndarray:
    """(n,) [kg] rear load minus that of the level car in the same lift (mean of the level rows, or else the intercept);
    NaN at a pitch below MIN_PITCH_RANGE, or below the largest pitch if that is smaller."""
    is_usable = data.pitch >= min(MIN_PITCH_RANGE, data.pitch.max())
    transfers = np.full(len(data.pitch), np.nan)
    for name, intercept in line.intercepts.items():
        lift = np.asarray(data.lifts) == name
        level_load = data.rear_load[data.is_level & lift].mean() if (data.is_level & lift).any() else intercept
        transfers[is_usable & lift] = data.rear_load[is_usable & lift] - level_load
    return transfers


def _check_lifts(data: LiftRows, mass: float, rear_fraction: float) -> Iterator[str]:
    for name in dict.fromkeys(data.lifts):
        pitch = np.degrees(data.pitch[np.asarray(data.lifts) == name])
        falling_rows = np.flatnonzero(np.diff(pitch) < -0.05)
        if len(falling_rows):
            k = int(falling_rows[0])
            yield (f"Lift {name}: pitch falls from {pitch[k]:.1f} to {pitch[k + 1]:.1f} deg at row {k + 2}. The order "
                   "does not affect the fit, but friction changes the load on the way down: enter such rows as a "
                   "separate lift.")
    measured, expected = float(data.rear_load[data.is_level].mean()), mass * rear_fraction
    if abs(measured - expected) > MAX_LOAD_DIFFERENCE * mass:
        yield (f"With the car level, the rear wheels carry {measured:.1f} kg, but a mass of {mass:.1f} kg and the CG "
               f"position of the vehicle file give {expected:.1f} kg: the car was loaded differently. The height "
               "applies to the car as lifted, and only if it had this mass.")
