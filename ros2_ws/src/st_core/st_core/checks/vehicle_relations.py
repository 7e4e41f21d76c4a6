"""Relations that involve the vehicle, with bounds so wide that only a faulty recording exceeds them.

Steering: atan(L r / v_x) is what a car without slip steers; ratio and wheelbase of a real one change it by some ten per
cent, understeer at 20 m/s may nearly double it, a wrong unit makes it 57 times as large. Rear axle: a slow car's rear
axle moves where it points, so at the INS point

    v_y = -a v_x + d r - s v_x^2 r      a: heading reported too far left, d: ahead of the rear axle, s: slip of the rear
"""

from dataclasses import replace

import numpy as np

from ..handling import linear_system, understeer_coefficient
from ..vehicle import VehicleParameters
from .finding import HORIZON, LIMITS, Advice, Finding, Identity, Severity
from .inertial import or_else, size_of
from .motion import MOVING, Motion, several_speeds, windows
from .regression import NOTHING, Agreement, Estimate, Regression, agreement, with_systematic

Comparison = tuple[list[Finding], dict[str, Estimate], Identity | None]
"""(findings, estimates by name of the finding, what a figure shows or None)."""
CUTOFF = 1.5  # Hz
SLOW, GENTLE = 2.0, 4.0  # m/s from which, m/s^2 up to which an axle's slip is linear
DEGREE = 180.0 / np.pi
WINDOW = 0.5  # s
ONE_BEND = 0.9  # cosine between speed and yaw rate over the drive: 1 on a circle
LEAST_ANGLE = 0.01  # rad, root mean square
LEAST_ANGLE_OF_SIGN = 0.003  # rad, root mean square; fast wide bends show the sign, if not the size
OPPOSITE = -0.8  # correlation of steering and curvature up to which the sensor counts the other way
STOPPED = 1e-6  # of the angle derived from curvature; a constant steering angle is reported as frozen instead


def steering(motion: Motion, vehicle: VehicleParameters, hand_wheel: bool) -> Comparison:
    """Curvature against steering. hand_wheel: whether its angle was recorded; its offset is in the vehicle file."""
    moving = motion.velocity_x > SLOW
    curvature = np.where(moving, motion.yaw_rate / np.maximum(motion.velocity_x, MOVING), np.nan)
    derived = np.arctan(vehicle.wheelbase * curvature)
    speed = float(np.median(motion.velocity_x[moving])) if moving.any() else SLOW
    response = response_time(vehicle, speed)
    found = agreement(motion.time, derived, motion.steering_time, motion.steering, CUTOFF, usual=-response)
    scale = _scale(motion, derived)
    own = _understeered(motion.velocity_x, derived, vehicle)
    if found is None or abs(found.correlation) < LIMITS.correlation:
        unit = scale and _unit(scale, own, vehicle)
        return [unit] if unit else [], {}, None
    # One bend throughout: its size and an offset look alike.
    if scale is not None and (found.scale.deviation > 0.2 * abs(found.scale.value)
                              or abs(float(found.derived.mean())) > found.spread):
        found = replace(found, scale=scale, bias=NOTHING)
    scale = with_systematic("steering_scale", found.scale)
    # Steering that falls where curvature rises is the driver's reaction to another yaw moment: it has no lag.
    answers = found.correlation * scale.value < 0.0
    late = with_systematic("steering_lag", found.lag.shifted(response))
    findings = [one for one in (_unit(scale, own, vehicle),
                            None if answers else _late(late, found, speed, vehicle, or_else(found, response)),
                            _offset(found, speed, vehicle, hand_wheel)) if one]
    shown = Identity("steering", "road wheel angle: steering sensor against curvature", "rad", "road_wheel_angle",
                     "from yaw rate and speed", found.time, found.measured, found.derived,
                     ("steering_scale", "steering_sign", "steering_lag", "steering_offset"))
    lag = {"steering_lag": late} if found.carries_lag and not answers else {}
    estimates = {"steering_scale": scale, "steering_sign": scale, **lag,
                 "steering_offset": with_systematic("steering_offset", found.bias)}
    return findings, estimates, shown


