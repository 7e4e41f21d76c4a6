"""Stiffnesses, steering and yaw inertia from multi-step predictions of several drives at once.

The offset of the steering and the misalignment of the INS are always fitted in addition, since their errors resemble
those of tyres. Stiffness: with the nonlinear model it is the slope at small slip at the static load, with the tyre
curve of the vehicle file; with the linear one it is the secant that predicts best in the driven slip range. For a tyre
with another curve the value depends on the range of slip. The interval includes that: the fit is repeated with the
windows of low lateral acceleration, and the difference extrapolated to zero slip (`slip_range_uncertainty`).

Steering ratio, if no turntables are available:

    delta = (delta_h - o) / i:    L kappa + K v^2 kappa = delta

Slow bends determine the ratio, fast ones the understeer, straights the offset. The stiffnesses are therefore fitted
too, and dead time and relaxation, since a lag would be mistaken for another ratio. An error of 1 % of the wheelbase is
an error of 1 % of the ratio.

Yaw inertia, from transients: I_z r_dot = l_f F_f cos(delta) - l_r F_r. In steady bends r_dot is zero and any inertia
fits. Steering dynamics, wrong time stamps and the relaxation of the tyres delay the response as inertia does; dead time
of the steering and relaxation length are therefore fitted too. Without relaxation in the fit, the inertia of a car with
a relaxation length of 0.4 m is estimated 17 % too small. The delay between an angle and its stamp, up to a sampling
interval T, differs between drives, which one dead time for N drives cannot represent: its uncertainty has a part
T / sqrt(12 N), which is propagated to the inertia. Checked by: test_identification_driving.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..augmented import AugmentedModel
from ..handling import objections
from ..log import DriveLog
from ..models import Model, get_model
from ..regression import correlation_of, extrapolation_uncertainty
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .cornering_stiffness import DRIVEN_QUANTILE, MAX_RANGE_RATIO, MAX_RELATIVE_UNCERTAINTY, slip_angles
from .driving_fit import (
    DELAY,
    FREE_PARAMETERS,
    MISALIGNMENT,
    RELAXATION,
    SETTINGS,
    DrivingFit,
    DrivingFitSettings,
    fit_driving,
)
from .result import (
    Coverage,
    Estimate,
    Identification,
    IdentificationError,
    Status,
    describe_contradiction,
    describe_correlations,
)
from .run_samples import ACCELERATION_EDGES, SPEED_EDGES, prepare_drives, require_coverage, run_samples, signal_coverage

STIFFNESSES = ("cornering_stiffness_front", "cornering_stiffness_rear")
RATIO, OFFSET = "steering_ratio", "steering_wheel_offset"
NUISANCE = (OFFSET, MISALIGNMENT)
REQUIRED_COVERAGE = {"speed": (5.0, 1), "lateral acceleration": (2.0, 3)}
UNCERTAINTY_GRADES: tuple[tuple[float, str, Status], ...] = (
    (MAX_RELATIVE_UNCERTAINTY, "Determined", "identified"),
    (5.0 * MAX_RELATIVE_UNCERTAINTY, "Poorly determined", "doubtful"),
    (np.inf, "Not identifiable: determined only", "unidentifiable"))
"""(largest relative standard uncertainty of a stiffness, ratio or inertia; text of the verdict; status)."""
INERTIA_NAMES = ("yaw_inertia", *STIFFNESSES, DELAY, RELAXATION, *NUISANCE)
YAW_ACCELERATION_EDGES = np.array([-10.0, -0.3, -0.1, 0.1, 0.3, 10.0])  # rad/s^2, left +
TRANSIENT_SETTINGS = DrivingFitSettings(interval=0.3)
SINGLE_TRACK_ERROR = 0.8**2
"""Relative standard uncertainty of a stiffness due to the single-track assumption, divided by (L / R)^2. With Ackermann
angles, the forces of two wheels cause a yaw moment that a single wheel does not have. On the virtual Leaf without
noise, the rear stiffness is too small by 4.6 m^2 / R^2: 1.1 % at 20 m, 0.1 % at 60 m. The full error is taken, as for
full Ackermann angles."""


def fit_stiffness(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
                      settings: DrivingFitSettings = SETTINGS, *, also: Sequence[str] = (),
                      nuisance: Sequence[str] = NUISANCE) -> Identification:
    """Both stiffnesses with their uncertainty from the scatter between runs.

    vehicle: all other values, and the start values of the fit. base: linear, nonlinear, or one of these with known
    effects (`augment`: for example drive force on steered wheels). also: further parameters to fit and report, of
    `driving_fit.FREE_PARAMETERS` (steering_ratio needs low and high speeds, cg_to_ins_x tight bends). nuisance:
    fitted too, not reported. Raises IdentificationError for too little excitation.
    """
    names = tuple(dict.fromkeys((*STIFFNESSES, *also, *nuisance)))
    logs, notices = prepare_drives(logs, vehicle)
    needs = REQUIRED_COVERAGE | ({"speed": (5.0, 2)} if RATIO in names else {})
    covered = driving_coverage(logs, needs, settings.minimum_speed)
    require_coverage(covered, "Drive bends to both sides, at two speeds or more, with a lateral acceleration of 1 to 4 "
                              "m/s^2.")
    fit = fit_driving(logs, vehicle, names, base, settings)
    method = f"multi-step prediction, {describe_model(base)}"
    systematic = slip_range_uncertainty(logs, vehicle, base, settings, fit)
    result = make_identification("stiffness", vehicle, fit, method, (*STIFFNESSES, *also), covered, systematic)
    kind = "Secant" if get_model(base).name.startswith("linear") else "Slope at zero slip of the file's tyre curve"
    estimates = []
    for estimate, slip in zip(result.estimates, driven_slip(logs, vehicle, settings), strict=False):
        share = 100.0 * systematic.get(estimate.parameter, 0.0) / max(abs(estimate.value), 1e-300)
        model_error = (f"the value changes with the slip range, model error +/- {share:.1f} % included" if systematic
                       else "its change with the slip range is unknown: drive small and large lateral accelerations")
        verdict = f"{estimate.verdict} {kind} over slip angles up to {np.rad2deg(slip):.1f} deg; {model_error}."
        estimates.append(replace(estimate, verdict=verdict))
    return replace(result, estimates=(*estimates, *result.estimates[len(STIFFNESSES):]),
                   warnings=(*notices, *result.warnings))


def slip_range_uncertainty(logs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model,
                           settings: DrivingFitSettings, fit: DrivingFit) -> dict[str, float]:
    """Standard uncertainty of the stiffnesses [N/rad] as slopes at zero slip, when the tyre's curve is not the model's:
    `regression.extrapolation_uncertainty` with a, the mean |v_x r| weighted by its square; lower range: the windows up
    to the median of the peaks. To first order, the secant of a brush tyre decreases linearly with slip. Empty if the
    drives do not separate the two ranges.
    """
    try:
        low = fit_driving(logs, vehicle, fit.names, base, replace(
            settings, maximum_acceleration=float(np.median(fit.peaks)), min_windows=settings.min_windows // 2))
    except IdentificationError:
        return {}
    if low.acceleration > MAX_RANGE_RATIO * fit.acceleration:
        return {}
    indices = {name: fit.names.index(name) for name in STIFFNESSES}
    return {name: extrapolation_uncertainty(*(
        (float(result.values[k]), float(result.spread.covariance[k, k]), result.acceleration) for result in (fit, low)))
        for name, k in indices.items()}


def driven_slip(logs: Sequence[DriveLog], vehicle: VehicleParameters, settings: DrivingFitSettings) -> np.ndarray:
    """DRIVEN_QUANTILE of the slip angle of (front, rear) axle [rad] at the settings' speeds and accelerations."""
    driven = []
    for run in (run_samples(log, vehicle) for log in logs):
        used = ((run.velocity_x >= settings.minimum_speed)
                & (np.abs(run.velocity_x * run.yaw_rate) <= settings.maximum_acceleration))
        driven.append(np.abs(slip_angles(run, vehicle))[:, used])
    return np.quantile(np.concatenate(driven, axis=1), DRIVEN_QUANTILE, axis=1)


