"""All checks of one recording, in an order in which one fault gives one finding."""

from dataclasses import replace

import numpy as np

from ..log import INS_SIGNALS, STEERING, DriveLog
from ..vehicle import VehicleParameters
from . import inertial, position, sampling, vehicle_relations
from .finding import HORIZON, LIMITS, Advice, AuxiliaryData, Checked, Finding, Identity, Severity
from .inertial import identity, judged, size_of
from .motion import Motion, is_driven
from .plausibility import broken_channels, plausible
from .regression import Agreement, Estimate, with_systematic
from .steps import steps
from .trial import tried
from .units_and_axes import correct_units, nominal_rate, time_unit, yaw_is_late

SHORTEST = 50  # INS samples; in fewer only the time stamps can be checked
Compared = tuple[Motion, list[Finding], dict[str, Estimate], list[Identity]]


# long: one sequence, each step judges what the steps before have corrected
def check(log: DriveLog, vehicle: VehicleParameters | None = None, auxiliary: AuxiliaryData | None = None) -> Checked:
    """Findings of one recording.

    First how it was sampled, then units, signs and axes, then the identities that no vehicle parameter can break
    (position, yaw, velocity, accelerations, other speeds), then those with the car. What is found is taken out of a
    working copy before the next is judged.

    vehicle: for the identities with the car; None leaves those out. auxiliary: what else was recorded. Never raises
    for what is in a recording: a channel too short or too poor to judge gives no finding.
    """
    auxiliary = auxiliary or AuxiliaryData()
    start_ns = int(log.ins_time_ns[0]) if len(log.ins_time_ns) and auxiliary.start_ns is None else (
        auxiliary.start_ns or 0)
    log, implausible = plausible(log, start_ns)
    implausible = [*auxiliary.implausible, *implausible]
    motion = Motion.of(log, start_ns, auxiliary)
    known = sampling.channels(motion, auxiliary)
    enough = len(log.ins_time_ns) >= SHORTEST
    driven = enough and is_driven(motion)
    motion, unit = time_unit(motion) if driven else (motion, None)
    findings = [*implausible, *sampling.timing(motion, auxiliary, implausible)]
    findings += sampling.quality(auxiliary.quality, start_ns) if enough else []
    if not driven:
        return Checked(_ordered([*findings, *(vehicle_relations.standstill(motion) if enough else [])]), known, ())
    broken = broken_channels(implausible)
    if broken & {*INS_SIGNALS}:  # whatever is compared with it would seem wrong
        return Checked(_ordered([*findings, *sampling.stuck(motion, known)]), known, ())
    motion = motion.with_(**dict.fromkeys(broken & {"acceleration_x", "acceleration_y"}, None))
    stuck = sampling.stuck(motion, known)
    motion, coarse = _gross_aligned(sampling.unfrozen(motion, stuck))
    coarse = [unit, *coarse] if unit else coarse
    rounded = sampling.rounded(motion, stuck)
    findings += stuck + rounded
    rough = {channel for one in rounded for channel in one.channels}  # their rates of change are mostly rounding
    motion = motion.with_(**{f"acceleration_{axis}": None for axis, needed in (
        ("x", {"velocity_x"}), ("y", {"velocity_y", "yaw_rate"})) if rough & needed})
    if not any(one.name == "samples_repeated" and {"x", "y"} & set(one.channels) for one in stuck):
        motion, stepping = steps(motion)  # held positions step by nature
        findings += stepping
    speed = motion.velocity_x
    rate, compared = _sensors_at_true_rate(motion, unit, _factors(coarse))
    motion, fine, estimates, identities = compared
    findings += rate + _once(coarse, fine, estimates)
    hand_wheel = log.steering_wheel_angle is not None
    unusable = rough | {channel for one in stuck if one.name == "channel_frozen" for channel in one.channels}
    for found, more, shown in _with_vehicle(motion, vehicle, hand_wheel, broken, unusable):
        findings += found
        estimates |= more
        identities += [shown] if shown else []
    findings += vehicle_relations.standstill(motion.with_(velocity_x=speed))
    if vehicle is not None:
        findings = tried(findings, log, vehicle)
    return Checked(_ordered(findings), known, tuple(identities),
                   {name: (one.value, *one.interval) for name, one in estimates.items()})


def _sensors_at_true_rate(motion: Motion, unit: Finding | None,
                          before: dict[str, float]) -> tuple[list[Finding], Compared]:
    """(the finding of a wrong sampling rate, result of `_sensors` with the times at the true rate)."""
    compared = _sensors(motion, before)
    rate = None if unit else nominal_rate(compared[1], compared[2])
    if rate is None or not rate.value:
        return [], compared
    return [rate], _sensors(motion.slower(rate.value), before)


def _with_vehicle(motion: Motion, vehicle: VehicleParameters | None, hand_wheel: bool, broken: set[str],
                  unusable: set[str]) -> list[vehicle_relations.Comparison]:
    """Comparisons of steering, rear axle and lateral acceleration with the vehicle; broken, frozen or coarse channels
    left out."""
    if vehicle is None:
        return []
    comparisons = []
    if not broken & {*STEERING}:
        comparisons.append(vehicle_relations.steering(motion, vehicle, hand_wheel))
    if not unusable & {"velocity_y", "yaw_rate"}:  # both are needed to locate the INS
        comparisons.append(vehicle_relations.rear_axle(motion, vehicle))
    return [*comparisons, (vehicle_relations.believable(motion), {}, None)]


def _ordered(findings: list[Finding]) -> tuple[Finding, ...]:
    """Sorted by severity, then by effect; findings of accelerations last, since no prediction depends on them."""
    return tuple(sorted(findings, key=lambda one: ([*Severity].index(one.severity), one.of_acceleration,
                                               -(one.effect or np.inf))))