def _scale(motion: Motion, derived: np.ndarray) -> Estimate | None:
    """Of the road wheel angle over that of the curvature, without an offset; None where the car hardly turns.

    A negative one needs less turning: it states the sign, and both rise and fall together whatever the offset.
    """
    angle = motion.steering_at_ins()
    known = np.flatnonzero(np.isfinite(derived) & np.isfinite(angle))[::10]
    size = float(np.sqrt(np.mean(derived[known] ** 2))) if len(known) >= 50 else 0.0
    if size < LEAST_ANGLE and not (size > LEAST_ANGLE_OF_SIGN and float(np.std(angle[known])) > 0.0
                                   and np.corrcoef(derived[known], angle[known])[0, 1] < OPPOSITE):
        return None
    problem = Regression(motion.time[known], angle[known, None], {"scale": derived[known, None]})
    return problem.estimates(("scale",))["scale"]


def _understeered(speed: np.ndarray, derived: np.ndarray, vehicle: VehicleParameters) -> float:
    """Factor by which a car with the understeer K of its file steers more over the drive than one without slip.

        1 + K v^2, weighted by the square of the angle; 1 for a file that oversteers
    """
    known = np.isfinite(derived)
    weight = np.square(derived[known])
    if not weight.any():
        return 1.0
    return 1.0 + max(understeer_coefficient(vehicle), 0.0) * float(np.average(np.square(speed[known]), weights=weight))


def response_time(vehicle: VehicleParameters, speed: float) -> float:
    """By how much the yaw rate of a linear car lags its steering in slow changes [s].

        -d(arg H)/d(omega) at 0,  H = c (i omega - A)^-1 b:   tau = c A^-2 b / -(c A^-1 b)
    """
    a, b = linear_system(speed, vehicle)
    once = np.linalg.solve(a, b)
    return float(np.linalg.solve(a, once).ravel()[1] / -once.ravel()[1])


def _sideways(error: float, speed: float, vehicle: VehicleParameters) -> float:
    """What a steady error of the road wheel angle [rad] moves the position by after the horizon, across [m]."""
    a, b = linear_system(max(speed, MOVING), vehicle)
    gain = -float(np.linalg.solve(a, b).ravel()[1])
    return abs(0.5 * speed * gain * error) * HORIZON**2


def _unit(scale: Estimate, own: float, vehicle: VehicleParameters) -> Finding | None:
    """own: factor that the car's understeer explains; the file's stiffnesses may be guessed, so it may also be 1."""
    value = scale.value
    if abs(value) < STOPPED:
        return None
    if scale.interval[1] > 1.0 / LIMITS.steering_unit and scale.interval[0] < LIMITS.steering_unit * own:
        return None
    ratio = f"steering ratio {vehicle.steering_ratio:g} of the vehicle file"
    known = {DEGREE: "degrees", vehicle.steering_ratio: f"the angle of the steering wheel ({ratio})",
             DEGREE * vehicle.steering_ratio: f"the angle of the steering wheel in degrees ({ratio})",
             1.0 / DEGREE: "converted to rad twice", 1.0 / vehicle.steering_ratio: "divided by the ratio twice",
             1.0: ""}
    size = abs(value) / own
    factor = min(known, key=lambda f: abs(np.log(size / f)))
    exact = factor if 1.0 / LIMITS.steering_unit < size / factor < LIMITS.steering_unit else size
    reason = known.get(exact, "")
    signed = float(np.copysign(exact, value))
    other_way = "it counts the other way (left is positive)" if value < 0.0 else ""
    words = " and ".join(filter(None, (reason, other_way)))
    name = "steering_sign" if exact == 1.0 else "steering_scale"
    or_else = "  # or, for CAN logs, the other steering_sign in car.yaml" if name == "steering_sign" else ""
    text = f"road_wheel_angle is {value:.3g} times the angle from yaw rate and speed" + (f": {words}?" if words else "")
    advice = Advice.correct("road_wheel_angle", scale=float(f"{1.0 / signed:.6g}"))
    return Finding(name, Severity.ERROR, ("road_wheel_angle",), text, value, "1", scale.interval, (), None,
                   replace(advice, line=f"{advice.line}{or_else}"))


def _late(late: Estimate, found: Agreement, speed: float, vehicle: VehicleParameters,
          or_else: str) -> Finding | None:
    if not late.significant or not found.late or abs(late.value) < LIMITS.steering_lag:
        return None
    # A late input turns the path by the angle missed during the lag.
    missed = abs(late.value) * float(np.std(found.derived)) * np.sqrt(2.0)
    effect = _sideways(missed / HORIZON * 2.0, speed, vehicle)
    verb = "lags" if late.value > 0.0 else "leads"
    text = f"the steering {verb} the car's motion by {size_of(late)} s{or_else}, the car's own response allowed for"
    advice = Advice.correct("road_wheel_angle", earlier=float(f"{late.value:.3g}"))
    return Finding("steering_lag", _at_most_warning(effect), ("road_wheel_angle",), text, late.value, "s",
                   late.interval, (), effect, replace(advice, line=f"{advice.line}  # or --steering-latency"))


