"""Runs all checks on a recording, ordered so that each fault yields only one finding."""

from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from ..channels import CHANNELS
from ..log import INS_SIGNALS, STEERING, DriveLog
from ..sideslip import has_derived_yaw_rate
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from . import inertial, position, sampling, units_and_axes, vehicle_relations
from .finding import HORIZON, LIMITS, Advice, Alternative, AuxiliaryData, DriveCheck, Finding, Severity, find
from .inertial import Agreement, Results
from .motion import MIN_MOVING_SPEED, Motion, is_driven
from .plausibility import drop_implausible, find_broken_channels
from .position_steps import check_position_deviations, check_position_steps, spread_bursts
from .regression import Estimate, add_systematic_uncertainty
from .trial import try_corrections

EXPLAINED_BY_YAW_LAG = ("yaw_rate_lag", "position_lag", "position_reference", "steering_lag")
MAX_INS_DISTANCE = 3.0  # m; largest distance of the INS ahead of the rear axle
MAX_REAR_COMPLIANCE = 0.01  # rad s^2/m; rear cornering compliance (slip angle per a_y): road cars 0.003 to 0.008
MIN_PART_DURATION = 40.0  # s; shortest first and last part of a drive that are compared: 8 blocks of the bootstrap
MAX_PART_DURATION = 300.0  # s; longest such part; it limits the computing time
MIN_CHANGE = 0.5  # of `Finding.deviation`; if the parts differ by less, one correction removes at least half of it
NOT_COMPARED = (  # between parts of a drive: points on the car do not move, the last two depend on the driving
    "measuring_point", "position_reference", "position_side", "heading_misaligned", "steering_unrelated")
LEVEL_SCALES = "velocity_scale", "position_scale", "yaw_rate_scale"  # findings that a slope or bank may cause
VELOCITY_CLOCK_LAGS = "yaw_rate_lag", "acceleration_x_lag", "acceleration_y_lag", "steering_lag"
CAUSED_BY_DRIFT = ("yaw_drift", "yaw_offset", "velocity_y_scale", "velocity_y_bias")  # findings due to drift in a part
MIN_INS_SAMPLES = 50  # with fewer samples, only implausible samples and time stamps are reported


