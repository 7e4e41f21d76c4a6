"""Runs all checks of a recording, in an order in which each fault yields only one finding."""

from dataclasses import replace

import numpy as np

from ..channels import CHANNELS
from ..log import INS_SIGNALS, STEERING, DriveLog
from ..sideslip import has_derived_yaw_rate
from ..vehicle import VehicleParameters
from . import inertial, position, sampling, vehicle_relations
from .agreement import Agreement
from .finding import HORIZON, LIMITS, Advice, AuxiliaryData, Comparison, DriveCheck, Finding, Severity
from .motion import MOVING, Motion, is_driven
from .plausibility import drop_implausible, find_broken_channels
from .regression import Estimate, with_systematic
from .steps import check_position_steps
from .trial import try_corrections
from .units_and_axes import check_nominal_rate, check_time_unit, correct_units, is_yaw_late

CHANGED_BY_SIDESLIP = ("steering_lag", "yaw_rate_lag", "yaw_lag")
MAX_INS_DISTANCE = 3.0  # m; largest distance of the INS ahead of the rear axle
MAX_REAR_COMPLIANCE = 0.01  # rad s^2/m; sideslip of the rear axle per lateral acceleration: road cars 0.003 to 0.008
MIN_INS_SAMPLES = 50  # with fewer samples, only the time stamps are checked
SensorResult = tuple[Motion, list[Finding], dict[str, Estimate], list[Comparison]]
"""(corrected motion, findings, estimates by name of the finding, panels of the figure)."""


# long: one sequence, in which each check works on the result of the previous corrections
def check(log: DriveLog, vehicle: VehicleParameters | None = None,
          auxiliary: AuxiliaryData | None = None) -> DriveCheck:
    """Findings of one recording.

    The order is: sampling; units, signs and axes; relations valid for any vehicle (position, yaw, velocity,
    accelerations, other speeds); comparison with the vehicle. Each check works on a copy without the known faults.

    vehicle: None skips the comparison with the vehicle. auxiliary: data recorded in addition to the drive. Never raises
    for the content of a recording: a channel that is too short or too inaccurate gives no finding.
    """
    auxiliary = auxiliary or AuxiliaryData()
    start_ns = auxiliary.start_ns
    if start_ns is None:
        start_ns = int(log.ins_time_ns[0]) if len(log.ins_time_ns) else 0
    log, implausible = drop_implausible(log, start_ns)
    known = {(finding.name, finding.channels) for finding in auxiliary.implausible}
    # The reader has already reported the samples that it left out or kept.
    implausible = [*auxiliary.implausible,
                   *(finding for finding in implausible if (finding.name, finding.channels) not in known)]
    motion = Motion.of(log, start_ns, auxiliary)
    channels = sampling.describe_channels(motion, auxiliary)
    long_enough = len(log.ins_time_ns) >= MIN_INS_SAMPLES
    driven = long_enough and is_driven(motion)
    motion, time_unit = check_time_unit(motion) if driven else (motion, None)
    findings = [*implausible, *sampling.check_timing(motion, auxiliary, implausible)]
    if long_enough:
        findings += sampling.check_quality(auxiliary.quality, start_ns)
    if not driven:
        findings += vehicle_relations.check_standstill(motion) if long_enough else []
        return DriveCheck(_sort(findings), channels, ())
    broken = find_broken_channels(implausible)
    if broken & {*INS_SIGNALS}:  # every further check needs all of these channels
        return DriveCheck(_sort([*findings, *sampling.find_stuck_channels(motion, channels)]), channels, ())
    motion = replace(motion, acceleration_x=None if "acceleration_x" in broken else motion.acceleration_x,
                     acceleration_y=None if "acceleration_y" in broken else motion.acceleration_y)
    stuck = sampling.find_stuck_channels(motion, channels)
    recorded = motion
    motion, gross = _correct_units_without_lag(sampling.without_frozen_samples(motion, stuck))
    gross = [time_unit, *gross] if time_unit else gross
    rounded = sampling.find_coarse_channels(motion, stuck)
    findings += stuck + rounded
    coarse = {channel for finding in rounded for channel in finding.channels}
    # The derivative of a coarse channel is dominated by rounding.
    motion = replace(motion, acceleration_x=None if "velocity_x" in coarse else motion.acceleration_x,
                     acceleration_y=None if coarse & {"velocity_y", "yaw_rate"} else motion.acceleration_y)
    if not any(finding.name == "samples_repeated" and {"x", "y"} & {*finding.channels} for finding in stuck):
        motion, steps = check_position_steps(motion)  # held positions always step
        findings += steps
    speed, wheel_measured, sideslip_measured = (
        motion.velocity_x, log.steering_wheel_angle is not None, CHANNELS["velocity_y"].is_measured_in(log))
    rate, (motion, fine, estimates, panels) = _check_sensors_at_true_rate(motion, time_unit, _removed_factors(gross))
    findings += rate + position.with_sign_alternative(_merge_gross_and_fine(gross, fine, estimates), recorded, motion)
    if vehicle is not None:
        frozen = {channel for finding in stuck if finding.name == "channel_frozen" for channel in finding.channels}
        unusable = coarse | frozen if sideslip_measured else {*coarse, *frozen, "velocity_y"}
        for more, values, panel in _compare_with_vehicle(
                motion, vehicle, wheel_measured, broken | find_broken_channels(stuck), unusable):
            findings += more
            estimates |= values
            panels += [panel] if panel else []
    findings += vehicle_relations.check_standstill(replace(motion, velocity_x=speed))
    findings = _limit_to_measured_channels(findings, log, motion)
    if not sideslip_measured:
        estimates = {name: value for name, value in estimates.items() if name not in CHANGED_BY_SIDESLIP}
    if vehicle is not None:
        findings = try_corrections(findings, log, vehicle)
    return DriveCheck(_sort(findings), channels, tuple(panels),
                      {name: (estimate.value, *estimate.interval) for name, estimate in estimates.items()})