def _gross_aligned(motion: Motion) -> tuple[Motion, list[Finding]]:
    """As `gross`, of yaw and yaw rate brought to one time: over windows of a second, one that is late by a third of the
    drive's period has another size and sign. What is returned still has the lag, which is judged later."""
    lag = inertial.turn_lag(motion)
    if not lag:
        return correct_units(motion)
    time = motion.time
    yaw_first = motion.with_(yaw=np.interp(time - lag, time, motion.yaw))
    if yaw_is_late(motion, yaw_first):
        aligned, found = correct_units(yaw_first)
        return aligned.with_(yaw=np.interp(time + lag, time, aligned.yaw)), found
    aligned, found = correct_units(motion.with_(yaw_rate=np.interp(time + lag, time, motion.yaw_rate)))
    return aligned.with_(yaw_rate=np.interp(time - lag, time, aligned.yaw_rate)), found


def _late_yaw(motion: Motion, found: Agreement | None) -> tuple[Motion, list[Finding]]:
    """Correction and finding of a yaw that lags or leads the yaw rate, if positions confirm that the yaw is wrong."""
    if found is None or not (found.lag.significant and found.late) or abs(found.lag.value) < LIMITS.lag or (
            abs(found.correlation) < LIMITS.correlation):
        return motion, []
    late = with_systematic("yaw_lag", found.lag.scaled(-1.0))
    earlier = motion.with_(yaw=np.interp(motion.time + late.value, motion.time, motion.yaw))
    if not position.positions_confirm_yaw_lag(motion, earlier, late.value):
        return motion, []
    effect = abs(late.value) * float(np.std(motion.yaw_rate)) * float(np.median(motion.speed)) * HORIZON
    severity = LIMITS.severity(effect, abs(late.value) >= LIMITS.grave_lag)
    value = float(f"{late.value:.4g}")
    text = f"yaw {'lags' if value > 0.0 else 'leads'} yaw rate and positions by {size_of(late)} s"
    return earlier, [Finding("yaw_lag", severity, ("yaw",), text, late.value, "s", late.interval, (), effect,
                             Advice.correct("yaw", earlier=value))]


def _factors(coarse: list[Finding]) -> dict[str, float]:
    """Factors that correct_units() has divided by (of a yaw offset: the angle subtracted), by name of the finding."""
    found = {}
    for one in coarse:
        correct = one.advice.entry.get("correct", {}) if one.advice else {}
        scale = next((entry["scale"] for entry in correct.values() if "scale" in entry), None)
        if not correct and one.value:
            found[one.name] = one.value
        elif one.name == "yaw_offset":
            found[one.name] = -correct["yaw"]["add"]
        elif scale:
            found[one.name] = 1.0 / scale
    return found


def _once(coarse: list[Finding], fine: list[Finding], estimates: dict[str, Estimate]) -> list[Finding]:
    """Findings of units, signs and offsets with the values refined by the identities; a residual is part of it."""
    known, left = {one.name for one in coarse}, {one.name for one in fine}
    findings = []
    for one in coarse:
        found = estimates.get(one.name)
        if found is None:
            findings.append(one)
            continue
        advice = _of_all(one.advice, found.value) if one.advice and one.name in left else one.advice
        findings.append(replace(one, value=found.value, interval=found.interval, advice=advice))
    return findings + [one for one in fine if one.name not in known]


def _of_all(advice: Advice, value: float) -> Advice:
    """Correction by the whole value instead of the unit or offset alone."""
    (channel, (key,)), = advice.entry["correct"].items()
    return Advice.correct(channel, **{key: float(f"{1.0 / value if key == 'scale' else -value:.6g}")})


def _sensors(motion: Motion, before: dict[str, float]) -> Compared:
    """The identities that hold for any vehicle parameters."""
    shown = [position.identity(motion, before)]
    motion, findings = position.lateral_sign(motion)
    found, expected = inertial.yaw_rate(motion)
    motion, late = _late_yaw(motion, found)
    recorded = motion
    motion, causes, estimates = position.position(motion)
    if "wheel_speed" in motion.speeds and (wheel := inertial.speed(recorded, "wheel_speed")):
        motion, causes = position.scale_of_positions(motion, causes, estimates, wheel.scale)
    if found and found.carries_lag:
        estimates["yaw_lag"] = with_systematic("yaw_lag", found.lag.scaled(-1.0))
    findings += late + causes
    if late or any(one.name == "yaw_offset" for one in causes):
        found, expected = inertial.yaw_rate(motion)
    more, those = judged(found, expected, before.get("yaw_rate_scale", 1.0))
    findings += more
    estimates |= those
    if "yaw_offset" in estimates:
        estimates["yaw_offset"] = estimates["yaw_offset"].shifted(before.get("yaw_offset", 0.0))
    for name in ("velocity_scale", "velocity_x_scale", "position_scale"):
        fine = estimates.get("position_scale" if name == "position_scale" else "velocity_scale")
        if fine is not None:
            estimates[name] = fine.scaled(before.get(name, 1.0))
    if found and found.scale.value:  # a constant yaw rate has no scale
        scale = found.scale.inverse().scaled(before.get("yaw_scale", 1.0))
        estimates["yaw_scale"] = with_systematic("yaw_scale", scale)
    panel = identity(found, expected, "yaw rate: sensor against change of yaw", before.get("yaw_rate_scale", 1.0),
                     before.get("yaw_scale", before.get("yaw_convention", 1.0)))
    shown += [panel] if panel else []
    if found:
        motion = inertial.corrected_yaw_rate(motion, found)
    for more, values, panel in (*inertial.accelerations(motion), *inertial.speeds(motion)):
        findings += more
        estimates |= values
        shown += [panel] if panel else []
    return motion, findings, estimates, shown
