"""Trial of corrections: they are applied to the run, and proposed unless its predictions become worse.

The prediction error is the distance between measured position and prediction by the linear single-track model, both
from the corrected drive, HORIZON after each start; the starts are HORIZON apart or more. A wrong steering ratio or
offset in the vehicle file would favour corrections that compensate for it, so both errors are fitted, as gain g [1] and
offset o [rad]:

    e = e_0 + (de/dg) g + (de/do) o,    least squares within |g| <= MAX_GAIN, |o| <= MAX_OFFSET

Without bounds, huge values of both would explain any error on a circle, where gain and offset are confounded.
Checked by: test_checks_trial.py, test_checks_step.py.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from ..augmented import AugmentedModel
from ..corrections import Correction, apply_corrections
from ..errors import StCoreError
from ..integrate import MAX_SUBSTEPS, are_stable, growth_factor, required_slip_speed, required_substeps
from ..log import DriveLog
from ..log_evaluation import EvaluationSettings, evaluate_log, regular_starts
from ..models import Model, get_model
from ..prediction import PredictionSettings
from ..sideslip import with_course, with_steady_sideslip
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .finding import HORIZON, LIMITS, Advice, Finding, Severity
from .motion import find_time_intervals

# A correction is rejected if the error exceeds 1.1 e_before + 0.02 m; valid ones raised it by up to 7 % on real drives.
MAX_ERROR_RATIO, ERROR_NOISE = 1.1, 0.02
GAIN_STEP, OFFSET_STEP = 0.03, 0.003  # 1, rad; steps of the difference quotients
MAX_GAIN, MAX_OFFSET = LIMITS.steering_unit_ratio - 1.0, 0.1  # 1, rad at the road wheels; larger than plausible errors
MIN_STARTS = 4
MIN_REDUCED_STARTS = 100  # many starts are reduced to 100 to 199; more would change the error by less than 1 %
TIME_UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}
MAX_TRIAL_SUBSTEPS = 50  # steps of 1 ms
SPEED_COUNT = 40  # number of speeds, from the lowest to the highest of the run, at which the stability is computed
STEP_DIVISORS = (1, 2, 4, 5, 8, 10, 16, 20, 25, 32, 40, 50, MAX_SUBSTEPS)  # most resulting steps have few digits
MERGE_GAP = 1.0  # s; intervals with a smaller gap are merged
RunAndVehicle = tuple[DriveLog, VehicleParameters]


def try_corrections(findings: list[Finding], log: DriveLog, vehicle: VehicleParameters) -> list[Finding]:
    """The findings with the prediction error [m] before and after their correction; harmful corrections are removed.

    The corrections of all errors are applied together, since one wrong unit may mask another. If none is missing or
    fails, and they are not harmful, the correction of each warning is then tried separately. A warning with a harmful
    correction becomes a note. Corrections of errors that affect no prediction, and `leave_out`, are applied untested.
    """
    tried_findings = [finding for finding in findings if _is_tried(finding)]
    if not tried_findings:
        return findings
    errors = [finding for finding in findings if finding.severity is Severity.ERROR]
    corrected: RunAndVehicle | None = (log, vehicle)
    before = _compute_prediction_error(corrected)
    for finding in errors:
        corrected = _apply_advice(corrected, finding.advice)
    after = _compute_prediction_error(corrected) if errors else before
    outcomes = {id(finding): _add_outcome(finding, before, after) for finding in errors if _is_tried(finding)}
    harmful = errors and (after is None or (before is not None and _is_worse(before, after)))
    for finding in tried_findings if not harmful else ():
        if finding.severity is Severity.WARNING:
            corrected_error = _compute_prediction_error(_apply_advice(corrected, finding.advice))
            outcomes[id(finding)] = _add_outcome(finding, after, corrected_error)
    return [outcomes.get(id(finding), finding) for finding in findings]


def _is_tried(finding: Finding) -> bool:
    return (finding.severity is not Severity.NOTE and finding.advice is not None and bool(finding.advice.entry)
            and not finding.concerns_only_acceleration and "leave_out" not in finding.advice.entry)


def _add_outcome(finding: Finding, before: float | None, after: float | None) -> Finding:
    if before is None or after is None:
        return finding
    if not _is_worse(before, after):
        return replace(finding, tried=(before, after))
    correction = "the corrections of all errors" if finding.severity is Severity.ERROR else "it"
    advice = (f"its correction is not proposed, as {correction} would raise the prediction error of this run from "
              f"{before:.2f} to {after:.2f} m: look for a different cause")
    severity = Severity.NOTE if finding.severity is Severity.WARNING else finding.severity
    return replace(finding, severity=severity, advice=Advice("text", advice), tried=(before, after))


def _is_worse(before: float, after: float) -> bool:
    return after > MAX_ERROR_RATIO * before + ERROR_NOISE


def _compute_prediction_error(run: RunAndVehicle | None) -> float | None:
    """RMS prediction error [m], defined in the module docstring; None with fewer than MIN_STARTS predictions."""
    if run is None:
        return None
    log, vehicle = run
    starts = regular_starts(log, HORIZON)
    starts = starts[::max(len(starts) // MIN_REDUCED_STARTS, 1)]
    angle = log.road_wheel_angle
    default = PredictionSettings()
    speeds = (float(log.velocity_x.min()), float(log.velocity_x.max()))
    step = default.step / min(required_substeps("linear", vehicle, speeds, default.step), MAX_TRIAL_SUBSTEPS)
    settings = EvaluationSettings(prediction=replace(default, step=step))
    try:
        nominal, with_gain, with_offset = (
            evaluate_log(("linear",), vehicle, replace(log, road_wheel_angle=changed), settings, starts)
            .errors["linear", "hindsight"].at_seconds[:, -1, :2]
            for changed in (angle, (1.0 + GAIN_STEP) * angle, angle + OFFSET_STEP))
    except StCoreError:
        return None
    known = np.isfinite(nominal + with_gain + with_offset).all(axis=1)
    if known.sum() < MIN_STARTS:
        return None
    error = nominal[known].ravel()
    slopes = np.stack([(with_gain[known].ravel() - error) / GAIN_STEP,
                       (with_offset[known].ravel() - error) / OFFSET_STEP], axis=1)
    bounds = np.array([MAX_GAIN, MAX_OFFSET])
    residual = lsq_linear(slopes, error, (-bounds, bounds)).fun
    return float(np.sqrt(2.0 * np.mean(residual**2)))


def _apply_advice(run: RunAndVehicle | None, advice: Advice | None) -> RunAndVehicle | None:
    """The run with the correction applied; None without a run or a correction, or if it fails."""
    if run is None or advice is None or not advice.entry:
        return None
    log, vehicle = run
    try:
        if advice.kind == "vehicle":
            values: dict[str, Any] = {name: float(value) for name, value in advice.entry.items()}
            vehicle = replace(vehicle, **values)
            return (log.with_steering(vehicle) if log.steering_wheel_angle is not None else log), vehicle
        if unit := advice.entry.get("units", {}).get("t"):
            start = log.start_ns
            log = replace(log, **{
                name: start + np.round((getattr(log, name) - start) / TIME_UNITS[unit]).astype(np.int64)
                for name in ("ins_time_ns", "steering_time_ns")})
        log = replace(log, **{name: getattr(log, source) for name, source in advice.entry.get("columns", {}).items()})
        changes = {name: Correction(**values) for name, values in advice.entry.get("correct", {}).items()}
        log = log if log.sideslip_measured else with_course(log)
        log = apply_corrections(log, changes, vehicle, advice.entry.get("leave_out", ()))
        return with_steady_sideslip(log, vehicle), vehicle  # as the reader does after the corrections
    except StCoreError:
        return None


def check_step_length(models: Sequence[str | Model], vehicle: VehicleParameters, log: DriveLog,
                      step: float) -> Finding | None:
    """Finding `step_too_long`: a step [s] too long for at least one model; None if the step is short enough. The value
    of the finding is the minimum_slip_speed [m/s] at which the step is stable; if there is none, the longest stable
    step [s]; without either, None. For a scale-model car, a minimum_slip_speed above the median speed is not proposed,
    because it would lower most tyre forces."""
    resolved = [get_model(model) for model in models]
    speed = np.abs(log.velocity_x)
    if not len(speed):
        return None
    speeds = np.linspace(speed.min(), speed.max(), SPEED_COUNT)
    factors = {model.name: np.array([growth_factor(model, vehicle, v, step) for v in speeds]) for model in resolved}
    unstable_models = [name for name, factor in factors.items() if factor.max() > 1.0]
    if not unstable_models:
        return None
    unstable = np.interp(speed, speeds, np.max(list(factors.values()), axis=0)) > 1.0
    affected = speed[unstable] if unstable.any() else speed[:1]
    value, unit = required_slip_speed(resolved, vehicle, speeds.tolist(), step), "m/s"
    if value is not None and (value <= np.median(speed) or vehicle.speed_scale == 1.0):
        line = f'minimum_slip_speed: {{value: {value:g}, unit: m/s, source: "stable with steps of {1e3 * step:g} ms"}}'
        if any(isinstance(model, AugmentedModel) for model in resolved):
            line += "  # then rerun st discover: a model file is valid for its own vehicle file only"
        advice = Advice("vehicle", line, {"minimum_slip_speed": value})
    else:
        shorter_steps = (step / divisor for divisor in STEP_DIVISORS)
        value, unit = next((t for t in shorter_steps if are_stable(resolved, vehicle, speeds.tolist(), t)), None), "s"
        advice = Advice("option", f"--step {value:.9g}", {"step": value}) if value is not None else Advice(
            "text", f"no step down to {1e3 * step / MAX_SUBSTEPS:.2g} ms is short enough: check the vehicle's "
            "yaw_inertia, mass and stiffnesses, and the effects of the model")
    text = (f"integration steps of {1e3 * step:g} ms are too long for the {' and '.join(unstable_models)} "
            f"{'model' if len(unstable_models) == 1 else 'models'} of {vehicle.name} at {affected.min():.1f} to "
            f"{affected.max():.1f} m/s: the lateral motion is numerically unstable")
    seconds = (log.ins_time_ns - log.ins_time_ns[0]) * NANOSECOND
    times = () if unstable.all() else find_time_intervals(seconds[unstable], MERGE_GAP)
    return Finding("step_too_long", Severity.WARNING, ("velocity_x",), text, value, unit, times=times, advice=advice)
