"""Checks for wrong units, signs and axes, which change a channel by more than any calibration error.

The change of yaw is estimated from yaw, integrated yaw rate and course over ground, and the outlier is wrong. Distance
is estimated from positions and from integrated velocity. The ratios of these estimates reveal the cause:

    yaw / course = f, yaw / rate = f, rate / course = 1      -> yaw is f times too large
    position / velocity = 1 / f, yaw / rate = 1 / f          -> the time stamps run f times as fast as true time
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from ..regression import SIGMA_PER_MAD
from . import inertial
from .finding import HORIZON, LIMITS, Advice, Alternative, Finding, Severity, find
from .motion import MIN_DISTANCE, MIN_WINDOWS, Motion, compute_ratios, correlate, is_driven, is_near
from .position import compute_scaled_misfit, correct_lateral_sign
from .regression import Estimate, Regression, add_systematic_uncertainty

MIN_YAW_RANGE = 0.2  # rad; minimum range of yaw in the drive
MAX_CONSISTENT_MISFIT = 0.02  # largest misfit of consistent positions, yaw and velocities, divided by the distance
MAX_SLOPE = 0.1  # largest slope of ordinary roads; an altitude changes by at most this fraction of the distance
MIN_AXIS_FRACTION = 0.3  # minimum median motion along an axis, divided by the distance, to check this axis alone
MAX_MAP_MISFIT = 0.1  # largest ratio of the misfit in map axes to the distance, and to the misfit in body axes
UNIT_TOLERANCE = 1.06  # factor by which a ratio may differ from the factor of its unit
COURSE_TOLERANCE = 1.2  # the same for a ratio to the course, which one short bend determines to within 10 %
MIN_YAW_OFFSET = 0.35  # rad; smaller angles are sideslip, or an offset that `position` estimates
MAX_SCALE_ERROR = 0.005  # largest relative scale error of a gyroscope or projection without a fault
MIN_RATE_ERROR = 0.005  # smallest reported relative error of the sampling rate; a crystal is accurate to 0.0001
CLEAR_MISFIT_RATIO = 0.8  # ratio of two misfits below which the smaller one is clearly better
TIE_MISFIT_RATIO = 0.97  # ratio of two misfits above which velocity_y is too small to determine its own unit
DEG_PER_RAD, GON_PER_RAD = 180.0 / np.pi, 200.0 / np.pi
ANGLE_UNITS = {DEG_PER_RAD: "degrees", GON_PER_RAD: "gon", 1000.0: "mrad"}  # names by number of units per SI unit
SPEED_UNITS = {3.6: "km/h", 2.23694: "mph", 1.94384: "knots"}
LENGTH_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 3.28084: "feet", 0.001: "kilometres"}
LENGTH_CHANNELS = ("x", "y", "velocity_x", "velocity_y")
MAX_DEGREE_RATIO = 1e-4  # ratio to the distance below which positions are angles: a degree of latitude is 111 km
TIME_UNITS = {1e3: ("milliseconds", "ms"), 1e6: ("microseconds", "us"), 1e9: ("nanoseconds", "ns")}
MIN_WRAP_STEP = 0.01  # rad; smallest step that counts as a wrap; a wrap by 360 deg, unwrapped as rad, leaves 1.86 deg
EXCHANGE_X_Y = {"x": "y", "y": "x"}  # columns of run.yaml
MIRROR, COMPASS_TO_YAW = {"scale": -1.0}, {"scale": -1.0, "add": np.pi / 2}  # corrections in run.yaml
MotionAndFinding = tuple[Motion, Finding | None]


def match_unit(factor: float, table: Mapping[float, Any] = SPEED_UNITS) -> float | None:
    """The factor in a table of units that is within UNIT_TOLERANCE of the given one, or None."""
    return next((known for known in table if is_near(factor, known, UNIT_TOLERANCE)), None)


def _matches(ratio: float, target: float) -> bool:
    """Whether a ratio differs from its target by less than a wrong unit, sign or axis would cause."""
    return is_near(ratio, target, LIMITS.unit_ratio)


def correct_units(motion: Motion) -> tuple[Motion, list[Finding]]:
    """(motion with units, signs and axes corrected, the findings). `check_time_unit` must be applied first."""
    findings: list[Finding] = []
    for step in (correct_length_unit, _correct_velocity_axes, _correct_rate_in_unit_of_yaw, _correct_north_east,
                 _correct_one_axis, _correct_yaw_or_rate, _correct_position_axes, _correct_distance,
                 _correct_velocity_axes, _correct_yaw_offset, correct_lateral_sign):
        motion, finding = step(motion)
        findings += [finding] if finding else []
    clockwise, offset = (find(findings, name) for name in ("yaw_convention", "yaw_offset"))
    if clockwise and clockwise.advice and offset and offset.advice:  # a clockwise yaw with another zero than north
        correct = {channel: {**values} for channel, values in clockwise.advice.entry["correct"].items()}
        correct["yaw"]["add"] += offset.advice.entry["correct"]["yaw"]["add"]
        text = f"{clockwise.text.partition(':')[0]}, but yaw 0 is not north; expected: yaw from east, counter-clockwise"
        merged = replace(clockwise, statement=text, advice=Advice.for_run_yaml({"correct": correct}))
        findings = [merged if finding is clockwise else finding for finding in findings if finding is not offset]
    return motion, findings


def _correct(motion: Motion, name: str, channels: tuple[str, ...], text: str, value: float | None, advice: Advice,
             unit: str = "1") -> tuple[Motion, Finding]:
    """(the motion with the correction in the advice applied, finding with the severity error)."""
    return motion.apply_entry(advice.entry), Finding(name, Severity.ERROR, channels, text, value, unit, advice=advice)


def check_time_unit(motion: Motion) -> MotionAndFinding:
    """Correct a wrong unit of time, such as milliseconds read as seconds, by comparison with positions and yaw."""
    spacing = float(np.median(np.diff(motion.time)))
    length = 50 * spacing if spacing > 0.2 or spacing <= 2e-4 else 1.0  # window length; 1 s at ordinary sampling rates
    ratios = compute_ratios(motion, length)
    known = [ratio for ratio in (ratios.position_to_speed, ratios.yaw_to_rate) if np.isfinite(ratio)]
    if not known or not all(r > 0 and not _matches(r, 1.0) and is_near(r, known[0]) for r in known):
        return motion, None
    factor = 1.0 / ratios.position_to_speed
    unit = match_unit(factor, TIME_UNITS)
    # A single ratio may also be due to the unit of velocity, so it must match a unit of time.
    if not unit and len(known) < 2:
        return motion, None
    question, advice = "", Advice("text", "check the clock that stamps the rows")
    if unit:
        factor, (name, symbol) = unit, TIME_UNITS[unit]
        question = f": is its unit {name}?"
        advice = Advice.for_run_yaml({"units": {"t": symbol}})
    text = f"time runs {factor:g} times as fast as positions imply{question}"
    return _correct(motion.with_time_divided(factor), "time_unit", ("time",), text, factor, advice)


def check_nominal_rate(findings: list[Finding], estimates: Mapping[str, Estimate]) -> Finding | None:
    """Finding about time stamps at a wrong nominal rate, if velocity and yaw rate are wrong by the same factor."""
    velocity, yaw_rate = (estimates.get(name) for name in ("velocity_scale", "yaw_rate_scale"))
    scale_finding = find(findings, "velocity_scale", "position_scale")
    if velocity is None or yaw_rate is None or scale_finding is None or yaw_rate.shifted(-1.0).covers(0.0):
        return None
    factor, difference = velocity.value, abs(velocity.value - yaw_rate.value)
    if abs(factor - 1.0) < MIN_RATE_ERROR or difference > float(
            np.hypot(np.hypot(velocity.half_width, yaw_rate.half_width), MAX_SCALE_ERROR)):
        return None
    text = (f"time runs {factor:.4f} ± {velocity.half_width:.4f} times as fast as positions and yaw imply: were the "
            "time stamps computed from a wrong nominal rate?")
    scale = float(f"{1.0 / factor:.5g}")
    advice = Advice.for_run_yaml({"correct": {"velocity": {"scale": scale}, "yaw_rate": {"scale": scale}}})
    advice = replace(advice, line=f"{advice.line}  # or divide the time of the rows by {factor:.4f}")
    return replace(scale_finding, name="time_rate", channels=("time",), statement=text, value=factor,
                   interval=velocity.interval, advice=advice)


def fits_better(corrected: Motion, motion: Motion) -> bool:
    """Whether positions agree clearly better with velocity and yaw in `corrected` than in `motion`."""
    return _compute_misfit(corrected) < CLEAR_MISFIT_RATIO * _compute_misfit(motion)


def _correct_rate_in_unit_of_yaw(motion: Motion) -> MotionAndFinding:
    """Correct a yaw rate in the same wrong unit as yaw, by comparison with the course; yaw is corrected later."""
    ratios = compute_ratios(motion)
    # Degrees and gon differ by less than the tolerance; a gyroscope in gon/s does not exist.
    size = (DEG_PER_RAD if is_near(abs(ratios.rate_to_course), DEG_PER_RAD, COURSE_TOLERANCE) else
            _round_to_angle_unit(ratios.rate_to_course, COURSE_TOLERANCE))
    if size in ANGLE_UNITS and _matches(abs(ratios.yaw_to_rate), 1.0) and _matches(abs(ratios.yaw_to_course), size):
        return _scale_yaw_rate(motion, ratios.rate_to_course, "the course of the positions", size)
    return motion, None


def _correct_yaw_or_rate(motion: Motion) -> MotionAndFinding:
    """Correct unit and sign of yaw or yaw rate, whichever disagrees with the other two estimates of the yaw change."""
    ratios = compute_ratios(motion)
    if not np.isfinite(ratios.yaw_to_rate) or _matches(ratios.yaw_to_rate, 1.0):
        return _correct_yaw_scale(motion, ratios.yaw_to_rate)
    rate_to_yaw = 1.0 / ratios.yaw_to_rate
    # The yaw rate is wrong if yaw agrees with positions, the rate is in deg/s, or it differs from both by one factor.
    if (_matches(ratios.yaw_to_course, 1.0) or _positions_follow_yaw(motion) or is_near(rate_to_yaw, DEG_PER_RAD)
            or _matches(ratios.rate_to_course, rate_to_yaw)):
        return _scale_yaw_rate(motion, rate_to_yaw)
    if (_matches(ratios.rate_to_course, -1.0) and not _matches(ratios.yaw_to_course, -1.0)
            and _matches(ratios.yaw_to_rate, -1.0)):
        return _scale_yaw_rate(motion, -1.0)
    factor, size = ratios.yaw_to_rate, _round_to_angle_unit(ratios.yaw_to_rate)
    unit = ANGLE_UNITS.get(size, "")
    if factor > 0.0 and not unit:
        return _scale_yaw(motion, factor)
    if factor > 0.0:
        name, advice = "yaw_scale", Advice.correct("yaw", scale=1.0 / size)
        text = f"yaw is {factor:.3g} times the angle from yaw rate and course: is its unit {unit}?"
    else:
        name, advice = "yaw_convention", Advice.correct("yaw", scale=-1.0 / size, add=np.pi / 2)
        text = (f"yaw increases clockwise{f' in {unit}' if unit else ''}: is it a compass heading? Expected: from "
                "east, counter-clockwise")
    corrected, finding = _correct(motion, name, ("yaw",), text, factor, advice)
    return _remove_wraps(corrected), finding


def _correct_yaw_scale(motion: Motion, ratio: float) -> MotionAndFinding:
    """Correct the scale of yaw if positions agree with the yaw rate. ratio: yaw / integrated yaw rate, near 1."""
    if not abs(ratio - 1.0) >= inertial.GYRO_SCALE_ERROR:
        return motion, None
    corrected, finding = _scale_yaw(motion, ratio)
    factor = finding.value or ratio
    low, high = finding.interval or (factor, factor)
    if low <= 1.0 <= high or abs(factor - ratio) > abs(factor - 1.0):
        return motion, None
    misfits = [compute_scaled_misfit(each, "yaw_offset") for each in (motion, corrected)]
    if not misfits[1] < CLEAR_MISFIT_RATIO * misfits[0] or (
            compute_scaled_misfit(motion, from_compass=True) < CLEAR_MISFIT_RATIO * misfits[1]):
        return motion, None
    effect = abs(factor - 1.0) * float(np.std(motion.yaw)) * float(np.median(motion.speed)) * HORIZON
    return corrected, replace(finding, severity=LIMITS.severity(effect), effect=effect)


def _scale_yaw(motion: Motion, ratio: float) -> tuple[Motion, Finding]:
    """Divide yaw by its scale, estimated near `ratio`, which is yaw / integrated yaw rate; the true yaw is the
    direction of travel minus the sideslip angle."""
    rescaled = _remove_wraps(replace(motion, yaw=motion.yaw / ratio))
    windows = rescaled.make_windows(1.0, 0.5)  # not empty, since `ratio` is from such windows
    product = windows.change(rescaled.position) * np.conj(windows.integral(rescaled.velocity_map))
    yaw = windows.mean(rescaled.yaw)
    error, weight = np.angle(product * np.conj(product.sum())), np.sqrt(np.abs(product))  # rad, m
    problem = Regression(windows.time, (weight * error)[:, None], {
        "scale": (weight * (yaw - yaw.mean()))[:, None], "offset": weight[:, None]})
    slope = problem.estimate(("scale", "offset"))["scale"]
    scale = add_systematic_uncertainty("yaw_scale", slope.shifted(1.0).inverse().scaled(ratio))
    corrected, finding = _correct(
        motion, "yaw_scale", ("yaw",), f"yaw is {scale} times its value from positions and velocities", scale.value,
        Advice.correct("yaw", scale=float(f"{1.0 / scale.value:.5g}")))
    return _remove_wraps(corrected), replace(finding, interval=scale.interval)


def _correct_north_east(motion: Motion) -> MotionAndFinding:
    """Correct positions with x to the north and y to the east, and a compass heading. They turn in the opposite
    direction to steering, acceleration_y and velocity_y; the yaw rate may have either sign."""
    ratios, votes = compute_ratios(motion), sum(_compare_signs(motion))
    if motion.geographic or not _matches(ratios.yaw_to_course, 1.0):
        return motion, None
    measured, derived = _compute_displacements(motion, motion.velocity_map)
    is_forward = np.sum(derived * np.conj(_direction(measured))).real > 0.0  # else velocity_x has the opposite sign
    if _matches(ratios.yaw_to_rate, 1.0) and votes == -2 and is_forward:
        text = ("x, y, yaw and yaw_rate turn in the opposite direction to acceleration_y and steering: x is north, "
                "y east and yaw a compass heading")
        correct = _add_mirrored_channels(motion, {"yaw": COMPASS_TO_YAW, "yaw_rate": MIRROR}, EXCHANGE_X_Y)
        alternatives = (Alternative("steering and acceleration_y are positive to the right",
                                    ("steering_sign", "acceleration_y_scale")),)  # the mirror image of the same drive
    elif _matches(ratios.yaw_to_rate, -1.0) and votes > _find_lateral_sign(motion):
        text = ("x, y and yaw turn in the opposite direction to yaw_rate and other channels: is x north, y east and "
                "yaw a compass heading? Expected: x east, y north, yaw from east, counter-clockwise")
        correct = {"yaw": COMPASS_TO_YAW}
        alternatives = (Alternative("yaw_rate and the other channels are positive to the right", ("yaw_rate_scale",)),)
    else:
        return motion, None
    corrected, finding = _correct(motion, "position_axes", ("x", "y", *correct), text, None,
                                  Advice.for_run_yaml({"columns": EXCHANGE_X_Y, "correct": correct}))
    return corrected, replace(finding, alternatives=alternatives)


def _add_mirrored_channels(motion: Motion, correct: Mapping[str, Any], columns: Mapping[str, str]) -> dict[str, Any]:
    """Corrections of mirrored axes, with those of velocity_y and acceleration_y if they are positive to the right."""
    corrected, mirrored = motion.apply_entry({"columns": columns, "correct": correct}), {**correct}
    if _find_lateral_sign(corrected) < 0:
        mirrored["velocity_y"] = MIRROR
    if _compare_signs(corrected)[1] < 0:
        mirrored["acceleration_y"] = MIRROR
    return mirrored


def _find_lateral_sign(motion: Motion) -> int:
    """1 if positions agree clearly better with velocity_y as given, -1 if with the opposite sign, else 0."""
    mirrored = replace(motion, velocity_y=-motion.velocity_y)
    return int(fits_better(motion, mirrored)) - int(fits_better(mirrored, motion))


def _compare_signs(motion: Motion) -> tuple[int, int]:
    """(steering, acceleration_y): 1 if the sign agrees with that of the yaw rate, -1 if it is opposite, else 0."""
    rate, speed, lateral = motion.yaw_rate, motion.velocity_x, motion.acceleration_y
    return (_find_common_sign(motion.steering_at_ins() * speed, rate),
            0 if lateral is None else _find_common_sign(lateral, rate * speed))


def _find_common_sign(values: np.ndarray, expected: np.ndarray) -> int:
    """Sign of the correlation of values and expected values; 0 if it is weak."""
    known = np.isfinite(values)
    correlation = correlate(values[known], expected[known]) if known.sum() >= 50 else 0.0
    return int(np.sign(correlation)) if abs(correlation) >= LIMITS.min_correlation else 0


def _positions_follow_yaw(motion: Motion) -> bool:
    """Whether positions agree with yaw and velocity, apart from a constant rotation and a scale of velocity."""
    windows = motion.make_windows(1.0)
    distance, integrated = np.abs(windows.change(motion.position)), windows.integral(motion.speed)
    if len(windows) < MIN_WINDOWS or not np.ptp(motion.yaw) > MIN_YAW_RANGE:
        return False
    factor = float(np.sum(distance) / max(np.sum(integrated), 1e-12))
    scaled = replace(motion, velocity_x=factor * motion.velocity_x, velocity_y=factor * motion.velocity_y)
    return _compute_misfit(scaled) < MAX_CONSISTENT_MISFIT * float(np.median(distance))


def _scale_yaw_rate(motion: Motion, factor: float, reference: str = "yaw", size: float = 0.0) -> tuple[Motion, Finding]:
    """Divide the yaw rate by a factor. size: exact magnitude of the factor; 0: from `_round_to_angle_unit`."""
    size = size or _round_to_angle_unit(factor)
    exact = float(np.copysign(size, factor))
    reason = (f": is its unit {ANGLE_UNITS[size].replace('degrees', 'deg')}/s?" if size in ANGLE_UNITS else
              ": it has the opposite sign (left is positive)" if exact == -1.0 else "")
    text = f"yaw_rate is {factor:.3g} times the rate of change of {reference}{reason}"
    return _correct(motion, "yaw_rate_scale", ("yaw_rate",), text, factor,
                    Advice.correct("yaw_rate", scale=1.0 / exact))


def _round_to_angle_unit(factor: float, tolerance: float = UNIT_TOLERANCE) -> float:
    """Magnitude of a factor, rounded to 1 or to the factor of an angle unit if it is near."""
    size = abs(factor)
    return min((unit for unit in (*ANGLE_UNITS, 1.0) if is_near(size, unit, tolerance)),
               key=lambda unit: abs(np.log(size / unit)), default=size)


def _remove_wraps(motion: Motion) -> Motion:
    """Replace the steps of yaw that remain from unwrapping another unit as rad; the yaw rate gives the true steps."""
    step = np.diff(motion.yaw)
    expected = np.diff(cumulative_trapezoid(motion.yaw_rate, motion.time, initial=0.0))
    error = np.abs(step - expected)
    wrapped = error > max(8.0 * SIGMA_PER_MAD * float(np.median(error)), MIN_WRAP_STEP)
    return replace(motion, yaw=motion.yaw[0] + np.append(0.0, np.cumsum(np.where(wrapped, expected, step))))


def _correct_position_axes(motion: Motion) -> MotionAndFinding:
    """If yaw and yaw rate agree: correct mirrored or exchanged x and y, or a clockwise yaw and yaw rate."""
    ratios = compute_ratios(motion)
    if not (_matches(ratios.yaw_to_course, -1.0) and _matches(ratios.yaw_to_rate, 1.0)):
        return motion, None
    measured, derived = _compute_displacements(motion, motion.velocity_map)
    quarter = int(np.round(np.angle(np.sum(_direction(measured) * derived)) / (np.pi / 2))) % 4
    # x and y from longitude and latitude can be mirrored (even quarter), but not exchanged.
    signs = _compare_signs(motion)
    if quarter % 2 and (motion.geographic or signs[0] < 0 or sum(signs) < 0):
        correct = _add_mirrored_channels(motion, {"yaw": COMPASS_TO_YAW, "yaw_rate": MIRROR}, {})
        *others, last = correct
        text = (f"{', '.join(others)} and {last} are positive clockwise or to the right: is yaw a compass heading from "
                "north, and does the z axis of the INS point down? Expected: left positive, yaw from east")
        return _correct(motion, "yaw_convention", (*correct,), text, ratios.yaw_to_course,
                        Advice.for_run_yaml({"correct": correct}))
    axes: dict[int, tuple[str, dict[str, Any]]] = {
        0: ("y is mirrored (it should increase to the north)", {"correct": {"y": MIRROR}}),
        1: ("x and y are exchanged (x should be east, y north)", {"columns": EXCHANGE_X_Y}),
        2: ("x is mirrored (it should increase to the east)", {"correct": {"x": MIRROR}}),
        3: ("x and y are exchanged and mirrored", {"columns": EXCHANGE_X_Y, "correct": {"x": MIRROR, "y": MIRROR}}),
    }
    text, entry = axes[quarter]
    return _correct(motion, "position_axes", ("x", "y"),
                    f"the track turns in the opposite direction to yaw: {text}", None, Advice.for_run_yaml(entry))


def _correct_one_axis(motion: Motion) -> MotionAndFinding:
    measured, derived = _compute_displacements(motion, motion.velocity_map)
    scales = []
    for along_measured, along_derived in ((measured.real, derived.real), (measured.imag, derived.imag)):
        moves = np.abs(along_derived) >= MIN_DISTANCE  # elsewhere, noise of the positions dominates
        if moves.sum() < MIN_WINDOWS:
            return motion, None
        scales.append(float(np.sum(along_measured[moves] * along_derived[moves]) / np.sum(along_derived[moves]**2)))
    wrong, common = [not _matches(scale, 1.0) for scale in scales], compute_ratios(motion).position_to_speed
    max_misfit = MAX_CONSISTENT_MISFIT * float(np.median(np.abs(derived)))  # below it, all agree except for a rotation
    if sum(wrong) != 1 or not np.isfinite(common) or _compute_misfit(motion) < max_misfit:
        return motion, None
    k = wrong.index(True)
    axis, other, scale = ("x", "y")[k], ("y", "x")[k], scales[k]
    if scale > 0.0:
        text = f"{axis}, unlike {other}, is {scale:.4g} times the integrated velocity"
        corrected, finding = _correct(motion, f"{axis}_scale", (axis,), text, scale,
                                      Advice.correct(axis, scale=float(f"{1.0 / scale:.5g}")))
        both = motion.apply_entry({"correct": {"position": {"scale": 1.0 / common}}})
        if _compute_misfit(corrected) < max_misfit and fits_better(corrected, both):
            return corrected, finding
    distance = np.maximum(np.abs(derived), MIN_DISTANCE)
    slope, expected = (float(np.median(np.abs((d.real, d.imag)[k]) / distance)) for d in (measured, derived))
    if not 0.0 < slope < MAX_SLOPE or expected < MIN_AXIS_FRACTION:
        return motion, None
    text = f"{axis}, unlike {other}, does not follow velocity and yaw: is it the altitude, or another signal?"
    derived_position = cumulative_trapezoid(motion.velocity_map, motion.time, initial=0.0)
    replaced = replace(motion, **{axis: (derived_position.real, derived_position.imag)[k]})
    advice = Advice("text", "record x to the east and y to the north")
    return _correct(replaced, "position_axes", (axis,), text, None, advice)


def correct_length_unit(motion: Motion) -> MotionAndFinding:
    """Correct positions and velocities in the same wrong unit of length, by comparison with the accelerations."""
    ratio = compute_ratios(motion).position_to_speed  # NaN for kilometres, in which all motion seems too small
    is_consistent = not np.isfinite(ratio) or _matches(ratio, 1.0)
    scales = np.array([s.value for s in inertial.compute_acceleration_scales(motion)] if is_consistent else [])
    if not len(scales) or not (scales > 0.0).all():
        return motion, None
    scale = float(np.exp(np.log(scales).mean()))
    unit = next((unit for unit in LENGTH_UNITS if is_near(scale, 1.0 / unit, 1.0 + inertial.ACCELERATION_SCALE_ERROR)
                 and (unit < 1.0) != np.isfinite(ratio)), None)
    if unit is None or not all(is_near(each, 1.0 / unit, LIMITS.channel_unit_ratio) for each in scales.tolist()):
        return motion, None
    text = (f"accelerations are {scale:.4g} times the derivative of velocity: do positions and "
            f"velocities use {LENGTH_UNITS[unit]}?")
    advice = Advice.for_run_yaml({"correct": {name: {"scale": 1.0 / unit} for name in ("position", "velocity")}})
    corrected, finding = _correct(motion, "position_scale", LENGTH_CHANNELS, text, unit, advice)
    return (corrected, finding) if is_driven(corrected) else (motion, None)  # else the accelerations have another unit


def _correct_distance(motion: Motion) -> MotionAndFinding:
    ratio, windows = compute_ratios(motion).position_to_speed, motion.make_windows(1.0)
    if not np.isfinite(ratio) or _matches(ratio, 1.0) or not all(  # on a dynamometer or a ferry, one is noise
            windows.are_coherent(displacements) for displacements in _compute_displacements(motion, motion.velocity)):
        return motion, None
    speed, length, velocity_ratio = match_unit(1.0 / ratio), match_unit(ratio, LENGTH_UNITS), 1.0 / ratio
    text = f"x and y are {ratio:.4g} times the integrated velocity"
    if length and not speed:
        advice = Advice.correct("position", scale=1.0 / length)
        return _correct(motion, "position_scale", ("x", "y"), f"{text}: is their unit {LENGTH_UNITS[length]}?", ratio,
                        advice)
    if not speed and ratio < MAX_DEGREE_RATIO:
        metres = replace(motion, x=motion.x / ratio, y=motion.y / ratio)
        return _correct(metres, "position_scale", ("x", "y"), f"{text}: are they latitude and longitude? Metres are "
                        "expected", ratio, Advice("text", "project latitude and longitude to east and north"))
    # The speed of the wheels may be in the same wrong unit.
    evidence = replace(motion, speeds={}) if speed else motion
    if confirmed_by := inertial.confirm_velocity(evidence, velocity_ratio):
        return _correct(motion, "position_scale", ("x", "y"), f"{text}, which agrees with {confirmed_by}", ratio,
                        Advice.correct("position", scale=float(f"{velocity_ratio:.5g}")))
    scale = 1.0 / (speed or velocity_ratio)
    both, forward = (Advice.correct(channel, scale=scale) for channel in ("velocity", "velocity_x"))
    misfit_both, misfit_forward = (_compute_misfit(motion.apply_entry(advice.entry)) for advice in (both, forward))
    unit = f": is the unit {SPEED_UNITS[speed]}?" if speed else ""
    if misfit_forward < TIE_MISFIT_RATIO * misfit_both:
        text = f"velocity_x is {velocity_ratio:.3g} times the rate of change of positions{unit}"
        return _correct(motion, "velocity_x_scale", ("velocity_x",), text, velocity_ratio, forward)
    text = f"velocity_x and velocity_y are {velocity_ratio:.3g} times the rate of change of positions{unit}"
    return _correct(motion, "velocity_scale", ("velocity_x", "velocity_y"), text, velocity_ratio, both)


def _direction(displacements: np.ndarray) -> np.ndarray:
    """Unit vectors, in which a jump of the positions has no more weight than other displacements; 0 at rest. np.sign of
    numpy 1, which ROS 2 Jazzy contains, returns the sign of the real part instead."""
    return displacements / np.maximum(np.abs(displacements), 1e-300)


def _compute_displacements(motion: Motion, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(change of position, integrated velocity) in windows of one second, as east + i north [m]."""
    windows = motion.make_windows(1.0)
    return windows.change(motion.position), windows.integral(velocity)