def identify_steering(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                      base: str | Model = "nonlinear") -> Identification:
    """Ratio and offset with their uncertainty, and the stiffnesses fitted with them.

    Raises IdentificationError for too little excitation: at least two speed bins are needed.
    """
    result = fit_stiffness(logs, vehicle, base, also=(RATIO, OFFSET), nuisance=(*NUISANCE, DELAY, RELAXATION))
    order = [e.parameter for e in result.estimates]
    chosen = [order.index(name) for name in (RATIO, OFFSET, *(n for n in order if n not in (RATIO, OFFSET)))]
    correlation = result.correlation[chosen][:, chosen] if result.correlation is not None else None
    return replace(result, experiment="steering", estimates=tuple(result.estimates[i] for i in chosen),
                   correlation=correlation)


def identify_yaw_inertia(logs: Sequence[DriveLog], vehicle: VehicleParameters,
                         base: str | Model = "nonlinear") -> Identification:
    """Yaw inertia with its uncertainty; stiffnesses and steering delay are reported too.

    Raises IdentificationError without transients: |r_dot| above 0.3 rad/s^2 is needed for 0.5 s in each direction.
    """
    settings = TRANSIENT_SETTINGS
    logs, notices = prepare_drives(logs, vehicle)
    runs = [run_samples(log, vehicle, cutoff=5.0) for log in logs]
    fast = [run.yaw_acceleration[run.velocity_x >= settings.minimum_speed] for run in runs]
    covered = (*driving_coverage(logs, {"speed": (5.0, 1), "lateral acceleration": (1.0, 3)}, settings.minimum_speed),
               signal_coverage("yaw acceleration", "rad/s^2", YAW_ACCELERATION_EDGES, fast,
                               [run.time for run in runs], 0.5, 5))
    require_coverage(covered, "Steady bends do not excite the yaw inertia: drive steps, lane changes or a sine sweep.")
    fit = fit_driving(logs, vehicle, INERTIA_NAMES, base, settings)
    # Uncertainty of the dead time [s], and its contribution to that of the inertia; see the module.
    sampling = float(np.median(np.concatenate([np.diff(log.steering_time_ns) for log in logs]))) * NANOSECOND
    dead_time = sampling / np.sqrt(12.0 * sum(used > 0 for used, _ in fit.windows.values()))
    timing = {DELAY: dead_time, "yaw_inertia": abs(fit.change_with(DELAY)["yaw_inertia"]) * dead_time}
    method = f"multi-step prediction of transients, {describe_model(base)}"
    result = make_identification("yaw-inertia", vehicle, fit, method, INERTIA_NAMES[:4], covered, timing)
    inertia = result["yaw_inertia"]
    warnings = [*notices, *result.warnings]
    implausible = [text for text in objections(replace(vehicle, yaw_inertia=max(inertia.value, 10.0)))
                   if text.startswith("yaw_inertia")]
    if implausible:
        text = f"{implausible[0]}: the transients are too weak, or steering or tyre dynamics are mistaken for inertia."
        warnings.append(text)
        inertia = replace(inertia, status="unidentifiable", verdict=f"{text} {inertia.verdict}")
    conflict = describe_contradiction(inertia, vehicle.yaw_inertia, 0.1 * vehicle.yaw_inertia,
                                      "the vehicle file (as +/- 10 %)")
    return replace(result, estimates=(inertia, *result.estimates[1:]),
                   warnings=(*warnings, conflict) if conflict else tuple(warnings))