def _offset(found: Agreement, speed: float, vehicle: VehicleParameters, hand_wheel: bool) -> Finding | None:
    size = abs(found.scale.value)
    bias = found.bias.scaled(1.0 / size) if size > LIMITS.steering_unit else found.bias
    one = with_systematic("steering_offset", bias)
    if not one.significant or abs(one.value) < LIMITS.steering_offset:
        return None
    text = (f"the road wheels read {size_of(one)} rad ({abs(one.value) * DEGREE:.1f} deg) too far {side(one)} when "
            "driving straight: the steering offset is wrong")
    effect = _sideways(one.value, speed, vehicle)
    # Once the sign is corrected, where that is wrong too.
    left = one.value * float(np.sign(found.scale.value))
    return Finding("steering_offset", _at_most_warning(effect), ("road_wheel_angle",), text, one.value, "rad",
                   one.interval, (), effect, _straight(left, vehicle, hand_wheel))


def _straight(left: float, vehicle: VehicleParameters, hand_wheel: bool) -> Advice:
    """Correction of the offset. left: reading of the road wheel angle when driving straight [rad]."""
    if not hand_wheel:
        return Advice.correct("road_wheel_angle", add=float(f"{-left:.4g}"))
    wheel = vehicle.steering_wheel_offset + left * vehicle.steering_ratio
    return Advice("vehicle", f"steering_wheel_offset: {{value: {wheel * DEGREE:.2f}, unit: deg, source: st check}}"
                           "  # check with st identify steering-offset", {"steering_wheel_offset": wheel})


def side(one: Estimate) -> str:
    return "left" if one.value > 0.0 else "right"


def _at_most_warning(effect: float) -> Severity:
    """At most a warning, since the cause may be the car rather than the recording."""
    severity = LIMITS.severity(effect)
    return Severity.WARNING if severity is Severity.ERROR else severity


def rear_axle(motion: Motion, vehicle: VehicleParameters) -> Comparison:
    """Heading against the straight-on course, and where the INS point lies."""
    over = windows(motion.time, WINDOW)
    columns = [over.mean(motion.time, c) for c in (motion.velocity_x, motion.velocity_y, motion.yaw_rate)]
    use = (columns[0] > SLOW) & (np.abs(columns[0] * columns[2]) < GENTLE)
    if use.sum() < 30:
        return [], {}, None
    forward, across, rate = (c[use] for c in columns)
    if abs(float(forward @ rate)) > ONE_BEND * float(np.linalg.norm(forward) * np.linalg.norm(rate)):
        return [], {}, None  # heading, point and slip of the axle look alike
    problem = Regression(over.time[use], across[:, None], {
        "heading": -forward[:, None], "point": rate[:, None], "slip": -(forward**2 * rate)[:, None]})
    found = _rear_axle(problem, vehicle, several_speeds(forward))
    heading = with_systematic("heading_misaligned", found["heading"])
    point = with_systematic("measuring_point", found["point"].shifted(-(vehicle.cg_to_rear_axle + vehicle.cg_to_ins_x)))
    findings = [one for one in (_heading(heading, forward), _point(point, motion, vehicle)) if one]
    theta = {name: one.value for name, one in found.items()}
    shown = Identity("velocity_y", "lateral velocity: measured against that of a rear axle that follows", "m/s",
                     "velocity_y", "rear axle at the declared distance", over.time[use], across,
                     (vehicle.cg_to_rear_axle + vehicle.cg_to_ins_x) * rate - theta["slip"] * forward**2 * rate,
                     ("heading_misaligned", "measuring_point"))
    return findings, {"heading_misaligned": heading, "measuring_point": point}, shown