def _compute_misfit(motion: Motion, rotated: bool = True) -> float:
    """Median [m] of |change of position - integrated velocity| per second; rotated: after the best common rotation."""
    measured, derived = _compute_displacements(motion, motion.velocity_map)
    if not len(measured):
        return 0.0
    rotation = np.sum(_direction(measured) * np.conj(derived)) if rotated else 1.0
    return float(np.median(np.abs(measured - derived * rotation / max(abs(rotation), 1e-300))))


def _correct_velocity_axes(motion: Motion) -> MotionAndFinding:
    """Correct velocities along the map axes, exchanged velocities, or a yaw that refers to another axis."""
    measured, unrotated = _compute_displacements(motion, motion.velocity)
    if len(measured) < MIN_WINDOWS:
        return motion, None
    # In the map frame, velocity_x is the velocity to the east, or to the north.
    east_misfit, north_misfit = (float(np.median(np.abs(measured - v))) for v in (unrotated, 1j * unrotated.conj()))
    misfit, is_north_first = min(east_misfit, north_misfit), north_misfit < east_misfit
    exchange = Advice.for_run_yaml({"columns": {"velocity_x": "velocity_y", "velocity_y": "velocity_x"}})
    exchanged = motion.apply_entry(exchange.entry)
    max_misfit = MAX_MAP_MISFIT * float(np.median(np.abs(measured)))
    # In bends, tyres may slide: in a donut, a car moves sideways.
    lateral_acceleration = np.abs(unrotated * motion.make_windows(1.0).change(motion.yaw))
    straight = unrotated[lateral_acceleration < LIMITS.sliding_acceleration]
    if np.ptp(motion.yaw) > MIN_YAW_RANGE and misfit <= max_misfit and (
            misfit < MAX_MAP_MISFIT * _compute_misfit(motion)) and _matches(compute_ratios(motion).yaw_to_course, 1.0):
        velocity = 1j * motion.velocity.conj() if is_north_first else motion.velocity
        body = velocity * np.exp(-1j * motion.yaw)
        east_north = ("velocity_y", "velocity_x") if is_north_first else ("velocity_x", "velocity_y")
        text = (f"velocity_x and velocity_y are in the map frame, along {'y and x' if is_north_first else 'x and y'}: "
                "the body frame is expected")
        advice = Advice("text", "rotate them by yaw: forward = cos(yaw) {0} + sin(yaw) {1}, "
                        "lateral = cos(yaw) {1} - sin(yaw) {0}".format(*east_north))
        corrected = replace(motion, velocity_x=body.real, velocity_y=body.imag)
    elif max_misfit > 0.0 and motion.moves_sideways and _compute_misfit(exchanged, rotated=False) <= max_misfit:
        corrected, advice = exchanged, exchange
        text = "velocity_x and velocity_y are exchanged (x should be forward, y left)"
    elif max_misfit > 0.0 and np.square(straight).sum().real < 0.0 and (  # more sideways than forward
            _compute_misfit(motion, rotated=False) <= max_misfit):
        angle = float(np.angle(straight.sum()))
        quarter = float(np.copysign(np.pi / 2, angle))
        angle = quarter if abs(angle - quarter) < 0.1 else angle
        side = "left" if angle > 0 else "right"
        text = (f"velocity and track point {abs(angle) * DEG_PER_RAD:.0f} deg to the {side} of yaw: does yaw "
                "refer to an axis other than forward, or is it measured from north?")
        advice, channels = Advice.correct("heading", add=angle), dict[str, Any](yaw=motion.yaw + angle)
        for x, y in (("velocity_x", "velocity_y"), ("acceleration_x", "acceleration_y")):
            if (forward := getattr(motion, x)) is not None and (lateral := getattr(motion, y)) is not None:
                body = (forward + 1j * lateral) * np.exp(-1j * angle)
                channels |= {x: body.real, y: body.imag}
        corrected = replace(motion, **channels)
    else:
        return motion, None
    return corrected, Finding("velocity_axes", Severity.ERROR, ("velocity_x", "velocity_y"), text, advice=advice)