def check(log: DriveLog, vehicle: VehicleParameters | None = None,
          auxiliary: AuxiliaryData | None = None) -> DriveCheck:
    """Result of all checks of one recording.

    Each check uses a copy corrected for the faults found before. No content of a recording raises an exception:
    channels that are too short or too inaccurate are not compared. Since faults may begin or grow during a drive, the
    first and the last part of a long drive are also checked separately.
    """
    auxiliary = auxiliary or AuxiliaryData()
    start_ns = next(iter(log.ins_time_ns[:1].tolist()), 0) if auxiliary.start_ns is None else auxiliary.start_ns
    log, burst_findings = spread_bursts(log)
    log, sign_findings = (inertial.restore_speed_sign(log, start_ns)
                          if len(log.ins_time_ns) >= MIN_INS_SAMPLES else (log, []))
    result = _check_part(log, vehicle, auxiliary, start_ns)
    if log.duration >= 2.0 * MIN_PART_DURATION:
        first, last = log.ins_time_ns[[0, -1]].tolist()
        duration = min((last - first) // 2, round(MAX_PART_DURATION / NANOSECOND))
        middle, late = first + duration, last - duration
        times = [tuple((t - start_ns) * NANOSECOND for t in span) for span in ((first, middle), (late, last))]
        # A change of the accelerations alone is not reported, but they may show which of two other channels changed.
        for compared in (replace(log, acceleration_x=None, acceleration_y=None), log):
            parts = [_check_part(compared.slice(*span), vehicle, replace(auxiliary, implausible=()), start_ns)
                     for span in ((log.start_ns, middle - 1), (late, log.end_ns))]
            with_changes = _report_changes(result, parts, times)
            if with_changes is result:
                break
        result = with_changes
    # Within each severity, accelerations are last, since no prediction depends on them.
    in_bursts = {finding.channels for finding in burst_findings}  # their gaps are due to the time stamps
    findings = [f for f in result.findings if f.name != "time_gaps" or f.times or f.channels not in in_bursts]
    findings = sorted((*burst_findings, *sign_findings, *findings), key=lambda finding: (
        [*Severity].index(finding.severity), finding.concerns_only_acceleration, -(finding.effect or np.inf)))
    ambiguous = {name for f in findings for a in f.alternatives for name in (f.name, *a.findings)}
    ambiguous |= {"steering_sign"} if "steering_scale" in ambiguous else set()  # the same estimate by another name
    ambiguous -= {"velocity_scale", "position_scale"}  # ratios of velocity and positions, whichever is wrong
    return replace(result, findings=tuple(findings), estimates={
        name: values for name, values in result.estimates.items() if name not in ambiguous})


def _report_changes(whole: DriveCheck, parts: list[DriveCheck], times: list[tuple[float, float]]) -> DriveCheck:
    """The result for a drive; `whole` itself if no error or warning changes between its first and last part. Otherwise,
    findings with an interval are taken from the parts, because the change may cause false ones in the whole drive, and
    estimates that differ from those of a part are left out. times: start and end of each part [s]."""
    places = [f"in the {name} {end - start:.0f} s" for name, (start, end) in zip(("first", "last"), times, strict=True)]
    drift, *drifts = (each.estimates.get("yaw_drift", (0.0, -np.inf, np.inf)) for each in (whole, *parts))
    drifts_evenly = find(whole.findings, "yaw_drift") and all(_agree(drift, d) for d in drifts)
    wanders = find(whole.findings, "yaw_wander") and any(find(part.findings, "yaw_wander") for part in parts)
    ignored = CAUSED_BY_DRIFT if drifts_evenly or wanders else ()
    advice = Advice("text", "split the recording where this changes: no correction fits the whole drive")
    ranked = []
    for k, part in enumerate(parts):
        for finding in (f for f in part.findings if not f.times and f.name not in ignored):
            change = _describe_change(finding, parts[1 - k], places[1 - k], whole)
            rank = bool(change), -[*Severity].index(finding.severity), finding.deviation, k
            statement = f"{places[k]} of the drive, {finding.statement.removesuffix('?')}{change}"
            ranked.append((rank, replace(
                finding, statement=statement, advice=advice, times=(times[k],)) if change else finding))
    in_parts = {finding.name: finding for _, finding in sorted(ranked, key=itemgetter(0))}  # by name, the highest rank
    changed = {finding.name for finding in in_parts.values() if finding.times}
    if not changed:
        return whole
    kept = [f for f in whole.findings if (f.times and f.name != "position_deviation") or f.name in ignored or (
        f.interval is None and f.name in in_parts.keys() - changed)]
    replaced = [f for f in in_parts.values() if f.name not in {f.name for f in kept}]
    return replace(whole, findings=(*kept, *replaced), estimates={
        name: values for name, values in whole.estimates.items() if name not in changed
        and all(name in part.estimates and _agree(values, part.estimates[name]) for part in parts)})


def _agree(first: tuple[float, float, float], second: tuple[float, float, float]) -> bool:
    """Whether two estimates (value, low, high) are not significantly different."""
    return abs(first[0] - second[0]) <= float(np.hypot(first[0] - first[1], second[0] - second[1]))


def _describe_change(finding: Finding, other: DriveCheck, place: str, whole: DriveCheck) -> str:
    """Clause about the value in the other part of the drive, at `place`, if it differs significantly; otherwise ""."""
    name, value, interval = finding.name, finding.value, finding.interval
    if (finding.severity is Severity.NOTE or name in NOT_COMPARED
            or finding.concerns_only_acceleration or finding.channels == units_and_axes.LENGTH_CHANNELS
            or any(f.name in position.CONFOUNDED.get(name, ()) for f in other.findings)):  # may be the same fault
        return ""
    if value is None or interval is None:
        return "" if name in {f.name for f in (*other.findings, *whole.findings)} else f", but not {place}"
    there = other.estimates.get(name) or next(
        ((f.value, *f.interval) for f in other.findings if f.name == name and f.value is not None and f.interval), None)
    if there is None or _agree((value, *interval), there) or abs(there[0] - value) <= MIN_CHANGE * finding.deviation:
        return ""
    unit = "" if finding.unit == "1" else f" {finding.unit}"
    return f"; {place}, the value is {there[0]:.3g} ({there[1]:.3g} to {there[2]:.3g}){unit}"


def _check_part(log: DriveLog, vehicle: VehicleParameters | None, auxiliary: AuxiliaryData,
                start_ns: int) -> DriveCheck:
    """Unsorted result for a drive or a part of it, including ambiguous estimates. start_ns: zero of the times [ns]."""
    log, implausible = drop_implausible(log, start_ns)
    # The reader has already reported samples that it left out, or kept although implausible.
    reported = {(finding.name, finding.channels) for finding in auxiliary.implausible}
    implausible = [*auxiliary.implausible, *(f for f in implausible if (f.name, f.channels) not in reported)]
    motion = Motion.from_log(log, start_ns, auxiliary)
    channels = sampling.describe_channels(motion, auxiliary)
    is_long_enough = len(log.ins_time_ns) >= MIN_INS_SAMPLES
    is_moving = is_long_enough and (is_driven(motion) or units_and_axes.correct_length_unit(motion)[1] is not None)
    motion, time_unit = units_and_axes.check_time_unit(motion) if is_moving else (motion, None)
    results = Results([*implausible, *sampling.check_timing(motion, auxiliary, implausible, start_ns)])
    results.findings += sampling.check_quality(auxiliary.quality, start_ns) if is_long_enough else []
    broken_channels = find_broken_channels(implausible)
    if is_moving:
        unusable: dict[str, Any] = dict.fromkeys(broken_channels & {*inertial.ACCELERATIONS})
        motion = replace(motion, **unusable)
        stuck_findings = sampling.find_stuck_channels(motion, channels)
        results.findings += stuck_findings
        broken_channels |= find_broken_channels(stuck_findings)
        if not broken_channels & {*INS_SIGNALS}:  # comparisons need all of these channels
            decisive = vehicle_relations.check_test_bench(motion) or inertial.check_position_clock(motion)
            results.findings += decisive
            if not decisive:  # comparisons need a moving car, and positions on the clock of the other channels
                _check_relations(results, motion, log, vehicle, time_unit, stuck_findings, broken_channels)
    elif is_long_enough:
        results.findings += vehicle_relations.check_standstill(motion)
    return DriveCheck(tuple(results.findings), channels, tuple(results.panels), {
        name: (estimate.value, *estimate.interval) for name, estimate in results.estimates.items()})


def _check_relations(results: Results, motion: Motion, log: DriveLog, vehicle: VehicleParameters | None,
                     time_unit: Finding | None, stuck_findings: list[Finding], broken_channels: set[str]) -> None:
    """Add the results of comparing the channels with each other and with the vehicle."""
    held_channels = _list_channels(stuck_findings, "samples_repeated")
    motion, unit_findings = _correct_units(sampling.drop_frozen_samples(motion, stuck_findings), vehicle)
    unit_findings = [time_unit, *unit_findings] if time_unit else unit_findings
    coarse_findings = sampling.find_coarse_channels(motion, held_channels)
    results.findings += coarse_findings
    coarse_channels = _list_channels(coarse_findings)
    # The derivative of a coarse channel is dominated by rounding.
    motion = replace(motion, acceleration_x=None if "velocity_x" in coarse_channels else motion.acceleration_x,
                     acceleration_y=None if coarse_channels & {"velocity_y", "yaw_rate"} else motion.acceleration_y)
    motion = sampling.interpolate_held_channels(motion, held_channels)
    if not {"x", "y"} & held_channels:  # held positions move in steps
        motion, step_findings = check_position_steps(motion)
        results.findings += step_findings
    speed, yaw_rate, sideslip_measured = motion.velocity_x, motion.yaw_rate, CHANNELS["velocity_y"].is_measured_in(log)
    removed_factors = _find_removed_factors(unit_findings)
    corrected, sensors, yaw_rate_lag = _check_level_sensors(motion, removed_factors)
    wrong_rate = None if time_unit else units_and_axes.check_nominal_rate(sensors.findings, sensors.estimates)
    if wrong_rate and wrong_rate.value:
        results.findings.append(wrong_rate)
        corrected, sensors, yaw_rate_lag = _check_sensors(motion.with_time_divided(wrong_rate.value), removed_factors)
    findings = _merge_findings_of_units(unit_findings, sensors.findings, sensors.estimates)
    corrected, findings = position.attribute_scale_to_velocity_x(corrected, findings, sensors.estimates)
    findings = _add_position_scale(findings, motion, removed_factors.get("velocity_scale", 1.0))
    results.findings += findings
    results.findings += _check_deviations(corrected, results.findings) if sideslip_measured else []
    results.estimates, results.panels = sensors.estimates, sensors.panels
    if vehicle is not None:
        if not broken_channels & {*STEERING}:
            from_steering_wheel = log.steering_wheel_angle is not None and np.allclose(
                log.road_wheel_angle, vehicle.road_wheel_angle(log.steering_wheel_angle), atol=1e-4)
            vehicle_relations.check_steering(results, corrected, vehicle, from_steering_wheel)
        unusable_channels = coarse_channels | _list_channels(stuck_findings, "channel_frozen", 0.5 * log.duration)
        if sideslip_measured and not unusable_channels & {"velocity_y", "yaw_rate"}:
            _check_rear_axle(results, corrected, vehicle, findings)
        results.findings += vehicle_relations.check_tyre_limit(corrected, sideslip_measured)
    results.findings += vehicle_relations.check_standstill(replace(corrected, velocity_x=speed, yaw_rate=yaw_rate))
    _attribute_lags(results)
    results.findings = _add_yaw_lag_alternative(results.findings, corrected, yaw_rate_lag)
    _remove_consequences(results, log, corrected)
    if vehicle is not None:
        results.findings = try_corrections(results.findings, log, vehicle)


def _check_deviations(motion: Motion, findings: list[Finding]) -> list[Finding]:
    """Result of `check_position_deviations`, unless the deviations are those of velocities along a slope."""
    found = check_position_deviations(motion, findings)
    level = inertial.make_level_motions(motion) if found else []
    return found if all(check_position_deviations(each, findings) for each in level) else []


def _add_position_scale(findings: list[Finding], motion: Motion, removed_factor: float) -> list[Finding]:
    """The findings; a scale error of the velocity has one of the positions as an alternative if measurements fit both.
    removed_factor: already divided out of the velocity."""
    scale, recorded = find(findings, "velocity_scale"), {"correct": {"velocity": {"scale": removed_factor}}}
    if scale is None or not scale.value or units_and_axes.match_unit(scale.value) or (
            inertial.confirm_velocity(motion.apply_entry(recorded), scale.value) != ""):
        return findings
    alternative = Alternative(f"x and y are {1.0 / scale.value:.4g} times their true values", ("position_scale",))
    advice = Advice("text", "compare the positions with a known distance to distinguish the two")
    return [f.with_alternative(alternative, advice, "x", "y") if f is scale else f for f in findings]


def _check_rear_axle(results: Results, motion: Motion, vehicle: VehicleParameters, findings: list[Finding]) -> None:
    """Add the results of `check_rear_axle`. motion: corrected for a scale error of the velocity. Since positions may be
    wrong instead, a finding must also result from the recorded velocity; the lower of both severities is used."""
    rear = vehicle_relations.check_rear_axle(motion, vehicle)
    scale, found = find(findings, "velocity_scale"), rear.findings
    if found and scale is not None and scale.value and not units_and_axes.match_unit(scale.value):
        recorded = motion.apply_entry({"correct": {"velocity": {"scale": scale.value}}})
        others = {finding.name: finding for finding in vehicle_relations.check_rear_axle(recorded, vehicle).findings}
        found = [replace(finding, severity=max(finding.severity, others[finding.name].severity, key=[*Severity].index))
                 for finding in found if finding.name in others]
    for alternative in [a for f in findings for a in f.alternatives if "velocity_y_scale" in a.findings][:1]:
        found = [finding.with_alternative(alternative, position.VARY_BENDS) for finding in found]
    results.findings += found
    results.estimates |= rear.estimates
    results.panels += rear.panels


def _list_channels(findings: list[Finding], name: str = "", min_value: float = 0.0) -> set[str]:
    """Channels affected by the findings of this name (default: any) with at least this value."""
    return {channel for finding in findings if name in ("", finding.name) and (finding.value or 0.0) >= min_value
            for channel in finding.channels}


def _remove_consequences(results: Results, log: DriveLog, motion: Motion) -> None:
    """Remove findings and estimates that follow from a wrong yaw rate or a channel that was derived, not measured.

    The noise of yaw changes the scale of a yaw rate derived from it. Without velocity_y, yaw may be the course. The
    sideslip at a point l ahead of a rear axle with cornering compliance K is tau r, tau = l / v - K v: the yaw rate r
    lags the course by tau (`sideslip` corrects this). A lag that sideslip may explain has no correction, and becomes
    a note unless it is the steering lag.
    """
    if any(f.severity is Severity.ERROR and "yaw_rate" in f.channels for f in results.findings):
        results.findings = [f for f in results.findings if f.name != "steering_unrelated"]
    if has_derived_yaw_rate(log):
        comparisons = ("yaw_rate_scale", "yaw_rate_bias", "yaw_rate_lag")
        results.findings = [f for f in results.findings if f.severity is Severity.ERROR or f.name not in comparisons]
    if CHANNELS["velocity_y"].is_measured_in(log):
        return
    speed = max(float(np.average(motion.speed, weights=np.square(motion.yaw_rate) + 1e-12)), MIN_MOVING_SPEED)
    limits = {"steering_lag": (-np.inf, np.inf),
              "yaw_rate_lag": (-MAX_REAR_COMPLIANCE * speed, MAX_INS_DISTANCE / speed),
              "yaw_lag": (-MAX_INS_DISTANCE / speed, MAX_REAR_COMPLIANCE * speed)}
    for name in limits:
        results.estimates.pop(name, None)
    advice = Advice("text", "record the heading of the car and velocity_y; without them the sensor's error is unknown")
    for k, f in enumerate(results.findings):
        if f.name == "position_reference":
            statement = f"{f.statement}; velocity_y is missing or 0, which is correct only for a point on the rear axle"
            results.findings[k] = replace(f, statement=statement)
        low, high = limits.get(f.name, (np.inf, -np.inf))
        if f.value is not None and low <= f.value <= high:
            statement = (f"{f.statement}; velocity_y is missing or 0, so yaw may be the course and the lag may be due "
                         "to sideslip")
            severity = f.severity if f.name == "steering_lag" else Severity.NOTE
            results.findings[k] = replace(f, severity=severity, statement=statement, advice=advice)


def _check_level_sensors(motion: Motion, removed_factors: dict[str, float]) -> tuple[Motion, Results, float | None]:
    """Result of `_check_sensors`, for the horizontal components of velocities or yaw rate if this removes findings: on
    a slope or in a banked bend, those in the axes of the car are not the rates of change of position and yaw. This also
    confirms the accelerations, which then differ from the derivatives of velocity by gravity."""
    result = _check_sensors(motion, removed_factors)
    scales = [find(result[1].findings, f"{name}_scale") for name in inertial.ACCELERATIONS]
    if not any(scale and inertial.is_unit_or_sign(scale.value) for scale in scales):
        for level in inertial.make_level_motions(motion) if find(result[1].findings, *LEVEL_SCALES) else ():
            other = _check_sensors(level, removed_factors)
            remaining, before = ({f.name for f in each[1].findings if not f.concerns_only_acceleration}
                                 for each in (other, result))
            if remaining < before and not remaining & {*LEVEL_SCALES}:
                other[1].findings = [f for f in other[1].findings if f.name in remaining or f.name.endswith("_bias")]
                result = other
    return result


def _check_sensors(motion: Motion, removed_factors: dict[str, float]) -> tuple[Motion, Results, float | None]:
    """(corrected motion, results of the relations valid for any vehicle, lag of the yaw rate [s]). The lag is None
    unless a lag of yaw of opposite sign fits equally well. removed_factors: see `_find_removed_factors`."""
    distance_panel = position.make_distance_panel(motion, removed_factors)
    yaw_rate = inertial.compare_yaw_rate(motion)
    recorded, lag_findings, yaw_rate_lag = _check_yaw_lag(motion, yaw_rate)
    motion, findings, estimates = position.check_positions(recorded)
    motion, findings = position.attribute_scale_to_positions(
        motion, findings, estimates, lambda factor: inertial.confirm_velocity(recorded, factor))
    results = Results([*lag_findings, *findings], estimates, [distance_panel])
    if yaw_rate and yaw_rate.determines_lag:
        estimates["yaw_lag"] = add_systematic_uncertainty("yaw_lag", yaw_rate.lag.scaled(-1.0))
    if lag_findings or find(findings, "yaw_offset", "yaw_wander"):
        yaw_rate = inertial.compare_yaw_rate(motion)
    inertial.check_yaw_rate(results, motion, yaw_rate, removed_factors)
    scale = find(results.findings, "yaw_rate_scale")
    if scale and scale.value and not units_and_axes.fits_better(
            motion, replace(motion, yaw=scale.value * motion.yaw)):  # positions fit a scale error of yaw equally well
        alternative = Alternative(f"yaw is {1.0 / scale.value:.3f} times its true value", ("yaw_scale",))
        advice = Advice("text", "record more accurate positions to distinguish the two")
        results.findings = [finding.with_alternative(alternative, advice, "yaw") if finding is scale else finding
                            for finding in results.findings]
    if yaw_rate and yaw_rate.scale.value:  # a constant yaw rate has no scale
        estimates["yaw_scale"] = add_systematic_uncertainty("yaw_scale", yaw_rate.scale.inverse())
    for name in removed_factors.keys() & estimates.keys():  # from corrected to recorded units
        estimate, value = estimates[name], removed_factors[name]
        estimates[name] = estimate.shifted(value) if name == "yaw_offset" else estimate.scaled(value)
    if "velocity_scale" in estimates:
        estimates["velocity_x_scale"] = estimates["velocity_scale"].scaled(removed_factors.get("velocity_x_scale", 1.0))
    # Errors of the yaw rate are corrected if it correlates well enough with the change of yaw.
    if yaw_rate and yaw_rate.correlation >= inertial.GYRO_CORRELATION:
        motion = replace(motion, yaw_rate=(motion.yaw_rate - yaw_rate.bias.value) / yaw_rate.scale.value)
    if yaw_rate and yaw_rate.correlation >= LIMITS.min_correlation and yaw_rate.has_lag:
        motion = motion.shifted_earlier(yaw_rate.lag.value, "yaw_rate")
    inertial.check_accelerations(results, motion)
    inertial.check_speeds(results, motion)
    # A bank reduces a_y, and the yaw rate about the axis of the car; with both accelerations, the latter is checked.
    for k, f in enumerate(results.findings):
        is_affected = f.name == "acceleration_y_scale" or (f.name == "yaw_rate_scale" and motion.acceleration_y is None)
        if is_affected and 1.0 / LIMITS.channel_unit_ratio < (f.value or 0.0) < 1.0:
            results.findings[k] = f.with_alternative(vehicle_relations.BANK, position.VARY_BENDS)
    return motion, results, yaw_rate_lag


def _correct_units(motion: Motion, vehicle: VehicleParameters | None) -> tuple[Motion, list[Finding]]:
    """Result of `correct_units`. If the steering contradicts a unit of length, the accelerations have a wrong unit."""
    corrected, findings = _correct_units_without_lag(motion)
    unit = next((finding.value for finding in findings if finding.channels == units_and_axes.LENGTH_CHANNELS), None)
    if vehicle is None or unit is None or not vehicle_relations.steering_confirms_length(motion, vehicle, unit):
        return corrected, findings
    corrected, findings = _correct_units_without_lag(replace(motion, acceleration_x=None, acceleration_y=None))
    return replace(corrected, acceleration_x=motion.acceleration_x, acceleration_y=motion.acceleration_y), findings


def _correct_units_without_lag(motion: Motion) -> tuple[Motion, list[Finding]]:
    """Result of `correct_units`, with a severe lag between yaw and yaw rate, which would change their ratio, removed
    first and restored afterwards."""
    agreement = inertial.compare_yaw_rate(motion, inertial.ACCELERATION_CUTOFF)
    # A yaw rate with the opposite sign also correlates at a lag of half a period, but no better than at zero lag.
    if (agreement is None or not agreement.has_lag or abs(agreement.lag.value) < LIMITS.severe_lag
            or agreement.correlation < LIMITS.min_correlation
            or abs(agreement.correlation_without_lag) >= agreement.correlation - 0.05):
        return units_and_axes.correct_units(motion)
    lag = agreement.lag.value
    yaw_is_wrong = units_and_axes.fits_better(motion.shifted_earlier(-lag, "yaw"), motion)
    name, seconds = ("yaw", -lag) if yaw_is_wrong else ("yaw_rate", lag)
    aligned, findings = units_and_axes.correct_units(motion.shifted_earlier(seconds, name))
    return aligned.shifted_earlier(-seconds, name), findings


def _attribute_lags(results: Results) -> None:
    """If the accelerations, and the yaw rate if the car turns, have the lag of the velocities, attribute a lag of
    opposite sign to the positions, and to yaw."""
    velocity, estimates = find(results.findings, "velocity_lag"), results.estimates
    known = {name for name in VELOCITY_CLOCK_LAGS if name in estimates}
    if velocity is None or velocity.interval is None or find(results.findings, "position_lag") or (
            not known - {"yaw_rate_lag", "steering_lag"}):
        return
    lag = estimates["velocity_lag"].scaled(-1.0)  # of the positions
    same = {name for name in known if estimates[name].is_significant and abs(
        estimates[name].value + lag.value) < LIMITS.severe_lag + estimates[name].half_width}
    if known - same - {"steering_lag"}:
        return
    turns, verb = "yaw_rate_lag" in same, "lag" if lag.value > 0.0 else "lead"
    text = f"positions{' and yaw' * turns} {verb} velocities, accelerations{' and yaw_rate' * turns} by {abs(lag)} s"
    correct = {name: {"earlier": float(f"{lag.value:.5g}")} for name in ("position", *["yaw"] * turns)}
    finding = replace(velocity, name="position_lag", channels=("x", "y", *["yaw"] * turns), statement=text,
                      value=lag.value, interval=lag.interval, alternatives=(),
                      advice=Advice.for_run_yaml({"correct": correct}))
    results.findings = [finding, *(f for f in results.findings if f.name not in {"velocity_lag", *same})]
    results.estimates = {**{name: estimates[name] for name in estimates.keys() - same - {"velocity_lag"}},
                         "position_lag": lag}


def _add_yaw_lag_alternative(findings: list[Finding], motion: Motion, lag: float | None) -> list[Finding]:
    """The findings, with a lag of yaw as an alternative cause of those that it mostly explains. lag: of the yaw rate
    [s]; None unless a lag of yaw of opposite sign fits equally well."""
    if lag is None:
        return findings
    alternative = Alternative(f"yaw {'lags' if lag < 0.0 else 'leads'} by {abs(lag):.3f} s", ("yaw_lag",))
    sizes = {"s": abs(lag), "m": abs(lag) * float(np.median(motion.speed))}
    return [finding.with_alternative(alternative, position.VARY_BENDS, "yaw")
            if finding.name in EXPLAINED_BY_YAW_LAG and finding.value
            and abs(finding.value) * position.MAX_RESIDUAL_LAG_RATIO < sizes[finding.unit] else finding
            for finding in findings]


def _check_yaw_lag(motion: Motion, agreement: Agreement | None) -> tuple[Motion, list[Finding], float | None]:
    """(corrected motion, finding, None) if yaw lags or leads the yaw rate and positions confirm that yaw is wrong;
    (motion, [], lag of the yaw rate [s]) if either may be wrong according to positions; else (motion, [], None)."""
    if (agreement is None or not agreement.has_lag or not agreement.correlates
            or abs(agreement.lag.value) < LIMITS.lag):
        return motion, [], None
    lag = add_systematic_uncertainty("yaw_lag", agreement.lag.scaled(-1.0))
    corrected = motion.shifted_earlier(lag.value, "yaw")
    is_confirmed = position.positions_confirm_yaw_lag(motion, corrected, lag.value)
    if not is_confirmed:  # False, or None if positions fit both
        return motion, [], agreement.lag.value if is_confirmed is None else None
    effect = abs(lag.value) * float(np.std(motion.yaw_rate)) * float(np.median(motion.speed)) * HORIZON
    severity = LIMITS.severity(effect, abs(lag.value) >= LIMITS.severe_lag)
    text = f"yaw {'lags' if lag.value > 0.0 else 'leads'} yaw rate and positions by {abs(lag)} s"
    return corrected, [Finding("yaw_lag", severity, ("yaw",), text, lag.value, "s", lag.interval, effect=effect,
                               advice=Advice.correct("yaw", earlier=float(f"{lag.value:.4g}")))], None


def _find_removed_factors(unit_findings: list[Finding]) -> dict[str, float]:
    """Factors that `correct_units` divided out, and the yaw offset that it subtracted, by name of the finding."""
    removed_factors = {}
    for finding in unit_findings:
        corrections = finding.advice.entry.get("correct", {}) if finding.advice else {}
        fields = {key: value for correction in corrections.values() for key, value in correction.items()}
        if finding.name == "yaw_offset":
            removed_factors[finding.name] = -fields["add"]
        elif not {"yaw", "yaw_rate"} <= corrections.keys():  # the ratio of these two is unchanged
            removed_factors[finding.name] = 1.0 / fields["scale"] if "scale" in fields else finding.value or 1.0
    return removed_factors


def _merge_findings_of_units(unit_findings: list[Finding], sensor_findings: list[Finding],
                             estimates: dict[str, Estimate]) -> list[Finding]:
    """The findings of `correct_units` with refined values, and the sensor findings that have other names."""
    sensor_names = {finding.name for finding in sensor_findings}
    findings = []
    for finding in unit_findings:
        estimate, statement, advice = estimates.get(finding.name), finding.statement, finding.advice
        if finding.value is not None and finding.interval is not None:  # a scale of yaw, estimated from positions
            half_width = finding.value - finding.interval[0]
            estimates[finding.name] = Estimate(finding.value, 0.5 * half_width, half_width)
        if estimate is None or finding.interval is not None:
            findings.append(finding)
            continue
        if advice and finding.name in sensor_names:
            # One correction replaces the correction of the unit or offset and its refinement.
            (channel, (key,)), = advice.entry["correct"].items()
            correction = 1.0 / estimate.value if key == "scale" else -estimate.value
            advice = Advice.correct(channel, **{key: float(f"{correction:.6g}")})
            if finding.name == "velocity_y_scale":  # the other statements contain the value
                statement += f": it is {estimate} times its value from positions, yaw and velocity_x"
        findings.append(replace(finding, statement=statement, value=estimate.value, interval=estimate.interval,
                                advice=advice))
    unit_names = {finding.name for finding in unit_findings}
    return findings + [finding for finding in sensor_findings if finding.name not in unit_names]
