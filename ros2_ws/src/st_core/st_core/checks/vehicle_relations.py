"""Checks of a recording against the vehicle file, with limits that differences between cars rarely exceed.

Steering: the road wheel angle of a car without slip is atan(L r / v_x). Errors of ratio and wheelbase change it by
about 10 %, strong understeer at 20 m/s makes it 3 times as large, and degrees read as radians 57 times.

Rear axle: at low speed it moves in the direction of the heading, so the lateral velocity at the INS point is

    v_y = -a v_x + d r - s v_x^2 r - e d(v_x r)/dt

a: misalignment [rad], > 0 if the heading points too far left; d: distance of the point ahead of the rear axle [m];
s, e: slip of the rear axle [rad s^2/m] and lateral shift of the point by body roll [s^2] per lateral acceleration.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ..handling import UNDERSTEER, linear_system, rear_slip_coefficient, stability_factor
from ..tyres import GRAVITY
from ..vehicle import VEHICLE_QUANTITIES, VehicleParameters
from .finding import HORIZON, LIMITS, SYSTEMATIC_UNCERTAINTY, Advice, Alternative, Comparison, Finding, Severity
from .inertial import MAX_LAG, MIN_COMMON_TIME, NOT_FITTED, Agreement, Results, compare_series, format_alternative_lags
from .motion import MAX_LISTED_TIMES, MIN_MOVING_SPEED, Motion, correlate, has_varying_speed, is_near
from .position import MIN_LOSS_RATIO, OPPOSITE_SIGN_FINDING
from .regression import Estimate, Regression, add_systematic_uncertainty
from .units_and_axes import DEG_PER_RAD

CUTOFF = 1.5  # Hz, of the low-pass filter
MIN_SPEED, MAX_LATERAL_ACCELERATION = 2.0, 4.0  # m/s, m/s^2; limits of driving with linear rear slip
WINDOW, STANDSTILL_WINDOW = 0.5, 2.0  # s, lengths of the windows
MIN_REAR_AXLE_WINDOWS = 30
SLIDE_MARGIN = 2.0  # s before and after a slide that are not used either: it begins and ends gradually
MAX_BENCH_MOTION = 0.5  # m per window; slack of the straps on a chassis dynamometer, and noise of positions
MIN_CARRIED_WINDOWS = 5  # 10 s; minimum number of windows in which the car is carried, since positions may jump
SLIP_RANGE = 0.5, 1.5  # plausible rear slip, as a fraction of that of the vehicle file
MAX_BANK = 0.08  # rad; largest bank of a road; design guides limit the superelevation to 7 or 8 %
BANK = Alternative("the road is banked")
BOTH_DIRECTIONS = Advice("text", "drive the road in both directions to distinguish the two")
MAX_COSINE = 0.9  # cosine similarity of speed and yaw rate; 1 on a circle, which confounds misalignment and INS point
MIN_STEERING_ANGLE = 0.01  # rad; minimum root mean square of the angles for an estimate of the steering gain
MIN_ANGLE_FOR_SIGN = 0.003  # rad; the same for an estimate of its sign alone; fast, wide bends suffice
MAX_OPPOSITE_CORRELATION = -0.8  # correlation of steering and curvature below which the steering has the opposite sign
MIN_UNRELATED_SPREAD = 0.01  # rad at the road wheels; minimum standard deviation of measured and derived steering
STEERING_PLAY = 0.07  # rad of the steering wheel; play of ordinary cars, which reduces the gain of small angles
MIRRORED = Alternative("do x, y, yaw and all lateral channels have axes with z down (x north, y east, right positive)",
                       ("position_axes",))
UNSIGNED = Alternative("is the steering recorded without a sign, in a drive of right turns only")
PLAY, STEERED_REAR_WHEELS = Alternative("the steering has play"), Alternative("the rear wheels also steer")
REVERSED_INS = Alternative("the INS points backwards"), Advice("text", "check the forward axis of the INS")
TIGHTER_BENDS = Advice("text", "drive tighter bends to distinguish the two")
CHECK_RATIO = Advice("text", "drive tighter bends, and check steering_ratio and wheelbase in the vehicle file")
MIN_FOUR_WHEEL_GAIN = 0.5  # smallest gain with rear-wheel steering: rear angle opposite and equal to the front angle
MIN_GAIN = 1e-6  # ratio of measured to derived angle below which the steering is constant: `channel_frozen` reports it


def check_steering(results: Results, motion: Motion, vehicle: VehicleParameters, from_steering_wheel: bool) -> None:
    """Compare steering with curvature. from_steering_wheel: whether a steering wheel angle was recorded."""
    derived, speeds = _derive_angle(motion, vehicle), np.abs(motion.velocity_x)
    speed = float(np.median(speeds[np.isfinite(derived)])) if np.isfinite(derived).any() else MIN_SPEED
    response = compute_response_time(vehicle, speed)
    agreement, gain = _compare_angles(motion, derived, response), _estimate_steering_gain(motion, derived)
    # Understeer with the stability factor K multiplies the steering angle by 1 + K v^2. The mean of this factor,
    # weighted with the squared angle, is computed for K of the vehicle file (0 or more) and for the largest K of cars.
    weight, expected = np.square(np.nan_to_num(derived)), max(stability_factor(vehicle), 0.0)
    mean_square = float(np.average(motion.velocity_x**2, weights=weight)) if weight.any() else 0.0
    largest = max(expected, UNDERSTEER.high / DEG_PER_RAD / (vehicle.wheelbase * GRAVITY))
    plausible_gains = 1.0 + expected * mean_square, 1.0 + largest * mean_square
    if agreement is None or not agreement.correlates:
        results.findings += filter(None, [_make_unrelated_finding(motion, derived) or _make_unit_finding(
            gain, plausible_gains, vehicle, from_steering_wheel, motion)])
        return
    # In one long bend, gain and offset are confounded; in a slalom, the opposite sign and a lag of half a period.
    if gain is not None and (agreement.scale.standard_error > 0.2 * abs(agreement.scale.value)
                             or agreement.correlation_without_lag < MAX_OPPOSITE_CORRELATION < agreement.correlation
                             or abs(float(agreement.derived.mean())) > agreement.spread):
        agreement = replace(agreement, scale=gain, bias=NOT_FITTED)
    gain = add_systematic_uncertainty("steering_scale", agreement.scale)
    lag = add_systematic_uncertainty(
        "steering_lag", agreement.lag.shifted(response).widened(_compute_response_uncertainty(vehicle, speed)))
    # Lateral shift of the predicted position after HORIZON per constant error of the road wheel angle [m/rad].
    a, b = linear_system(max(speed, MIN_MOVING_SPEED), vehicle)
    lateral_shift = abs(0.5 * speed * float(np.linalg.solve(a, b).ravel()[1])) * HORIZON**2
    # If correlation and gain differ in sign, the driver countersteers (crosswind, bank), and the lag is undetermined.
    same_sign = agreement.correlation * gain.value >= 0.0
    clock = _check_clock(motion, vehicle, agreement, derived, response, lateral_shift) if same_sign else None
    has_lag = same_sign and clock is None
    unit = _make_unit_finding(gain, plausible_gains, vehicle, from_steering_wheel, motion, agreement.spread)
    correction = unit.advice.entry.get("correct", {}).get("road_wheel_angle", {}) if unit and unit.advice else {}
    results.findings += filter(None, (
        unit, clock, _make_lag_finding(lag, agreement, response, lateral_shift) if has_lag else None,
        _make_offset_finding(agreement, vehicle, from_steering_wheel, lateral_shift, **correction)))
    results.estimates |= {"steering_scale": gain, "steering_sign": gain,
                          "steering_offset": add_systematic_uncertainty("steering_offset", agreement.bias)}
    results.estimates |= {"steering_lag": lag} if has_lag and agreement.determines_lag else {}
    results.panels.append(Comparison(
        "steering", "road wheel angle: steering sensor versus curvature", "rad", "road_wheel_angle",
        "from yaw rate and speed", agreement.time, agreement.measured, agreement.derived,
        ("steering_scale", "steering_sign", "steering_lag", "steering_offset")))


def _derive_angle(motion: Motion, vehicle: VehicleParameters) -> np.ndarray:
    """Road wheel angle of a car without slip, from its curvature, also in reverse [rad]; NaN below MIN_SPEED, and where
    the rear axle slides, so that the driver countersteers."""
    usable = (np.abs(motion.velocity_x) > MIN_SPEED) & ~_find_slides(motion, vehicle)
    return np.arctan(vehicle.wheelbase * motion.yaw_rate / np.where(usable, motion.velocity_x, np.nan))


def _find_slides(motion: Motion, vehicle: VehicleParameters) -> np.ndarray:
    """Whether the rear axle slides within SLIDE_MARGIN of each INS sample, (n,); False without velocity_y. The angle on
    straights is that of a misaligned INS."""
    lateral = motion.velocity_y - (vehicle.cg_to_rear_axle + vehicle.cg_to_ins_x) * motion.yaw_rate
    slip = np.arctan(lateral / np.maximum(np.abs(motion.velocity_x), MIN_SPEED))
    windows = motion.make_windows(HORIZON)
    straight = windows.mean(np.abs(motion.velocity_x * motion.yaw_rate)) < LIMITS.sliding_acceleration
    slip -= float(np.median(windows.mean(slip)[straight])) if straight.any() else 0.0
    times = motion.time[(np.abs(slip) > LIMITS.rear_slip) & bool(motion.velocity_y.any())]
    first, end = (np.searchsorted(times, motion.time + side * SLIDE_MARGIN) for side in (-1.0, 1.0))
    return end > first


def _compare_angles(motion: Motion, derived: np.ndarray, response: float,
                    rows: slice | np.ndarray = slice(None)) -> Agreement | None:
    """Agreement of the steering with the angle derived from motion, in the given rows. response: response time [s]."""
    return compare_series(motion.time[rows], derived[rows], motion.steering_time, motion.steering, CUTOFF,
                          fit_drift=True, expected_lag=-response, max_fitted_lag=2.0 * MAX_LAG)


def _make_unrelated_finding(motion: Motion, derived: np.ndarray) -> Finding | None:
    """Finding about steering not correlated with curvature; None if correlated, almost constant or too short."""
    angle = motion.steering_at_ins()
    known = np.isfinite(derived) & np.isfinite(angle)
    if known.sum() < 2 or known.mean() * np.ptp(motion.time) < MIN_COMMON_TIME or (
            min(np.std(angle[known]), np.std(derived[known])) <= MIN_UNRELATED_SPREAD):
        return None
    correlation = correlate(angle[known], derived[known])
    if abs(correlation) >= LIMITS.min_correlation:
        return None
    text = (f"the steering does not follow the car's motion (correlation {correlation:.2f}): is it a different signal, "
            f"from a different drive, or time-stamped more than {MAX_LAG:g} s too early or too late, or does its sign "
            "change during the drive, or do the tyres slide?")
    advice = Advice("text", "compare steering and yaw rate over time; predictions with this steering are invalid")
    return Finding("steering_unrelated", Severity.WARNING, ("road_wheel_angle",), text, correlation, advice=advice)


def _estimate_steering_gain(motion: Motion, derived: np.ndarray) -> Estimate | None:
    """Ratio of the measured road wheel angle to the angle derived from curvature, fitted without an offset; None if the
    car hardly turns. Smaller angles suffice for a negative gain, since only its sign is reported."""
    angle = motion.steering_at_ins()
    known = np.flatnonzero(np.isfinite(derived) & np.isfinite(angle))[::10]
    rms = float(np.sqrt(np.mean(derived[known] ** 2))) if len(known) >= 50 else 0.0
    determines_sign = rms > MIN_ANGLE_FOR_SIGN and correlate(derived[known], angle[known]) < MAX_OPPOSITE_CORRELATION
    if rms < MIN_STEERING_ANGLE and not determines_sign:
        return None
    problem = Regression(motion.time[known], angle[known, None], {"scale": derived[known, None]})
    return problem.estimate(("scale",))["scale"]


def compute_response_time(vehicle: VehicleParameters, speed: float) -> float:
    """Delay of the yaw rate of the linear model for slow steering [s]: the group delay at frequency 0.

        tau = -d(arg H)/d(omega),   H = c (i omega - A)^-1 b:   tau = -(c A^-2 b) / (c A^-1 b)
    """
    a, b = linear_system(speed, vehicle)
    solution = np.linalg.solve(a, b)  # A^-1 b
    return float(np.linalg.solve(a, solution).ravel()[1] / -solution.ravel()[1])


def _compute_response_uncertainty(vehicle: VehicleParameters, speed: float) -> float:
    """Uncertainty of `compute_response_time` [s] due to both axle stiffnesses, as half-width of a 95 % interval.
    Returns the part beyond the systematic uncertainty of a steering lag: > 0 for fast cars that hardly understeer, inf
    for a car that may be unstable, for which the delay is undefined."""
    changes = []
    for key in ("cornering_stiffness_front", "cornering_stiffness_rear"):
        value = getattr(vehicle, key)
        factor = float(np.exp((vehicle.uncertainty(key) or 0.0) / value))
        cars = [replace(vehicle, **dict[str, Any]({key: VEHICLE_QUANTITIES[key].clip(end)}))
                for end in (value / factor, value * factor)]
        if any(np.linalg.det(linear_system(speed, car)[0]) <= 0.0 for car in cars):
            return np.inf
        low, high = (compute_response_time(car, speed) for car in cars)
        changes.append(high - low)
    return float(np.sqrt(max(np.square(changes).sum() - SYSTEMATIC_UNCERTAINTY["steering_lag"] ** 2, 0.0)))


def _make_unit_finding(gain: Estimate | None, plausible_gains: tuple[float, float], vehicle: VehicleParameters,
                       from_steering_wheel: bool, motion: Motion, spread: float = 0.0) -> Finding | None:
    """Finding about an implausible steering gain, with the wrong unit or sign that explains it; None if plausible.

    plausible_gains: the expected and the largest one; 1 is plausible too, since stiffnesses may be inaccurate.
    motion: unless its positions are certain to be east and north, all INS channels may be mirrored instead, and the
    correction of the steering is valid in both cases; with a negative velocity, the INS may point backwards instead.
    spread: standard deviation of the derived angle [rad], 0 if unknown. Play, which reduces every turn of the steering
    by its width, or steered rear wheels may explain a gain below 1 that no unit matches."""
    (expected, largest), limit = plausible_gains, LIMITS.steering_unit_ratio
    if gain is None or abs(gain.value) < MIN_GAIN or (
            gain.interval[1] > 1.0 / limit and gain.interval[0] < limit * largest):
        return None
    value, ratio, offset = gain.value, vehicle.steering_ratio, vehicle.steering_wheel_offset
    source = f"steering ratio {ratio:g} of the vehicle file"
    reasons = {DEG_PER_RAD: "is it in degrees", ratio: f"is it the angle of the steering wheel ({source})",
               DEG_PER_RAD * ratio: f"is it the angle of the steering wheel in degrees ({source})",
               1.0 / DEG_PER_RAD: "was it converted to rad twice",
               1.0 / ratio: "was it divided by the steering ratio twice", 1.0: ""}
    size = abs(value) / expected
    # Without the factors that are too near to 1, such as the steering ratio 1.2 of a kart.
    distinct = [factor for factor in reasons if factor == 1.0 or not is_near(factor, 1.0, limit)]
    nearest = min(distinct, key=lambda factor: abs(np.log(size / factor)))
    exact = nearest if 1.0 / limit < size / nearest < limit else size
    opposite = "does it have the opposite sign (left is positive)" if value < 0.0 else ""
    reason = " and ".join(filter(None, (reasons.get(exact, ""), opposite)))
    text = f"road_wheel_angle is {value:.3g} times the angle from yaw rate and speed: {reason}?".removesuffix(": ?")
    scale = float(f"{1.0 / np.copysign(exact, value):.6g}")
    # The offset was subtracted before scaling: `add` undoes this and, unless the ratio was applied twice, subtracts it.
    add = float(f"{(scale - (exact != 1.0 / ratio)) * offset / ratio:.5g}")
    has_offset = from_steering_wheel and reason and add
    advice = Advice.correct("road_wheel_angle", scale=scale, **({"add": add} if has_offset else {}))
    name = "steering_scale"
    if exact == 1.0:
        name = "steering_sign"
        advice = replace(advice, line=f"{advice.line}  # or, for CAN logs, the opposite steering_sign in car.yaml")
    others = (MIRRORED,) * (not motion.geographic) + (UNSIGNED,) * bool(motion.steering.min() >= 0.0)
    finding = Finding(name, Severity.ERROR, ("road_wheel_angle",), text, value, "1", gain.interval, advice=advice,
                      alternatives=others if exact == 1.0 else ())
    if value < 0.0 and np.median(motion.velocity_x) < 0.0:
        return finding.with_alternative(*REVERSED_INS)
    may_be_play = 0.0 < (1.0 - value) * spread < 0.5 * STEERING_PLAY / ratio
    causes = [PLAY] * may_be_play + [STEERED_REAR_WHEELS] * (gain.interval[1] >= MIN_FOUR_WHEEL_GAIN and value < 1.0)
    for alternative in causes if not reason else ():
        finding = finding.with_alternative(alternative, CHECK_RATIO)
    return finding


def _check_clock(motion: Motion, vehicle: VehicleParameters, agreement: Agreement, derived: np.ndarray,
                 response: float, lateral_shift: float) -> Finding | None:
    """Finding about a steering lag that changes by LIMITS.steering_lag or more, unexplained by the response time; None
    if the lag is constant in both halves of the drive, which contradicts a steady change. derived, response: see
    `_compare_angles`."""
    drift, change = agreement.drift, agreement.drift.scaled(float(np.ptp(agreement.time)))  # 1, s
    first, second = (compute_response_time(vehicle, max(float(np.median(half)), MIN_SPEED))
                     for half in np.array_split(np.abs(motion.velocity_x), 2))
    if abs(change.value) < LIMITS.steering_lag or not add_systematic_uncertainty(
            "steering_lag", change).widened(abs(second - first)).is_significant:
        return None
    contradictions = 0  # number of halves with a constant lag, which contradicts the drift of the whole drive
    for rows in np.array_split(np.arange(len(motion.time)), 2):
        if (half := _compare_angles(motion, derived, response, rows)) is not None:
            duration = float(np.ptp(half.time))
            half_change = add_systematic_uncertainty("steering_lag", half.drift.scaled(duration))
            difference = half_change.shifted(-duration * drift.value).widened(duration * drift.half_width)
            contradictions += difference.is_significant and not half_change.is_significant
    if contradictions == 2:
        return None
    rate = drift.shifted(1.0)
    effect = lateral_shift * abs(change.value) * float(np.std(agreement.derived)) * np.sqrt(2.0) / HORIZON
    text = (f"the clock of the steering runs {rate} times as fast as that of the motion: the lag changes by {change} s "
            "during the drive")
    return _make_finding("time_rate", ("road_wheel_angle",), text, rate, "1", effect,
                         Advice("text", "time-stamp the steering and the motion with one clock"))


def steering_confirms_length(motion: Motion, vehicle: VehicleParameters, unit: float) -> bool:
    """Whether the measured steering angle fits positions and velocity in metres better than in another unit of length.
    unit: number of these units in a metre."""
    gain = _estimate_steering_gain(motion, _derive_angle(motion, vehicle))
    return gain is not None and gain.value > 0.0 and abs(np.log(gain.value)) < 0.5 * abs(np.log(unit))


def _make_lag_finding(lag: Estimate, agreement: Agreement, response: float, lateral_shift: float) -> Finding | None:
    """Finding about a lag beyond the response time [s] of the car; None if small or insignificant."""
    if not lag.is_significant or not agreement.expected_lag_rejected or abs(lag.value) < LIMITS.steering_lag:
        return None
    # The steering error, integrated over the lag [rad s], acts like a constant error of 2 / HORIZON times the integral.
    error_integral = abs(lag.value) * float(np.std(agreement.derived)) * np.sqrt(2.0)
    effect = lateral_shift * 2.0 * error_integral / HORIZON
    text = (f"the steering {'lags' if lag.value > 0.0 else 'leads'} the car's motion by {abs(lag)} s"
            f"{format_alternative_lags(agreement, response)}, beyond the car's own response")
    if agreement.drift.is_significant:
        text += f", and this lag changes by {agreement.drift.scaled(float(np.ptp(agreement.time)))} s during the drive"
    advice = Advice.correct("road_wheel_angle", earlier=float(f"{lag.value:.3g}"))
    advice = replace(advice, line=f"{advice.line}  # or --steering-latency")
    finding = _make_finding("steering_lag", ("road_wheel_angle",), text, lag, "s", effect, advice)
    return finding.with_alternative(PLAY, TIGHTER_BENDS) if _play_explains(lag.value, agreement) else finding


def _play_explains(lag: float, agreement: Agreement) -> bool:
    """Whether play explains the steering as well as a lag [s] of the sensor (> 0) or of the road wheels (< 0)."""
    time = agreement.time
    leading, following = np.interp(time + lag, time, agreement.derived), agreement.measured
    if lag < 0.0:
        leading, following = following, leading
    rate = np.abs(np.gradient(leading, time))
    half_width = abs(lag) * float(np.mean(rate**2)) / max(float(np.mean(rate)), 1e-12)  # of the play [rad]
    columns = {"offset": np.ones(len(time)), "lag": np.interp(time - abs(lag), time, leading)}
    for name, width in (("narrow", half_width), ("wide", 2.0 * half_width)):
        columns[name] = leading.copy()
        for k in range(1, len(time)):
            columns[name][k] = min(max(columns[name][k - 1], leading[k] - width), leading[k] + width)
    problem = Regression(time, following[:, None], {name: column[:, None] for name, column in columns.items()})
    _, scale, _ = problem.fit(("offset", "lag"))
    with_lag, *with_play = (problem.compute_loss(("offset", cause), scale) for cause in ("lag", "narrow", "wide"))
    return min(with_play) <= MIN_LOSS_RATIO * with_lag


def _make_offset_finding(agreement: Agreement, vehicle: VehicleParameters, from_steering_wheel: bool,
                         lateral_shift: float, scale: float = 1.0, add: float = 0.0) -> Finding | None:
    """Finding about the offset that remains after the correction (scale, add) of a wrong unit or sign."""
    offset = add_systematic_uncertainty("steering_offset", agreement.bias.scaled(scale).shifted(add))
    if not offset.is_significant or abs(offset.value) < LIMITS.steering_offset:
        return None
    text = (f"road_wheel_angle reads {abs(offset)} rad ({abs(offset.value) * DEG_PER_RAD:.1f} deg) too far "
            f"{'left' if offset.value > 0.0 else 'right'} when driving straight: the steering offset is wrong")
    effect = lateral_shift * abs(offset.value)
    if from_steering_wheel:
        wheel = vehicle.steering_wheel_offset + offset.value * vehicle.steering_ratio
        line = f"steering_wheel_offset: {{value: {wheel * DEG_PER_RAD:.2f}, unit: deg, source: st check}}"
        advice = Advice("vehicle", f"{line}  # check with st identify steering-offset",
                        {"steering_wheel_offset": wheel})
    else:
        advice = Advice.correct("road_wheel_angle", add=float(f"{-offset.value:.4g}"))
    return _make_finding("steering_offset", ("road_wheel_angle",), text, offset, "rad", effect, advice)


def _make_finding(name: str, channels: tuple[str, ...], text: str, estimate: Estimate, unit: str, effect: float,
                  advice: Advice) -> Finding:
    """Finding with an effect [m], at most a warning, since the cause may be the car rather than the recording."""
    severity = Severity.NOTE if LIMITS.severity(effect) is Severity.NOTE else Severity.WARNING
    return Finding(name, severity, channels, text, estimate.value, unit, estimate.interval, (), effect, advice)


def check_rear_axle(motion: Motion, vehicle: VehicleParameters) -> Results:
    """Results on the alignment of the heading and the position of the INS, from the motion of the rear axle."""
    results = Results()
    windows = motion.make_windows(WINDOW)
    means = [windows.mean(values) for values in (motion.velocity_x, motion.velocity_y, motion.yaw_rate)]
    means.append(means[0] * means[2] + (np.gradient(means[1], windows.time) if len(windows) > 1 else 0.0))
    usable = (means[0] > MIN_SPEED) & (np.abs(means[3]) < MAX_LATERAL_ACCELERATION)
    usable &= windows.mean(_find_slides(motion, vehicle).astype(float)) == 0.0
    forward, lateral, rate, acceleration = (mean[usable] for mean in means)
    if usable.sum() < MIN_REAR_AXLE_WINDOWS or (
            abs(float(forward @ rate)) > MAX_COSINE * float(np.linalg.norm(forward) * np.linalg.norm(rate))):
        return results
    problem = Regression(windows.time[usable], lateral[:, None], {
        "misalignment": -forward[:, None], "lever_arm": rate[:, None], "slip": -(forward * acceleration)[:, None],
        "roll": -(windows.change(motion.velocity_x * motion.yaw_rate)[usable] / WINDOW)[:, None]})
    estimates = _fit_rear_axle(problem, vehicle, has_varying_speed(forward))
    distance_in_file = vehicle.cg_to_rear_axle + vehicle.cg_to_ins_x
    heading = add_systematic_uncertainty("heading_misaligned", estimates["misalignment"])
    point = add_systematic_uncertainty("measuring_point", estimates["lever_arm"].shifted(-distance_in_file))
    # If v_y has the opposite sign, the point appears as far behind the axle as it is ahead, and the slip is negative.
    is_mirrored = (point.covers(-2.0 * distance_in_file) and distance_in_file > LIMITS.ins_position
                   and estimates["slip"].interval[1] < 0.0)
    if heading.is_significant and abs(heading.value) >= LIMITS.heading_misalignment:
        effect = abs(heading.value) * float(np.median(forward)) * HORIZON
        text = (f"the heading points {abs(heading)} rad ({abs(heading.value) * DEG_PER_RAD:.2f} deg) to the "
                f"{'left' if heading.value > 0.0 else 'right'} of the course when driving straight: the INS is mounted "
                "at an angle")
        finding = _make_finding("heading_misaligned", ("yaw", "velocity_y"), text, heading, "rad", effect,
                                Advice.correct("heading", add=float(f"{-heading.value:.4g}")))
        # On a road banked by b, the rear tyres slip as under a lateral acceleration of g b.
        may_be_bank = abs(heading.value) < SLIP_RANGE[1] * rear_slip_coefficient(vehicle) * GRAVITY * MAX_BANK
        results.findings.append(finding.with_alternative(BANK, BOTH_DIRECTIONS) if may_be_bank else finding)
    results.findings += filter(None, [OPPOSITE_SIGN_FINDING if is_mirrored else
                                      _make_point_finding(point, estimates["slip"], motion, vehicle)])
    results.estimates = {"heading_misaligned": heading, "measuring_point": point}
    axle_motion = sum(estimates[name].value * problem.columns[name][:, 0] for name in ("slip", "roll"))
    results.panels.append(Comparison(
        "velocity_y", "lateral velocity: measured versus derived from the rear axle", "m/s", "velocity_y",
        "from yaw rate and the INS position in the file", windows.time[usable], lateral,
        distance_in_file * rate + axle_motion, ("heading_misaligned", "measuring_point")))
    return results


def _fit_rear_axle(problem: Regression, vehicle: VehicleParameters, speed_varies: bool) -> dict[str, Estimate]:
    """Estimates of misalignment [rad], lever_arm [m ahead of the rear axle], slip [rad s^2/m] and roll [s^2]. If the
    speed does not vary, or if the standard error of the slip is 25 % or more, the slip is the file's +/- 50 %."""
    expected = rear_slip_coefficient(vehicle)
    if speed_varies:
        free = problem.estimate(("misalignment", "lever_arm", "slip", "roll"))
        if free["slip"].standard_error < 0.25 * expected:
            return free
    middle, low, high = (
        Regression(problem.time, problem.compute_residual({"slip": slip}), problem.columns).estimate(
            ("misalignment", "lever_arm", "roll"))
        for slip in (expected, *(factor * expected for factor in SLIP_RANGE)))
    return {"slip": Estimate(expected, 0.25 * expected, 0.5 * expected), **{
        name: estimate.widened(max(abs(other[name].value - estimate.value) for other in (low, high)))
        for name, estimate in middle.items()}}


