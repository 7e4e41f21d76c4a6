"""Mass and position of the centre of gravity (CG) from four wheel scales.

    m = sum of the four readings,                l_f = l (sum of the two rear readings) / m
    u(m)^2   = s_m^2 / n + 4 u_s^2
    u(l_f)^2 = s_l^2 / n + 2 u_s^2 (l_f^2 + l_r^2) / m^2 + (l_f / l)^2 u(l)^2

s: standard deviation of the n weighings of the same car, rolled off and on again, due to friction in tyres and
suspension; u_s: standard uncertainty of one scale, whose error repeats in every weighing; l: wheelbase. Student's t for
the interval has the degrees of freedom of Welch and Satterthwaite. Source: paper, parameter identification.
Checked by: test_identification_experiments.py.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..regression import correlation_matrix, effective_degrees_of_freedom, symmetric_interval
from ..vehicle import VehicleParameters
from .result import Identification, IdentificationError, ParameterEstimate, get_stated_uncertainty

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
SCALE_UNCERTAINTY = 0.5  # kg; standard uncertainty of one scale: class III wheel pads with steps of 0.5 kg
MAX_SIDE_DIFFERENCE = 0.2  # left-right difference divided by the axle load; below 0.12 with one person in the car
MAX_MASS_RANGE = 0.02  # largest relative range of the mass over weighings of one loading


@dataclass(frozen=True)
class Weighings:
    """n weighings."""

    readings: np.ndarray  # (n, 4) [kg], columns as WHEELS
    names: tuple[str, ...]  # (n,) names of the weighings
    loads: tuple[str, ...]  # (n,) descriptions of the loading of the car
    scale_uncertainty: float = SCALE_UNCERTAINTY  # standard uncertainty of one scale [kg]


def identify_mass_and_cg(weighings: Weighings, vehicle: VehicleParameters) -> Identification:
    """Estimates of mass [kg] and cg_to_front_axle [m] for the most frequent loading (the first one in a tie).

    vehicle: its wheelbase, with uncertainty, is used; its CG position is only compared with the estimate. Raises
    IdentificationError for impossible or missing readings.
    """
    readings = _check_readings(weighings)
    load = max(weighings.loads, key=weighings.loads.count)
    is_used = np.array([other == load for other in weighings.loads])
    named = list(zip(weighings.names, weighings.loads, strict=True))
    used = tuple(name for name, other in named if other == load)
    rejected = tuple((name, f"another loading: {other or 'not noted'}") for name, other in named if other != load)
    chosen, wheelbase, all_masses = readings[is_used], vehicle.wheelbase, readings.sum(axis=1)
    all_distances = wheelbase * readings[:, 2:].sum(axis=1) / all_masses
    masses, distances = all_masses[is_used], all_distances[is_used]
    n, mass, front = len(chosen), float(masses.mean()), float(distances.mean())
    if np.ptp(masses) > MAX_MASS_RANGE * mass:
        raise IdentificationError(f"the weighings of one loading differ by {np.ptp(masses):.1f} kg of {mass:.1f} kg, "
                                  "too much for the same car: weigh again, or note the loading")
    variation = np.cov(masses, distances) / n if n > 1 else np.zeros((2, 2))
    # d l_f / d reading: -l_f / m in front, (l - l_f) / m in the rear.
    gradient = np.stack([np.ones(4), np.array([-front, -front, wheelbase - front, wheelbase - front]) / mass])
    covariance = variation + weighings.scale_uncertainty**2 * gradient @ gradient.T
    covariance[1, 1] += (front / wheelbase * get_stated_uncertainty(vehicle, "wheelbase")) ** 2
    uncertainties = np.sqrt(np.diag(covariance)).tolist()
    degrees_of_freedom = [effective_degrees_of_freedom(variation[i, i], covariance[i, i], n - 1) for i in (0, 1)]
    intervals = list(map(symmetric_interval, (mass, front), uncertainties, degrees_of_freedom))
    method = (f"four wheel scales, {n} weighing{'s' * (n != 1)}, {weighings.scale_uncertainty:g} kg per scale"
              + (f", {load}" if load else ""))
    left = float(chosen[:, [0, 2]].sum() / chosen.sum())
    estimates = (
        ParameterEstimate(
            "mass", mass, "kg", uncertainties[0], intervals[0], method, used,
            f"The car weighs {mass:.1f} kg{f' with {load}' if load else ''}."),
        ParameterEstimate(
            "cg_to_front_axle", front, "m", uncertainties[1], intervals[1], method, used,
            f"{100 * (1 - front / wheelbase):.1f} % of the load is on the front axle and {100 * left:.1f} % on "
            f"the left wheels, so the CG is {front:.3f} m behind the front axle."))
    warnings = tuple(_make_warnings(chosen, len(rejected), front, vehicle))
    figure = {"is_used": is_used, "names": weighings.names, "masses": all_masses, "distances": all_distances}
    return Identification("scales", estimates, used, rejected, correlation_matrix(covariance), (), warnings, figure)


def _check_readings(weighings: Weighings) -> np.ndarray:
    readings = np.asarray(weighings.readings, dtype=float)
    if readings.ndim != 2 or readings.shape[1] != len(WHEELS) or not len(readings):
        raise IdentificationError(f"readings of shape {readings.shape}: expected four wheels per weighing, and at "
                                  "least one weighing")
    for row, name in zip(readings, weighings.names, strict=True):
        for wheel, value in zip(WHEELS, row, strict=True):
            if not (math.isfinite(value) and value > 0.0):
                raise IdentificationError(f"weighing {name}: {wheel} reads {value:g} kg; all four wheels must stand on "
                                          "scales")
        for axle, (a, b) in (("front", row[:2]), ("rear", row[2:])):
            if abs(a - b) > MAX_SIDE_DIFFERENCE * (a + b):
                raise IdentificationError(
                    f"weighing {name}: the {axle} wheels carry {a:.1f} and {b:.1f} kg, "
                    f"a difference of {100 * abs(a - b) / (a + b):.0f} % of the axle load; are two "
                    "columns exchanged, or is a wheel not on its scale?")
    if not (math.isfinite(weighings.scale_uncertainty) and weighings.scale_uncertainty > 0.0):
        raise IdentificationError(f"scale uncertainty {weighings.scale_uncertainty:g} kg: give the standard "
                                  "uncertainty of one scale, above 0")
    return readings


def _make_warnings(readings: np.ndarray, rejected: int, front: float, vehicle: VehicleParameters) -> Iterator[str]:
    """Warnings. readings: (n, 4) of the weighings used. rejected: number of others. front: cg_to_front_axle [m]."""
    mean = readings.mean(axis=0)
    cross_weight = (mean[0] + mean[3]) / mean.sum()
    if abs(cross_weight - 0.5) > 0.02:
        yield (f"The front left and rear right wheels together carry {100 * cross_weight:.1f} % (cross weight): the "
               "springs are preloaded unequally, or the floor under the scales is uneven; mass and longitudinal CG "
               "position remain valid.")
    if len(readings) == 1:
        yield ("With one weighing, the interval does not include the scatter between weighings. Roll the car off and "
               "on, and weigh it at least three times.")
    if rejected:
        yield f"{rejected} of {len(readings) + rejected} weighings have another loading and were left out."
    wheelbase, expected = vehicle.wheelbase, vehicle.cg_to_front_axle
    if abs(front - expected) > 0.05 * wheelbase and abs(wheelbase - front - expected) < 0.02 * wheelbase:
        yield (f"cg_to_front_axle is estimated as {front:.3f} m, the vehicle file has {expected:.3f} m; with front and "
               f"rear columns exchanged it would be {wheelbase - front:.3f} m. Check which columns are which.")
