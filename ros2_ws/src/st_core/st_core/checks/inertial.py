"""Checks of each channel against others by kinematic relations that are valid for any vehicle.

    r = d(yaw)/dt        a_x = dv_x/dt - v_y r        a_y = dv_y/dt + v_x r

An accelerometer also measures gravity: a slope appears as a bias of a_x, a banked road or a mounting angle as a bias of
a_y. If the accelerometer is a distance d behind the point of the velocities, its a_y lags by d / v at speed v.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from .agreement import Agreement, compare_series
from .finding import HORIZON, LIMITS, WHEEL_SCALE, Advice, Comparison, Finding, Severity
from .motion import MOVING, Motion, is_near
from .regression import Estimate, with_systematic


@dataclass(frozen=True)
class Tolerances:
    """Errors of a channel below which it agrees with a reference."""

    channel: str
    reference: str
    unit: str
    lag: float  # smallest reported lag [s]
    scale: float  # smallest reported deviation of the scale from 1
    bias: float  # smallest reported bias [unit]
    severe: tuple[float, float, float]  # (lag, scale, bias) that identification and discovery do not tolerate
    position_effect: float = 0.0  # position shift after the horizon per unit of error [m]
    min_spread: float = 0.0  # smallest standard deviation of the reference for which a lag is reported [unit]
    correlation: float = LIMITS.correlation  # minimum, for scale and bias to be judged
    factors: Mapping[float, str] = field(default_factory=dict)  # question on the cause of a wrong scale, by factor
    causes: str = ""  # of a bias, as text


def judge_agreement(found: Agreement | None, tolerances: Tolerances, removed_scale: float = 1.0,
                    ) -> tuple[list[Finding], dict[str, Estimate]]:
    """(findings, estimates by name of the finding). removed_scale: factor already divided out of the channel."""
    if found is None or abs(found.correlation) < min(tolerances.correlation, LIMITS.correlation):
        return [], {}
    name = tolerances.channel
    scale, lag, bias = (with_systematic(f"{name}_{kind}", getattr(found, kind)) for kind in ("scale", "lag", "bias"))
    is_late = (lag.significant and found.is_late and abs(lag.value) >= tolerances.lag
               and found.spread >= tolerances.min_spread)
    late = [_lag_finding(found, lag, tolerances)] if is_late else []
    estimates = {f"{name}_lag": lag} if found.determines_lag else {}
    if abs(found.correlation) < tolerances.correlation:  # noise biases the scale and the bias, but not the lag
        return late, estimates
    estimates |= {f"{name}_scale": scale.scaled(removed_scale)}
    estimates |= {f"{name}_bias": bias} if bias.deviation else {}  # 0: no bias was fitted
    # Regression on a noisy quantity yields between r^2 and 1 times the true slope (Fuller 1987, Measurement Error
    # Models, 1.1), so noise of the derived quantity may explain a scale below 1.
    explained_by_noise = scale.value < 1.0 and scale.value / found.correlation**2 + scale.half > 1.0
    findings: list[Finding] = []
    factor: float | None = None  # the factor of a unit or sign that explains the scale, or else the scale itself
    if not explained_by_noise and not is_near(scale.value, 1.0, LIMITS.channel_unit):
        factors = [sign * size for size in (1.0, *tolerances.factors) for sign in (1.0, -1.0)][1:]
        near = [f for f in factors if is_near(scale.value, f, LIMITS.channel_unit)]
        factor = min(near, key=lambda f: abs(np.log(scale.value / f)), default=scale.value)
    if factor is not None:
        findings.append(_unit_finding(scale, factor, tolerances))
    elif (abs(scale.value - 1.0) >= tolerances.scale and scale.shifted(-1.0).significant and not explained_by_noise):
        text = f"{name} is {format_estimate(scale)} times its value from {tolerances.reference}"
        findings.append(_make_finding("scale", text, scale, "1", abs(scale.value - 1.0) * found.spread, tolerances,
                                      {"scale": 1.0 / scale.value}, abs(scale.value - 1.0) >= tolerances.severe[1]))
    # The user's correction divides by the reported scale before it subtracts the bias.
    divisor = scale.value if findings else 1.0
    findings += late
    error = abs(bias.value) / max(abs(scale.value), 1e-300)
    if bias.significant and error >= tolerances.bias and factor is None:
        side, unit = "high" if bias.value > 0.0 else "low", tolerances.unit.replace("^2", "²")
        text = (f"{name} is {format_magnitude(bias)} {unit} too {side} compared with {tolerances.reference}"
                f"{tolerances.causes}")
        findings.append(_make_finding("bias", text, bias, tolerances.unit, error, tolerances,
                                      {"add": -bias.value / divisor}, error >= tolerances.severe[2]))
    return findings, estimates


def _lag_finding(found: Agreement, lag: Estimate, tolerances: Tolerances) -> Finding:
    rate = float(np.std(np.gradient(found.derived, found.time)))
    text = (f"{tolerances.channel} {'lags' if lag.value > 0.0 else 'leads'} {tolerances.reference} by "
            f"{format_magnitude(lag)} s{format_alternative_lags(found)}")
    if abs(found.correlation) < tolerances.correlation:
        text += f"; their correlation is only {abs(found.correlation):.2f}, so scale and bias are not judged"
    return _make_finding("lag", text, lag, "s", abs(lag.value) * rate, tolerances, {"earlier": lag.value},
                         abs(lag.value) >= tolerances.severe[0])


def format_estimate(estimate: Estimate) -> str:
    """Value ± half-width of the 95 % interval, the latter with two significant digits."""
    digits = min(max(1 - math.floor(math.log10(estimate.half)), 0), 6) if estimate.half > 0.0 else 3
    return f"{estimate.value:.{digits}f} ± {estimate.half:.{digits}f}"


def format_magnitude(estimate: Estimate) -> str:
    """`format_estimate` without the sign."""
    return format_estimate(estimate).removeprefix("-")


def format_alternative_lags(found: Agreement, response: float = 0.0) -> str:
    """Text on other lags that fit equally well; "" if there are none. response: lag of the car, added to them [s]."""
    others = sorted(lag + response for lag in found.other_lags)
    text = " or ".join(f"{'lags' if lag > 0.0 else 'leads'} by {abs(lag):.2f} s" for lag in others)
    return f" (or {text}, which fits equally well: the motion is periodic)" if text else ""


def _unit_finding(scale: Estimate, factor: float, tolerances: Tolerances) -> Finding:
    opposite = "does it have the opposite sign" if factor < 0.0 else ""
    reason = " and ".join(filter(None, (tolerances.factors.get(abs(factor), ""), opposite)))
    text = (f"{tolerances.channel} is {format_estimate(scale)} times its value from {tolerances.reference}"
            + (f": {reason}?" if reason else ""))
    return Finding(f"{tolerances.channel}_scale", Severity.WARNING, (tolerances.channel,), text, scale.value, "1",
                   scale.interval, advice=_make_advice(tolerances.channel, "scale", float(f"{1.0 / factor:.6g}")))


def _make_finding(kind: str, text: str, estimate: Estimate, unit: str, error: float, tolerances: Tolerances,
                  correct: dict[str, float], severe: bool) -> Finding:
    """Finding of an error. error: root mean square error of the channel [unit]. correct: {key: value} to correct it."""
    effect = error * tolerances.position_effect
    (key, value), = correct.items()
    return Finding(f"{tolerances.channel}_{kind}", LIMITS.severity(effect, severe), (tolerances.channel,), text,
                   estimate.value, unit, estimate.interval, (), effect if tolerances.position_effect else None,
                   _make_advice(tolerances.channel, key, float(f"{value:.5g}")))


def _make_advice(channel: str, key: str, value: float) -> Advice:
    """Correction of a channel in run.yaml."""
    if channel in ("wheel_speed", "ins_speed"):  # run.yaml cannot correct these
        return Advice("look", "check its source: unit, wheel radius, clock")
    return Advice.correct(channel, **{key: value})


def agreement_panel(found: Agreement | None, tolerances: Tolerances, title: str, measured: float = 1.0,
                    derived: float = 1.0) -> Comparison | None:
    """Both series in the recorded units, for a figure. measured, derived: factors that were divided out before."""
    return None if found is None else Comparison(
        tolerances.channel, title, tolerances.unit, tolerances.channel, f"from {tolerances.reference}", found.time,
        measured * found.measured, derived * found.derived,
        tuple(f"{tolerances.channel}_{kind}" for kind in ("scale", "bias", "lag")))


GRAVITY = 9.80665
GYRO_CUTOFF, ACCELERATION_CUTOFF, SPEED_CUTOFF = 4.0, 1.5, 1.5  # Hz
GYRO_CORRELATION = 0.9  # minimum correlation of yaw rate and change of yaw; it is lower if yaw is coarse
GYRO_SCALE = 0.02  # 1; the scale of a gyroscope is accurate to 1 %
GYRO_BIAS = 0.001  # rad/s; twice the bias of a faultless INS
ACCELERATION_SCALE = 0.35  # 1; roll and pitch of the body change the scale by up to a third
ACCELERATION_LAG = 0.12  # s; filters of accelerometers cause delays of up to 0.1 s
ACCELEROMETER_ARM = 1.5  # m between accelerometer and INS point
SEVERE_ACCELERATION = 0.3  # m/s^2; a crossfall of 2.5 % causes a bias of 0.25
SPEED_SPREAD = 0.5  # m/s; minimum standard deviation; at constant speed, only slip and noise would be compared
WHEEL_LAG = 0.15  # s; wheel speed signals are averaged over time
ACCELERATION_FACTORS = {1.0 / GRAVITY: "is its unit g"}
SPEED_FACTORS = {3.6: "is its unit km/h", 2.23694: "is its unit mph", 1.0 / 3.6: "was it divided by 3.6 twice"}
CheckResult = tuple[list[Finding], dict[str, Estimate], Comparison | None]
"""(findings, estimates by name of the finding, panel of the figure or None)."""


def compare_yaw_rate(motion: Motion) -> tuple[Agreement | None, Tolerances]:
    """Compare yaw rate and change of yaw. An error of the initial yaw rate decays within LIMITS.settling."""
    position_effect = LIMITS.settling * float(np.median(np.abs(motion.velocity_x))) * HORIZON
    found = compare_series(motion.time, motion.yaw, motion.time, motion.yaw_rate, GYRO_CUTOFF, True)
    return found, Tolerances("yaw_rate", "yaw", "rad/s", LIMITS.lag, GYRO_SCALE, GYRO_BIAS,
                             (LIMITS.severe_lag, 0.03, 0.01), position_effect, correlation=GYRO_CORRELATION)


def yaw_rate_lag(motion: Motion) -> float:
    """Lag of the yaw rate behind yaw [s]; 0 if it is small, or if the two agree well without a correction."""
    found = compare_series(motion.time, motion.yaw, motion.time, motion.yaw_rate, ACCELERATION_CUTOFF, True)
    if found is None or not (found.is_late and found.lag.significant) or abs(found.lag.value) < LIMITS.severe_lag:
        return 0.0
    # A yaw rate of the opposite sign also correlates, half a period later.
    hidden = abs(found.correlation_without_lag) < found.correlation - 0.05
    return found.lag.value if found.correlation >= LIMITS.correlation and hidden else 0.0


def correct_yaw_rate(motion: Motion, found: Agreement) -> Motion:
    """The motion with lag, scale and bias of its yaw rate corrected, as far as they are known."""
    if found.correlation < LIMITS.correlation:
        return motion
    late = found.lag.value if found.lag.significant and found.is_late else 0.0
    known = found.correlation >= GYRO_CORRELATION
    rate = (motion.yaw_rate - found.bias.value) / found.scale.value if known else motion.yaw_rate
    return replace(motion, yaw_rate=np.interp(motion.time + late, motion.time, rate))


def check_accelerations(motion: Motion) -> list[CheckResult]:
    """Compare both accelerations with the derivative of velocity; empty if the axes of the velocity are wrong."""
    if motion.moves_sideways:
        return []
    time, speed = motion.time, float(np.median(np.abs(motion.velocity_x)))
    derived = {"acceleration_x": np.gradient(motion.velocity_x, time) - motion.velocity_y * motion.yaw_rate,
               "acceleration_y": np.gradient(motion.velocity_y, time) + motion.velocity_x * motion.yaw_rate}
    lags = {"acceleration_x": ACCELERATION_LAG,
            "acceleration_y": max(ACCELERATION_LAG, ACCELEROMETER_ARM / max(speed, MOVING))}
    measured = {name: values for name in derived if (values := getattr(motion, name)) is not None}

    def compare(name: str, values: np.ndarray) -> Agreement | None:
        return compare_series(time, derived[name], time, values, ACCELERATION_CUTOFF)

    def correlates(found: Agreement | None) -> bool:
        return found is not None and abs(found.correlation) >= LIMITS.correlation

    agreements = {name: compare(name, values) for name, values in measured.items()}
    exchanged = dict(zip(measured, reversed(measured), strict=True))
    if len(measured) == 2 and not any(map(correlates, agreements.values())) and all(
            correlates(compare(name, measured[other])) for name, other in exchanged.items()):
        text = "acceleration_x and acceleration_y are exchanged (x is forward, y left)"
        return [([Finding("acceleration_axes", Severity.WARNING, (*measured,), text, advice=Advice(
            "run.yaml", "columns: {acceleration_x: acceleration_y, acceleration_y: acceleration_x}",
            {"columns": exchanged}))], {}, None)]
    comparisons = []
    for name, found in agreements.items():
        lateral = name == "acceleration_y"
        tolerances = Tolerances(name, "velocity and yaw rate" if lateral else "velocity", "m/s^2", lags[name],
                                ACCELERATION_SCALE, LIMITS.bias_acceleration, (0.0, 0.0, SEVERE_ACCELERATION),
                                factors=ACCELERATION_FACTORS,
                                causes=": is it mounted at an angle, or is the road not level?")
        title = f"{'lateral' if lateral else 'forward'} acceleration: sensor versus velocity"
        comparisons.append((*judge_agreement(found, tolerances), agreement_panel(found, tolerances, title)))
    return comparisons


def check_speeds(motion: Motion) -> list[CheckResult]:
    """Compare other sources of the speed with the forward speed of the INS."""
    comparisons = []
    for name in motion.speeds:
        found = compare_speed(motion, name)
        scale, lag = (WHEEL_SCALE, WHEEL_LAG) if name == "wheel_speed" else (0.005, 0.03)
        tolerances = Tolerances(name, "velocity_x", "m/s", lag, scale, np.inf, (0.0, 0.0, np.inf),
                                min_spread=SPEED_SPREAD, factors=SPEED_FACTORS)
        title = f"forward speed: {name.replace('_', ' ')} versus velocity_x"
        comparisons.append((*judge_agreement(found, tolerances), agreement_panel(found, tolerances, title)))
    return comparisons


def compare_speed(motion: Motion, name: str) -> Agreement | None:
    """Agreement of another source of the speed, by its name in `motion.speeds`, with the forward speed of the INS."""
    return compare_series(motion.time, motion.velocity_x, *motion.speeds[name], SPEED_CUTOFF, biased=False)
