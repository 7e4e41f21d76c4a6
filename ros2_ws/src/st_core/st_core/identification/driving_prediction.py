"""Stiffnesses, steering and yaw inertia from multi-step predictions of several drives at once.

Steering offset and INS misalignment are also fitted, since their errors have effects similar to errors of the tyres.
Stiffness: the nonlinear model yields the slope at zero slip and static load, with the tyre curve of the vehicle file.
The linear model yields the secant that predicts best in the slip range of the drives. If the true curve differs, the
value depends on the slip range, which the interval allows for (`estimate_slip_range_uncertainty`).

Steering ratio, if no turntables are available:

    L kappa + K v^2 kappa = delta,    delta = (delta_h - o) / i

Slow bends determine the ratio i, fast bends the understeer gradient K, straights the offset o. Dead time and relaxation
are also fitted, since a lag would change the ratio. A wheelbase that is too large by 1 % makes i too small by 1 %.

Yaw inertia, from transients:

    I_z r_dot = l_f F_f cos(delta) - l_r F_r

Like inertia, steering dynamics, wrong time stamps and tyre relaxation delay the response, roll of the body shifts the
phase of the lateral velocity of the INS, and a wrong steering ratio acts differently at each speed. Therefore dead
time, relaxation length, this roll and the ratio are also fitted. The delay from an angle to its time stamp, at most one
sampling interval T, differs between the N drives. This adds the standard uncertainty T / sqrt(12 N) to their common
dead time, and thereby increases that of the inertia.
Checked by: test_identification_driving.py.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .. import regression
from ..augmented import AugmentedModel
from ..channels import CHANNELS
from ..effects import get_effect
from ..handling import find_implausible_values
from ..log import DriveLog
from ..models import Model, get_model
from ..timeseries import NANOSECOND
from ..vehicle import VEHICLE_QUANTITIES, VehicleParameters
from .axle_forces import MAX_RANGE_RATIO, MAX_RELATIVE_UNCERTAINTY, SLIP_QUANTILE, compute_slip_angles
from .driving_fit import DELAY, MISALIGNMENT, QUANTITIES, RELAXATION, ROLL, DrivingFit, DrivingFitSettings, fit_driving
from .result import (
    Identification,
    IdentificationError,
    ParameterEstimate,
    Status,
    describe_contradiction,
    describe_correlations,
)
from .run_samples import measure_coverage, measure_driving_coverage, prepare_drives, require_coverage, sample_run

STIFFNESSES = ("cornering_stiffness_front", "cornering_stiffness_rear")
RATIO, OFFSET = "steering_ratio", "steering_wheel_offset"
NUISANCE_PARAMETERS = (OFFSET, MISALIGNMENT)
UNCERTAINTY_GRADES: tuple[tuple[float, str, Status], ...] = (
    (MAX_RELATIVE_UNCERTAINTY, "Determined", "identified"),
    (5.0 * MAX_RELATIVE_UNCERTAINTY, "Poorly determined", "doubtful"),
    (np.inf, "Not identifiable", "unidentifiable"))
"""(largest relative standard uncertainty of a stiffness, ratio or inertia; beginning of the verdict; status)."""
YAW_ACCELERATION_EDGES = np.array([-10.0, -0.3, -0.1, 0.1, 0.3, 10.0])  # rad/s^2, positive to the left
SYSTEMATIC_ERRORS = (np.deg2rad(0.05), 0.005, 0.03)
"""Standard uncertainty of steering offset [rad], steering ratio and common scale of the stiffnesses (both relative) due
to the single-track model: the largest errors on the simulated Leaf."""
INERTIA_ERROR = 0.05  # relative uncertainty of the yaw inertia, from 19 cars (docs/measurements/discovery_limits.md)
SINGLE_TRACK_ERROR = 0.64
"""Relative standard uncertainty of a stiffness due to the single-track assumption, divided by (L / R)^2. On the Leaf
simulated without noise, the rear stiffness is too small by 4.6 m^2 / R^2, 1.1 % at R = 20 m and 0.1 % at 60 m."""


def fit_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear", *,
                  additional: Sequence[str] = (), nuisance: Sequence[str] = NUISANCE_PARAMETERS) -> Identification:
    """Both stiffnesses, with their uncertainty from the variation between runs or, with few runs, between blocks.

    base: linear, nonlinear, or one of these with known effects (`augment`), such as the drive force on steered wheels.
    additional: further parameters to fit and report, from `driving_fit.QUANTITIES` (steering_ratio needs low and high
    speeds, cg_to_ins_x tight bends). nuisance: parameters that are fitted but not reported. Raises IdentificationError.
    """
    names = tuple(dict.fromkeys((*STIFFNESSES, *additional, *nuisance)))
    settings = DrivingFitSettings().for_car(vehicle)
    logs, notes = prepare_drives(logs, vehicle)
    coverage = measure_driving_coverage(logs, vehicle, settings.minimum_speed, speed=(5.0, 2 if RATIO in names else 1),
                                        lateral_acceleration=(2.0, 3))
    require_coverage(coverage, "Drive left and right turns at two or more speeds, with |a_y| of 1 to 4 m/s^2.")
    fit = fit_driving(logs, vehicle, names, base, settings)
    method = f"multi-step prediction, {describe_model(base)}"
    slip_range_uncertainty = estimate_slip_range_uncertainty(logs, vehicle, base, settings, fit)
    result = _make_identification("stiffness", vehicle, fit, method, (*STIFFNESSES, *additional),
                                  slip_range_uncertainty, {})
    definition = ("Secant" if describe_model(base).startswith("linear") else
                  "Slope at zero slip, with the tyre curve of the vehicle file,")
    estimates = []
    for estimate, slip in zip(result.estimates, find_largest_slip(logs, vehicle, settings), strict=False):
        relative_error = slip_range_uncertainty.get(estimate.parameter, 0.0) / max(abs(estimate.value), 1e-300)
        model_error = (f"a model error of {100.0 * relative_error:.2g} % from its change with the slip range is "
                       "included" if slip_range_uncertainty else
                       "its change with the slip range is unknown: drive at small and large lateral accelerations")
        verdict = f"{estimate.verdict} {definition} from slip angles up to {np.rad2deg(slip):.1f} deg; {model_error}."
        estimates.append(replace(estimate, verdict=verdict))
    return replace(result, estimates=(*estimates, *result.estimates[len(STIFFNESSES):]), coverage=coverage,
                   warnings=(*notes, *result.warnings))


def estimate_slip_range_uncertainty(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model,
                                    settings: DrivingFitSettings, fit: DrivingFit) -> dict[str, float]:
    """Standard uncertainty of each stiffness as the slope at zero slip [N/rad], from a second fit to the windows below
    the median peak acceleration (`regression.extrapolation_uncertainty`); empty if both fits have similar slip ranges,
    measured by |v_x r| weighted by its square: the secant of a brush tyre falls about linearly with this mean."""
    low_settings = replace(settings, maximum_acceleration=float(np.median(fit.peak_accelerations)),
                           min_windows=settings.min_windows // 2)
    try:
        low = fit_driving(logs, vehicle, fit.names, base, low_settings)
    except IdentificationError:
        return {}
    if low.mean_acceleration > MAX_RANGE_RATIO * fit.mean_acceleration:
        return {}
    indices = {name: fit.names.index(name) for name in STIFFNESSES}
    return {name: regression.extrapolation_uncertainty(*(
        (float(result.values[k]), float(result.spread.covariance[k, k]), result.mean_acceleration)
        for result in (fit, low)))
            for name, k in indices.items()}


def find_largest_slip(logs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DrivingFitSettings) -> np.ndarray:
    """Quantile SLIP_QUANTILE of |slip angle| (front, rear) [rad] in driving within the limits of the settings."""
    slips = []
    for run in (sample_run(log, vehicle) for log in logs):
        is_used = ((run.velocity_x >= settings.minimum_speed)
                   & (np.abs(run.velocity_x * run.yaw_rate) <= settings.maximum_acceleration))
        slips.append(np.abs(compute_slip_angles(run, vehicle))[:, is_used])
    return np.quantile(np.concatenate(slips, axis=1), SLIP_QUANTILE, axis=1)


def identify_steering(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                      base: str | Model = "nonlinear") -> Identification:
    """Steering ratio and offset, and the stiffnesses that are fitted together with them. Raises IdentificationError for
    unusable drives and too little excitation, such as a single speed."""
    result = fit_stiffness(logs, vehicle, base, additional=(RATIO, OFFSET),
                           nuisance=(*NUISANCE_PARAMETERS, DELAY, RELAXATION))
    assert result.correlation is not None
    order = [2, 3, 0, 1]  # ratio and offset first
    return replace(result, experiment="steering", estimates=tuple(result.estimates[i] for i in order),
                   correlation=result.correlation[np.ix_(order, order)])


def identify_yaw_inertia(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                         base: str | Model = "nonlinear") -> Identification:
    """Yaw inertia, and the stiffnesses and steering delay that are fitted together with it. Raises IdentificationError
    for unusable drives and too little excitation, such as steady-state cornering only."""
    settings = DrivingFitSettings(interval=0.3).for_car(vehicle)
    logs, notes = prepare_drives(logs, vehicle)
    runs = [sample_run(log, vehicle, cutoff=5.0) for log in logs]
    fast = [run.yaw_acceleration[run.velocity_x >= settings.minimum_speed] for run in runs]
    coverage = (*measure_driving_coverage(logs, vehicle, settings.minimum_speed, speed=(5.0, 1),
                                          lateral_acceleration=(1.0, 3)),
                measure_coverage("yaw acceleration", "rad/s^2", YAW_ACCELERATION_EDGES, fast,
                                 [run.time for run in runs], 0.5, 5))
    require_coverage(coverage, "Steady cornering is not enough: drive step steers, lane changes or a sine sweep.")
    roll = (ROLL,) if all(CHANNELS["velocity_y"].is_measured_in(log) for log in logs) else ()
    names = ("yaw_inertia", *STIFFNESSES, DELAY, RELAXATION, *roll, RATIO, *NUISANCE_PARAMETERS)
    fit = fit_driving(logs, vehicle, names, base, settings)
    # Uncertainty of the dead time, propagated to the inertia; see the module docstring.
    interval = float(np.median(np.concatenate([np.diff(log.steering_time_ns) for log in logs]))) * NANOSECOND
    delay_uncertainty = interval / np.sqrt(12.0 * sum(used > 0 for used, _ in fit.window_counts.values()))
    row, delay = (fit.names.index(name) for name in ("yaw_inertia", DELAY))
    # Change of the inertia per change of the dead time, with all other parameters refitted.
    inertia_per_delay = abs(float(fit.noise_covariance[row, delay] / fit.noise_covariance[delay, delay]))
    known_uncertainty = {DELAY: delay_uncertainty, "yaw_inertia": inertia_per_delay * delay_uncertainty}
    method = f"multi-step prediction of transients, {describe_model(base)}"
    slip_range_uncertainty = estimate_slip_range_uncertainty(logs, vehicle, base, settings, fit)
    result = _make_identification("yaw-inertia", vehicle, fit, method, ("yaw_inertia", *STIFFNESSES, DELAY),
                                  slip_range_uncertainty, known_uncertainty)
    estimate = result["yaw_inertia"]
    warnings = [*notes, *result.warnings]
    inertia = VEHICLE_QUANTITIES["yaw_inertia"].clip(estimate.value)
    implausible = [text for text in find_implausible_values(replace(vehicle, yaw_inertia=inertia))
                   if text.startswith("yaw_inertia")]
    length, limits = fit.values[fit.names.index(RELAXATION)], get_effect(RELAXATION).parameters[0].bounds
    if RELAXATION in fit.at_bound and length > 0.5 * sum(limits):
        implausible.append(f"{RELAXATION} {length:.2g} m is at its upper limit")
    if implausible:
        text = f"{implausible[0]}: the transients are too weak, or steering or tyre dynamics are mistaken for inertia."
        warnings.append(text)
        estimate = replace(estimate, status="unidentifiable", verdict=f"{text} {estimate.verdict}")
    conflict = describe_contradiction(estimate, vehicle.yaw_inertia, 0.1 * vehicle.yaw_inertia,
                                      "the vehicle file (standard uncertainty taken as 10 %)")
    return replace(result, estimates=(estimate, *result.estimates[1:]), coverage=coverage,
                   warnings=(*warnings, conflict) if conflict else tuple(warnings))


def _make_identification(experiment: str, vehicle: VehicleParameters, fit: DrivingFit, method: str,
                         reported: Sequence[str], systematic_uncertainty: Mapping[str, float],
                         known_uncertainty: Mapping[str, float]) -> Identification:
    """Result of an experiment from a fit.

    reported: parameters that become estimates. systematic_uncertainty, known_uncertainty: further standard
    uncertainties by parameter, estimated from the same drives or known otherwise; added in quadrature.
    """
    spread = fit.spread
    relative_error = SINGLE_TRACK_ERROR * vehicle.wheelbase**2 * fit.mean_squared_curvature
    offset_error, ratio_error, _ = SYSTEMATIC_ERRORS
    relative_errors = dict.fromkeys(STIFFNESSES, relative_error) | {RATIO: ratio_error, "yaw_inertia": INERTIA_ERROR}
    added_uncertainty = [math.hypot(systematic_uncertainty.get(n, 0.0), known_uncertainty.get(n, 0.0),
                                    offset_error if n == OFFSET else relative_errors.get(n, 0.0) * v)
                         for n, v in zip(fit.names, fit.values, strict=True)]
    # Systematic errors are assumed to be uncorrelated: only the variances increase.
    covariance = spread.covariance + np.diag(np.square(added_uncertainty))
    indices = [fit.names.index(name) for name in reported]
    values, uncertainty = fit.values.tolist(), np.sqrt(np.diag(covariance)).tolist()
    # Student's t applies to variances estimated from these few drives, not to known ones, such as that of the model.
    estimated_variance = np.diag(spread.covariance) + np.square([systematic_uncertainty.get(n, 0.0) for n in fit.names])
    degrees_of_freedom = list(map(regression.effective_degrees_of_freedom, estimated_variance.tolist(),
                                  np.diag(covariance).tolist(), spread.degrees_of_freedom.tolist()))
    runs = tuple(name for name, (used, _) in fit.window_counts.items() if used)
    estimates = tuple(
        ParameterEstimate(fit.names[i], values[i], QUANTITIES[fit.names[i]].unit, uncertainty[i],
                          regression.symmetric_interval(values[i], uncertainty[i], degrees_of_freedom[i]),
                          method, runs, *_grade_estimate(fit, i, uncertainty[i]))
        for i in indices)
    rejected = [(name, f"{total - used} of {total} predictions (speed below the minimum, lateral acceleration above "
                 "the limit, or gaps)") for name, (used, total) in fit.window_counts.items() if used < total]
    others = [f"Also fitted: {n} {fit.values[i]:.4g}{f' {QUANTITIES[n].unit}'.removesuffix(' 1')}, standard "
              f"uncertainty {uncertainty[i]:.2g}." for i, n in enumerate(fit.names) if n not in reported]
    others.append(f"mass {vehicle.mass:.5g} kg and cg_to_front_axle {vehicle.cg_to_front_axle:.4g} m of the vehicle "
                  "file are assumed exact: drives determine only stiffness over axle load, and yaw inertia over mass.")
    if RATIO not in fit.names:
        others.append(f"{RATIO} {vehicle.steering_ratio:.4g} of the vehicle file is assumed exact: an error would "
                      "change the front stiffness; st identify steering estimates it from drives at several speeds.")
    warnings = (*describe_correlations(fit.names, regression.correlation_matrix(covariance)), *others)
    figure = {"residuals": fit.residuals, "residual_run": fit.run_index, "residual_time": fit.time, "names": fit.names,
              "covariance": covariance}
    return Identification(experiment, estimates, runs, tuple(rejected),
                          regression.correlation_matrix(covariance[np.ix_(indices, indices)]), (), warnings, figure)


def _grade_estimate(fit: DrivingFit, index: int, uncertainty: float) -> tuple[str, Status]:
    name, value = fit.names[index], fit.values[index]
    basis = f"{fit.prediction_count} predictions in {fit.spread.basis[index]}"
    if name in fit.at_bound:
        return (f"The fit reached the limit {value:.6g}: the drives do not determine the value, or contradict other "
                "values of the vehicle file."), "unidentifiable"
    if not QUANTITIES[name].relative:
        return (f"{value:.4g} {QUANTITIES[name].unit}, standard uncertainty {uncertainty:.2g}, from {basis}.",
                "identified" if uncertainty < QUANTITIES[name].max_uncertainty else "doubtful")
    relative, causes = uncertainty / abs(value), get_effect(QUANTITIES[name].effect).imitated_by
    grade, status = next((grade, status) for limit, grade, status in UNCERTAINTY_GRADES if not relative > limit)
    return (f"{grade}: standard uncertainty {100.0 * relative:.1f} %, from {basis}."
            + f" Other possible causes: {causes}." * bool(causes), status)


def describe_model(base: str | Model) -> str:
    if isinstance(base, AugmentedModel):
        return f"{base.base.name} tyres with {', '.join(effect.name for effect in base.effects)}"
    return f"{get_model(base).name} tyres"