def _limit_to_measured_channels(findings: list[Finding], log: DriveLog, motion: Motion) -> list[Finding]:
    """The findings without those that are due to a wrong yaw rate, or to channels that were derived, not measured.

    The noise of yaw changes the scale of a yaw rate derived from it. Without velocity_y, yaw may be the course. The
    sideslip at a point l ahead of the rear axle, which slips by K per lateral acceleration, is tau r with tau =
    l/v - K v: the yaw rate r lags the course by tau (`sideslip` corrects that), so such a lag is no fault.
    """
    if any(f.severity is Severity.ERROR and "yaw_rate" in f.channels for f in findings):
        findings = [f for f in findings if f.name != "steering_unrelated"]
    if has_derived_yaw_rate(log):
        compared = ("yaw_rate_scale", "yaw_rate_bias", "yaw_rate_lag")
        findings = [f for f in findings if f.severity is Severity.ERROR or f.name not in compared]
    if CHANNELS["velocity_y"].is_measured_in(log):
        return findings
    speed = max(float(np.average(motion.speed, weights=np.square(motion.yaw_rate) + 1e-12)), MOVING)
    limits = {"steering_lag": (-np.inf, np.inf),
              "yaw_rate_lag": (-MAX_REAR_COMPLIANCE * speed, MAX_INS_DISTANCE / speed),
              "yaw_lag": (-MAX_INS_DISTANCE / speed, MAX_REAR_COMPLIANCE * speed)}
    advice = Advice("look", "record the heading of the car and velocity_y; without them the sensor's error is unknown")
    for k, f in enumerate(findings):
        low, high = limits.get(f.name, (np.inf, -np.inf))
        if f.value is not None and low <= f.value <= high:
            text = f"{f.text}; velocity_y is not measured, so yaw may be the course and the lag may be due to sideslip"
            severity = f.severity if f.name == "steering_lag" else Severity.NOTE
            findings[k] = replace(f, severity=severity, text=text, advice=advice)
    return findings