def _correct_yaw_offset(motion: Motion) -> MotionAndFinding:
    """Correct a yaw measured from a wrong axis, or a reversed yaw or velocity_x, by the direction of travel."""
    measured, derived = _compute_displacements(motion, motion.velocity_map)
    turned = derived * np.conj(_direction(measured))
    total, size = turned.sum(), float(np.abs(turned).sum())
    angle = float(np.angle(total))
    if len(measured) < MIN_WINDOWS or size < MIN_DISTANCE or abs(total) < 0.5 * size or abs(angle) < MIN_YAW_OFFSET:
        return motion, None
    quarter = np.round(angle / (np.pi / 2)) * np.pi / 2
    if abs(quarter) == np.pi:
        advice = Advice.correct("velocity_x", scale=-1.0)
        # If velocity_x > 0, the whole drive would be in reverse: assumed only if velocity_y agrees clearly better.
        if np.median(motion.velocity_x) < 0.0 or fits_better(motion.apply_entry(advice.entry), motion):
            return _correct(motion, "velocity_x_scale", ("velocity_x",),
                            "velocity_x has the opposite sign (forward is positive)", -1.0, advice)
    exact = float(quarter if abs(angle - quarter) < 0.1 else angle)
    questions: dict[float, str] = {  # by quarter turns
        1.0: ": is it measured from south?", -1.0: ": is it measured from north?",
        2.0: ": does it point backwards?", -2.0: ": does it point backwards?"}
    question = questions.get(round(exact / (np.pi / 2), 3), "")
    text = f"yaw differs by {angle:+.2f} rad ({angle * DEG_PER_RAD:+.0f} deg) from the direction of travel{question}"
    return _correct(motion, "yaw_offset", ("yaw",), text, angle, Advice.correct("yaw", add=-exact), "rad")