def _make_point_finding(point: Estimate, slip: Estimate, motion: Motion, vehicle: VehicleParameters) -> Finding | None:
    """Finding about an INS point other than in the vehicle file; None if the distance is small or uncertain.
    point: that distance, > 0 ahead [m]. slip: of the rear axle, see `_fit_rear_axle`. Rear wheels steered by k times
    the front angle act like a point k / (1 - k) wheelbases further ahead. A k that depends on speed changes the slip
    too, so there is no correction if the slip does not agree with the vehicle file."""
    if not point.is_significant or abs(point.value) < LIMITS.ins_position:
        return None
    windows = motion.make_windows(HORIZON)
    # |R(yaw2) - R(yaw1)|, by which a wrong point shifts the displacement over the horizon.
    turn = 2.0 * np.abs(np.sin(0.5 * windows.change(motion.yaw))) if len(windows) else np.zeros(1)
    effect = abs(point.value) * float(np.sqrt(np.square(turn).mean()))
    text = (f"the INS point is {abs(point)} m {'ahead of' if point.value > 0 else 'behind'} "
            f"the INS position in the vehicle file (cg_to_ins_x {vehicle.cg_to_ins_x:.2f} m)")
    if point.covers(-vehicle.cg_to_ins_x - vehicle.cg_to_rear_axle):
        text += ", which may be the rear axle"
    value = vehicle.cg_to_ins_x + point.value
    advice = Advice("vehicle", f"cg_to_ins_x: {{value: {value:.2f}, unit: m, source: \"st check\"}}  # measure it: "
                    "rear-wheel steering has the same effect", {"cg_to_ins_x": round(value, 2)})
    low, high = (factor * rear_slip_coefficient(vehicle) for factor in SLIP_RANGE)
    if abs(value) > vehicle.wheelbase:
        text += f", {abs(value):.2f} m from the CG and thus outside the car"
        advice = Advice("text", "check velocity_y and the unit of length; while the rear tyres slide, the INS point "
                        "cannot be determined")
    elif slip.interval[1] < low or slip.interval[0] > high:
        text += ", but velocity_y does not fit the rear slip of the vehicle file"
        advice = Advice("text", "measure the INS position: speed-dependent rear-wheel steering, or a different "
                        "cornering_stiffness_rear, has the same effect")
    else:
        text += ", or the rear wheels steer, or the distance of the CG from the rear axle is wrong in the file"
    return _make_finding("measuring_point", ("velocity_y", "x", "y"), text, point, "m", effect, advice)