def _rear_axle(problem: Regression, vehicle: VehicleParameters, separable: bool) -> dict[str, Estimate]:
    """heading [rad], point [m ahead of the rear axle], slip [s^2/m].

    separable: whether the speed varies. Where slip of the axle and point look alike, the slip is that of the vehicle
    file within half of its value.
    """
    expected = vehicle.mass * vehicle.cg_to_front_axle / (vehicle.wheelbase * vehicle.cornering_stiffness_rear)
    if separable:
        free = problem.estimates(("heading", "point", "slip"))
        if free["slip"].deviation < 0.25 * expected:
            return free
    fixed = []
    for slip in (expected, 0.5 * expected, 1.5 * expected):
        rest = problem.rest({"slip": slip})
        fixed.append(Regression(problem.time, rest, problem.columns).estimates(("heading", "point")))
    return {"slip": Estimate(expected, 0.25 * expected, (0.5 * expected, 1.5 * expected)), **{
        name: fixed[0][name].widened(max(abs(other[name].value - fixed[0][name].value) for other in fixed[1:]))
        for name in ("heading", "point")}}


def _heading(one: Estimate, forward: np.ndarray) -> Finding | None:
    if not one.significant or abs(one.value) < LIMITS.heading:
        return None
    effect = abs(one.value) * float(np.median(forward)) * HORIZON
    text = (f"the heading points {size_of(one)} rad ({abs(one.value) * DEGREE:.2f} deg) to the {side(one)} of the "
            "course when driving straight: the INS is mounted at an angle, or the road is banked")
    return Finding("heading_misaligned", _at_most_warning(effect), ("yaw", "velocity_y"), text, one.value, "rad",
                   one.interval, (), effect, Advice.correct("heading", add=float(f"{-one.value:.4g}")))


def _point(one: Estimate, motion: Motion, vehicle: VehicleParameters) -> Finding | None:
    if not one.significant or abs(one.value) < LIMITS.mounting:
        return None
    over = windows(motion.time, HORIZON)
    turn = 2.0 * np.abs(np.sin(0.5 * over.change(motion.yaw))) if len(over) else np.zeros(1)
    effect = abs(one.value) * float(np.sqrt(np.square(turn).mean()))
    where = "ahead of" if one.value > 0 else "behind"
    text = (f"the measuring point lies {size_of(one)} m {where} the declared one (cg_to_ins_x "
            f"{vehicle.cg_to_ins_x:.2f} m)")
    value = vehicle.cg_to_ins_x + one.value
    low, high = (vehicle.cg_to_ins_x + vehicle.cg_to_rear_axle + end for end in one.interval)
    if low < 0.0 < high:
        text += ": at the rear axle?"
    return Finding("measuring_point", _at_most_warning(effect), ("velocity_y", "x", "y"), text, one.value, "m",
                   one.interval, (), effect, Advice(
                       "vehicle", f"cg_to_ins_x: {{value: {value:.2f}, unit: m, source: \"st check\"}}",
                       {"cg_to_ins_x": round(value, 2)}))


def believable(motion: Motion) -> list[Finding]:
    """Finding of a lasting lateral acceleration above the limit of road tyres."""
    over = windows(motion.time, WINDOW)
    if not len(over):
        return []
    across = over.mean(motion.time, motion.velocity_x * motion.yaw_rate)
    wild = np.abs(across) > LIMITS.tyre
    if wild.sum() < 2:
        return []
    largest = float(np.abs(across).max())
    text = f"v_x times yaw rate reaches {largest:.0f} m/s^2; tyres give about 10: speed or yaw rate is wrong there"
    where = tuple((float(t), float(t) + WINDOW) for t in over.time[wild][:20])
    return [Finding("lateral_acceleration_impossible", Severity.ERROR, ("velocity_x", "yaw_rate"), text, largest,
                    "m/s^2", None, where, None, Advice("look", "look at the stretches named"))]


def standstill(motion: Motion) -> list[Finding]:
    """Findings of a velocity or yaw rate other than 0 while position and yaw are constant."""
    over = windows(motion.time, 2.0)
    if not len(over):
        return []
    way = np.hypot(over.change(motion.x), over.change(motion.y))
    speed = over.mean(motion.time, motion.velocity_x)
    turn = np.abs(over.change(motion.yaw))
    still = (way < 0.02) & (turn < 0.002)
    findings = []
    for name, values, unit, least in (("velocity_x", speed, "m/s", 0.1),
                                      ("yaw_rate", over.mean(motion.time, motion.yaw_rate), "rad/s", 0.01)):
        inside = values[still]
        if len(inside) >= 2 and abs(np.median(inside)) >= least:
            value = float(np.median(inside))
            text = f"{name} is {value:.3g} {unit} while position and yaw are constant"
            where = tuple((float(t), float(t) + 2.0) for t in over.time[still][:20])
            findings.append(Finding("standstill_motion", Severity.WARNING, (name,), text, value, unit, where=where,
                                    advice=Advice("look", f"look at the bias of {name}")))
    return findings