def _sort(findings: list[Finding]) -> tuple[Finding, ...]:
    """The findings by severity, accelerations last, since no prediction depends on them, and then by effect."""
    return tuple(sorted(findings, key=lambda finding: (
        [*Severity].index(finding.severity), finding.concerns_only_acceleration, -(finding.effect or np.inf))))


def _check_sensors_at_true_rate(motion: Motion, time_unit: Finding | None,
                                removed: dict[str, float]) -> tuple[list[Finding], SensorResult]:
    """(finding of a wrong nominal sampling rate, result of `_check_sensors` at the true rate)."""
    result = _check_sensors(motion, removed)
    rate = None if time_unit else check_nominal_rate(result[1], result[2])
    if rate is None or not rate.value:
        return [], result
    return [rate], _check_sensors(motion.with_time_divided(rate.value), removed)


def _check_sensors(motion: Motion, removed: dict[str, float]) -> SensorResult:
    """Check the relations that are valid for any vehicle. removed: see `_removed_factors`."""
    panels = [position.distance_panel(motion, removed)]
    motion, findings = position.check_lateral_sign(motion)
    found, tolerances = inertial.compare_yaw_rate(motion)
    motion, late = _check_yaw_lag(motion, found)
    recorded = motion
    motion, causes, estimates = position.check_positions(motion)
    if "wheel_speed" in motion.speeds and (wheel := inertial.compare_speed(recorded, "wheel_speed")):
        motion, causes = position.attribute_scale_to_positions(motion, causes, estimates, wheel.scale)
    if found and found.determines_lag:
        estimates["yaw_lag"] = with_systematic("yaw_lag", found.lag.scaled(-1.0))
    findings += late + causes
    if late or any(finding.name == "yaw_offset" for finding in causes):
        found, tolerances = inertial.compare_yaw_rate(motion)
    more, values = inertial.judge_agreement(found, tolerances, removed.get("yaw_rate_scale", 1.0))
    findings += more
    estimates |= values
    if "yaw_offset" in estimates:
        estimates["yaw_offset"] = estimates["yaw_offset"].shifted(removed.get("yaw_offset", 0.0))
    for name, fine in (("velocity_scale", "velocity_scale"), ("velocity_x_scale", "velocity_scale"),
                       ("position_scale", "position_scale")):
        if fine in estimates:
            estimates[name] = estimates[fine].scaled(removed.get(name, 1.0))
    if found and found.scale.value:  # a constant yaw rate has no scale
        scale = found.scale.inverse().scaled(removed.get("yaw_scale", 1.0))
        estimates["yaw_scale"] = with_systematic("yaw_scale", scale)
    panel = inertial.agreement_panel(found, tolerances, "yaw rate: sensor versus change of yaw",
                                     removed.get("yaw_rate_scale", 1.0),
                                     removed.get("yaw_scale", removed.get("yaw_convention", 1.0)))
    panels += [panel] if panel else []
    if found:
        motion = inertial.correct_yaw_rate(motion, found)
    for more, values, panel in (*inertial.check_accelerations(motion), *inertial.check_speeds(motion)):
        findings += more
        estimates |= values
        panels += [panel] if panel else []
    return motion, findings, estimates, panels


def _compare_with_vehicle(motion: Motion, vehicle: VehicleParameters, wheel_measured: bool, broken: set[str],
                          unusable: set[str]) -> list[inertial.CheckResult]:
    """Compare steering, rear axle and lateral acceleration with the vehicle. broken: channels that keep faulty samples.
    unusable: channels that are coarse, frozen or not measured."""
    comparisons = []
    if not broken & {*STEERING}:
        comparisons.append(vehicle_relations.check_steering(motion, vehicle, wheel_measured))
    if not unusable & {"velocity_y", "yaw_rate"}:
        comparisons.append(vehicle_relations.check_rear_axle(motion, vehicle))
    return [*comparisons, (vehicle_relations.check_tyre_limit(motion), {}, None)]