def check_tyre_limit(motion: Motion, sideslip_measured: bool) -> list[Finding]:
    """Finding about a lateral acceleration above the limit of road tyres; a note if positions confirm it."""
    windows = motion.make_windows(WINDOW)
    # In a spin, the change of velocity_y cancels the product of speed and yaw rate.
    lateral = windows.mean(motion.velocity_x * motion.yaw_rate) + windows.change(motion.velocity_y) / WINDOW
    impossible = np.abs(lateral) > LIMITS.lateral_acceleration
    if impossible.sum() < 2:
        return []
    largest = float(np.abs(lateral).max())
    displacement, pairs = windows.change(motion.position), (impossible[1:] | impossible[:-1]) & windows.are_adjacent
    turn, mean = np.angle(displacement[1:] * np.conj(displacement[:-1])), 0.5 * (lateral[1:] + lateral[:-1])[pairs]
    ratio = float((np.abs(displacement[1:]) * turn)[pairs] @ mean) / max(WINDOW**2 * float(mean @ mean), 1e-12)
    times = tuple((float(t), float(t) + WINDOW) for t in windows.time[impossible][:MAX_LISTED_TIMES])
    severity, sources, reason = Severity.ERROR, "velocity and yaw rate", "one is wrong"
    if is_near(ratio, 1.0, LIMITS.unit_ratio):
        severity, sources = Severity.NOTE, "velocity, yaw rate and positions"
        reason = "plausible with downforce or racing tyres, else a unit of length or time is wrong"
    elif not sideslip_measured:
        return []
    text = (f"{sources} imply a lateral acceleration of up to {largest:.0f} m/s^2, but road tyres reach about "
            f"10 m/s^2: {reason}")
    channels = ("velocity_x", "velocity_y", "yaw_rate") if sideslip_measured else ("velocity_x", "yaw_rate")
    return [Finding("lateral_acceleration_impossible", severity, channels, text, largest, "m/s^2", times=times,
                    advice=Advice("text", "check speed and yaw rate at these times"))]