def make_identification(experiment: str, vehicle: VehicleParameters, fit: DrivingFit, method: str,
                        reported: Sequence[str], covered: Sequence[Coverage],
                        systematic: Mapping[str, float] | None = None) -> Identification:
    """Result of a fit. reported: parameters that become estimates, with their correlation. systematic: standard
    uncertainties in addition to the scatter between drives, added in quadrature."""
    spread = fit.spread
    share = SINGLE_TRACK_ERROR * vehicle.wheelbase**2 * fit.curvature_square
    extra = [np.hypot((systematic or {}).get(n, 0.0), share * v if n in STIFFNESSES else 0.0)
             for n, v in zip(fit.names, fit.values, strict=True)]
    # Systematic errors are taken as uncorrelated between parameters: only the variances increase.
    covariance = spread.covariance + np.diag(np.square(extra))
    chosen = [fit.names.index(name) for name in reported]
    uncertainty = np.sqrt(np.diag(covariance))
    runs = tuple(name for name, (used, _) in fit.windows.items() if used)
    estimates = tuple(
        Estimate(fit.names[i], float(fit.values[i]), FREE_PARAMETERS[fit.names[i]].unit, float(uncertainty[i]),
                 spread.interval(i, fit.values[i], uncertainty[i]), method, runs,
                 *_judge_estimate(fit, i, uncertainty[i]))
        for i in chosen)
    rejected = [(name, f"{total - used} of {total} predictions are too slow, beyond the limit of lateral acceleration "
                 "or with gaps") for name, (used, total) in fit.windows.items() if used < total]
    others = [f"{n} = {fit.values[i]:.4g} +/- {uncertainty[i]:.2g} {FREE_PARAMETERS[n].unit} was fitted too."
              for i, n in enumerate(fit.names) if n not in reported]
    if RATIO not in fit.names:
        others.append(f"{RATIO} {vehicle.steering_ratio:.4g} of the vehicle file is taken as exact: its error changes "
                      "the front stiffness; st identify steering estimates it from drives at two speeds or more.")
    warnings = (*describe_correlations(fit.names, correlation_of(covariance)), *others)
    figure = {"residuals": fit.residuals, "residual_run": fit.run_of, "residual_time": fit.time, "names": fit.names,
              "covariance": covariance}
    return Identification(experiment, estimates, runs, tuple(rejected),
                          correlation_of(covariance[np.ix_(chosen, chosen)]), tuple(covered), warnings, figure)