def _correct_units_without_lag(motion: Motion) -> tuple[Motion, list[Finding]]:
    """Result of `correct_units` for the motion without the lag between yaw and yaw rate, which would change size and
    sign of their ratio. The lag is restored afterwards, since it is checked later."""
    lag = inertial.yaw_rate_lag(motion)
    if not lag:
        return correct_units(motion)
    time = motion.time
    earlier_yaw = replace(motion, yaw=np.interp(time - lag, time, motion.yaw))
    if is_yaw_late(motion, earlier_yaw):
        aligned, findings = correct_units(earlier_yaw)
        return replace(aligned, yaw=np.interp(time + lag, time, aligned.yaw)), findings
    aligned, findings = correct_units(replace(motion, yaw_rate=np.interp(time + lag, time, motion.yaw_rate)))
    return replace(aligned, yaw_rate=np.interp(time - lag, time, aligned.yaw_rate)), findings


def _check_yaw_lag(motion: Motion, found: Agreement | None) -> tuple[Motion, list[Finding]]:
    """(corrected motion, finding) of a yaw that lags or leads the yaw rate, if positions confirm that yaw is wrong."""
    if found is None or not (found.lag.significant and found.is_late) or abs(found.lag.value) < LIMITS.lag or (
            abs(found.correlation) < LIMITS.correlation):
        return motion, []
    late = with_systematic("yaw_lag", found.lag.scaled(-1.0))
    corrected = replace(motion, yaw=np.interp(motion.time + late.value, motion.time, motion.yaw))
    if not position.positions_confirm_yaw_lag(motion, corrected, late.value):
        return motion, []
    effect = abs(late.value) * float(np.std(motion.yaw_rate)) * float(np.median(motion.speed)) * HORIZON
    severity = LIMITS.severity(effect, abs(late.value) >= LIMITS.severe_lag)
    value = float(f"{late.value:.4g}")
    text = f"yaw {'lags' if value > 0.0 else 'leads'} yaw rate and positions by {inertial.format_magnitude(late)} s"
    return corrected, [Finding("yaw_lag", severity, ("yaw",), text, late.value, "s", late.interval, effect=effect,
                               advice=Advice.correct("yaw", earlier=value))]


def _removed_factors(gross: list[Finding]) -> dict[str, float]:
    """Factors that `correct_units` divided by, and the yaw offset that it subtracted, by name of the finding."""
    removed = {}
    for finding in gross:
        correct = finding.advice.entry.get("correct", {}) if finding.advice else {}
        scale = next((entry["scale"] for entry in correct.values() if "scale" in entry), None)
        if not correct and finding.value:
            removed[finding.name] = finding.value
        elif finding.name == "yaw_offset":
            removed[finding.name] = -correct["yaw"]["add"]
        elif scale:
            removed[finding.name] = 1.0 / scale
    return removed


def _merge_gross_and_fine(gross: list[Finding], fine: list[Finding], estimates: dict[str, Estimate]) -> list[Finding]:
    """The findings `gross` of `correct_units` with refined values, and the findings `fine` that have other names."""
    fine_names = {finding.name for finding in fine}
    findings = []
    for finding in gross:
        estimate, advice = estimates.get(finding.name), finding.advice
        if estimate is None:
            findings.append(finding)
            continue
        if advice and finding.name in fine_names:
            # One correction replaces the correction of the unit or offset and its refinement.
            (channel, (key,)), = advice.entry["correct"].items()
            correction = 1.0 / estimate.value if key == "scale" else -estimate.value
            advice = Advice.correct(channel, **{key: float(f"{correction:.6g}")})
        findings.append(replace(finding, value=estimate.value, interval=estimate.interval, advice=advice))
    gross_names = {finding.name for finding in gross}
    return findings + [finding for finding in fine if finding.name not in gross_names]