def check_test_bench(motion: Motion) -> list[Finding]:
    """Finding about wheels that turn for most of the drive while positions vary by noise only."""
    windows, speed = motion.make_windows(STANDSTILL_WINDOW), float(np.median(np.abs(motion.velocity_x)))
    displacement = windows.change(motion.position)
    if (len(windows) < MIN_CARRIED_WINDOWS or speed < MIN_MOVING_SPEED or windows.are_coherent(displacement)
            or np.abs(displacement).max() > MAX_BENCH_MOTION):
        return []
    text = (f"velocity_x is {speed:.3g} m/s while x and y vary by noise only: is the car on a chassis dynamometer, or "
            "did the receiver lose its position?")
    return [Finding("standstill_motion", Severity.ERROR, ("velocity_x", "x", "y"), text, speed, "m/s",
                    advice=Advice("text", "leave this drive out: nothing else in it can be checked"))]


def check_standstill(motion: Motion) -> list[Finding]:
    """Findings about a velocity or yaw rate other than 0 while position and yaw are constant, and vice versa."""
    windows = motion.make_windows(STANDSTILL_WINDOW)
    displacement = windows.change(motion.position)
    distance = np.abs(displacement)
    carried = (distance > STANDSTILL_WINDOW * MIN_MOVING_SPEED) & (np.abs(windows.mean(motion.velocity)) < 0.1)  # m/s
    standstill = (distance < 0.02) & (np.abs(windows.change(motion.yaw)) < 0.002)  # m, rad
    found: list[tuple[np.ndarray, tuple[str, ...], float, str, str, str]] = []  # (windows, channels, ..., advice)
    for name, values, unit, minimum in (("velocity_x", motion.velocity_x, "m/s", 0.1),
                                        ("yaw_rate", motion.yaw_rate, "rad/s", 0.01)):
        means = windows.mean(values)[standstill]
        value = float(np.median(means)) if len(means) >= 2 else 0.0
        if abs(value) >= minimum:
            text = f"{name} is {value:.3g} {unit} while position and yaw are constant"
            found.append((standstill, (name,), value, unit, text, f"check the bias of {name}"))
    if carried.sum() >= MIN_CARRIED_WINDOWS and windows.are_coherent(displacement * carried):  # unlike noise
        value = float(np.median(distance[carried])) / STANDSTILL_WINDOW
        text = f"positions move at {value:.3g} m/s while velocity is 0: is the car on a ferry or trailer?"
        found.append((carried, ("x", "y"), value, "m/s", text, "leave these times out"))
    return [Finding("standstill_motion", Severity.WARNING, channels, text, value, unit,
                    times=tuple((t, t + STANDSTILL_WINDOW) for t in windows.time[mask][:MAX_LISTED_TIMES].tolist()),
                    advice=Advice("text", advice)) for mask, channels, value, unit, text, advice in found]