def _judge_estimate(fit: DrivingFit, index: int, uncertainty: float) -> tuple[str, Status]:
    """(verdict: uncertainty and number of predictions; status)."""
    name, value = fit.names[index], fit.values[index]
    basis = f"{fit.n_predictions} predictions in {fit.spread.basis[index]}"
    if name in fit.at_bound:
        return (f"Stopped at its bound {value:.4g}: the data do not determine it, or contradict other values of the "
                "vehicle file."), "unidentifiable"
    if not FREE_PARAMETERS[name].relative:
        return (f"{value:.4g} +/- {uncertainty:.2g} {FREE_PARAMETERS[name].unit}, from {basis}.",
                "identified" if uncertainty < FREE_PARAMETERS[name].max_uncertainty else "doubtful")
    share = uncertainty / abs(value)
    head, status = next((head, status) for limit, head, status in UNCERTAINTY_GRADES if not share > limit)
    return f"{head} to +/- {100.0 * share:.1f} %, from {basis}.", status


def describe_model(base: str | Model) -> str:
    """Name of the model of a fit, for texts."""
    if isinstance(base, AugmentedModel):
        return f"{base.base.name} tyres with {', '.join(effect.name for effect in base.effects)}"
    return f"{get_model(base).name} tyres"


def driving_coverage(logs: Sequence[DriveLog], needs: Mapping[str, tuple[float, int]],
                     minimum_speed: float) -> tuple[Coverage, ...]:
    """Coverage of speed and lateral acceleration v_x r of all driving above a minimum speed [m/s].

    needs: {"speed" | "lateral acceleration": (seconds in a filled bin, filled bins needed)}.
    """
    times = [(log.ins_time_ns - log.ins_time_ns[:1]) * NANOSECOND for log in logs]
    fast = [log.velocity_x >= minimum_speed for log in logs]
    return tuple(signal_coverage(name, unit, edges, [signal(log)[m] for log, m in zip(logs, fast, strict=True)], times,
                          *needs[name])
                 for name, unit, edges, signal in (
                     ("speed", "m/s", SPEED_EDGES, lambda log: log.velocity_x),
                     ("lateral acceleration", "m/s^2", ACCELERATION_EDGES, lambda log: log.velocity_x * log.yaw_rate)))
