"""Channels that are derivatives of others, whatever the car.

    r = d(yaw)/dt        a_x = dv_x/dt - v_y r        a_y = dv_y/dt + v_x r

An accelerometer feels gravity as well: a slope is a bias of a_x, a banked road or a mounting angle one of a_y. It may
sit a metre or two from the point of the velocities; at speed v that looks like a lag of distance / v in a_y.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .finding import HORIZON, LIMITS, WHEEL_SCALE, Advice, Finding, Identity, Severity
from .motion import MOVING, Motion, sideways
from .regression import Agreement, Estimate, agreement, with_systematic


@dataclass(frozen=True)
class Expected:
    """Smallest errors of a channel that are reported.

    against: name of the reference. unit: of the channel. lag [s], bias [unit]: smallest that are reported; scale:
    smallest deviation from 1. grave: (lag, scale, bias) from which on the finding is a warning whatever its effect on a
    prediction, since identification and discovery use the channel too. reach: position after 5 s per unit of
    error [m]. correlation: below which the two are not compared.
    least_spread: standard deviation of the channel below which no lag is reported [unit].
    factors: names of units by their factor. why: possible causes of a bias, for the text.
    """

    channel: str
    against: str
    unit: str
    lag: float
    scale: float
    bias: float
    grave: tuple[float, float, float]
    reach: float = 0.0
    least_spread: float = 0.0
    correlation: float = LIMITS.correlation
    factors: Mapping[float, str] = field(default_factory=dict)
    why: str = ""


def judged(found: Agreement | None, expected: Expected, scale_before: float = 1.0,
           ) -> tuple[list[Finding], dict[str, Estimate]]:
    """(findings, estimates by the name of their finding). scale_before: factor that was taken out already."""
    if found is None or abs(found.correlation) < min(expected.correlation, LIMITS.correlation):
        return [], {}
    name, findings = expected.channel, []
    scale, lag, bias = (with_systematic(f"{name}_{kind}", getattr(found, kind)) for kind in ("scale", "lag", "bias"))
    if abs(found.correlation) < expected.correlation:  # noise of either makes the scale and the bias wrong, not the lag
        return ([_lag(found, lag, expected)] if _is_lag(found, lag, expected) else []), (
            {f"{name}_lag": lag} if found.carries_lag else {})
    factor = None if _diluted(scale, found) else _factor(scale.value, expected)
    if factor is not None:
        findings.append(_gross(scale, factor, expected))
    elif abs(scale.value - 1.0) >= expected.scale and scale.shifted(-1.0).significant and not _diluted(scale, found):
        text = f"{name} is {in_words(scale)} times its value from {expected.against}"
        findings.append(_finding("scale", text, scale, "1", abs(scale.value - 1.0) * found.spread, expected,
                             {"scale": 1.0 / scale.value}, abs(scale.value - 1.0) >= expected.grave[1]))
    # A scale that is reported is divided out before the bias is subtracted.
    size, divided = abs(scale.value), scale.value if findings else 1.0
    if _is_lag(found, lag, expected):
        findings.append(_lag(found, lag, expected))
    if bias.significant and abs(bias.value) / size >= expected.bias and factor is None:
        side = "high" if bias.value > 0.0 else "low"
        unit = expected.unit.replace("^2", "²")
        text = f"{name} is {size_of(bias)} {unit} too {side} against {expected.against}{expected.why}"
        findings.append(_finding("bias", text, bias, expected.unit, abs(bias.value) / size, expected,
                             {"add": -bias.value / divided}, abs(bias.value) / size >= expected.grave[2]))
    return findings, {**({f"{name}_lag": lag} if found.carries_lag else {}),
                  f"{name}_scale": scale.scaled(scale_before), f"{name}_bias": bias}


def _diluted(scale: Estimate, found: Agreement) -> bool:
    """Whether noise of the derived quantity explains a scale below 1: regression on a noisy quantity gives between r^2
    and 1 of the true slope (Fuller 1987, Measurement Error Models, 1.1)."""
    return scale.value < 1.0 and scale.value / found.correlation**2 + scale.half > 1.0


def _is_lag(found: Agreement, lag: Estimate, expected: Expected) -> bool:
    return lag.significant and found.late and abs(lag.value) >= expected.lag and found.spread >= expected.least_spread


def _lag(found: Agreement, lag: Estimate, expected: Expected) -> Finding:
    rate = float(np.std(np.gradient(found.derived, found.time)))
    text = (f"{expected.channel} {'lags' if lag.value > 0.0 else 'leads'} {expected.against} by {size_of(lag)} s"
            f"{or_else(found)}")
    if abs(found.correlation) < expected.correlation:
        text += f"; their correlation is only {abs(found.correlation):.2f}, so scale and bias are not judged"
    return _finding("lag", text, lag, "s", abs(lag.value) * rate, expected, {"earlier": lag.value},
                    abs(lag.value) >= expected.grave[0])


def in_words(one: Estimate) -> str:
    """value ± half of the 95 % interval, to two digits of that."""
    digits = min(max(1 - math.floor(math.log10(one.half)), 0), 6) if one.half > 0.0 else 3
    return f"{one.value:.{digits}f} ± {one.half:.{digits}f}"


def size_of(one: Estimate) -> str:
    """As in_words, without the sign."""
    return in_words(one).removeprefix("-")


def or_else(found: Agreement, response: float = 0.0) -> str:
    """Other lags that fit as well, as text; response: of the car, included in the reported lag [s]."""
    other = sorted(late + response for late in found.alike)
    named = " or ".join(f"{'lags' if late > 0.0 else 'leads'} by {abs(late):.2f} s" for late in other)
    return f" (or {named}: the drive repeats itself, and that fits as well)" if named else ""


def _factor(scale: float, expected: Expected) -> float | None:
    """The unit or sign that a scale is, the scale itself where it is far from 1 and none of them, None near 1."""
    if 1.0 / LIMITS.channel_unit < scale < LIMITS.channel_unit:
        return None
    signed = [sign * factor for factor in (1.0, *expected.factors) for sign in (1.0, -1.0)][1:]
    near = [f for f in signed if f * scale > 0.0 and 1.0 / LIMITS.channel_unit < scale / f < LIMITS.channel_unit]
    return min(near, key=lambda f: abs(np.log(scale / f)), default=scale)


def _gross(scale: Estimate, factor: float, expected: Expected) -> Finding:
    other_way = "it counts the other way" if factor < 0.0 else ""
    reason = " and ".join(filter(None, (expected.factors.get(abs(factor), ""), other_way)))
    text = (f"{expected.channel} is {in_words(scale)} times its value from {expected.against}"
            + (f": {reason}?" if reason else ""))
    exact = float(f"{1.0 / factor:.6g}")
    return Finding(f"{expected.channel}_scale", Severity.WARNING, (expected.channel,), text, scale.value, "1",
                   scale.interval, (), None, _advice(expected.channel, {"scale": exact}))


def _finding(kind: str, text: str, one: Estimate, unit: str, error: float, expected: Expected,
             correct: dict[str, float], grave: bool) -> Finding:
    """error: what it makes of the channel, root mean square [unit]."""
    effect = error * expected.reach
    return Finding(f"{expected.channel}_{kind}", LIMITS.severity(effect, grave), (expected.channel,), text, one.value,
                   unit, one.interval, (), effect if expected.reach else None,
                   _advice(expected.channel, {key: float(f"{value:.5g}") for key, value in correct.items()}))


def _advice(channel: str, correct: dict[str, float]) -> Advice:
    """Correction of a channel; for wheel speeds and a second INS output, which a run.yaml cannot correct, a hint."""
    if channel in ("wheel_speed", "ins_speed"):
        return Advice("look", "look at the source of it: unit, wheel radius, clock")
    return Advice.correct(channel, **correct)


def identity(found: Agreement | None, expected: Expected, title: str, measured: float = 1.0,
             derived: float = 1.0) -> Identity | None:
    """Series of a figure. measured, derived: units that were divided out; the figure shows values as recorded."""
    return None if found is None else Identity(
        expected.channel, title, expected.unit, expected.channel, f"from {expected.against}", found.time,
        measured * found.measured, derived * found.derived,
        tuple(f"{expected.channel}_{kind}" for kind in ("scale", "bias", "lag")))


G = 9.80665
GYRO_CUTOFF, ACCELERATION_CUTOFF, SPEED_CUTOFF = 4.0, 1.5, 1.5  # Hz
GYRO_CORRELATION = 0.9  # two outputs of one unit; less is a yaw too coarse to be differentiated
GYRO_SCALE = 0.02  # 1; a gyroscope's scale is known to 1 %
GYRO_BIAS = 0.001  # rad/s; an INS that is in order shows half of it
ACCELERATION_SCALE = 0.35  # 1; a body that rolls and pitches makes up to a third of it
ACCELERATION_LAG = 0.12  # s; filters of accelerometers take up to 0.1 s
LEVER = 1.5  # m between accelerometer and INS point
GRAVE_ACCELERATION = 0.3  # m/s^2; a road's crossfall of 2.5 % is 0.25
SPEED_SPREAD = 0.5  # m/s; at one speed only slip and noise would be compared
WHEEL_LAG = 0.15  # s; wheel speeds are averaged over some turns
FACTORS = {1.0 / G: "g"}
LEANS = ": mounted askew, or the road is not level?"
SPEED_FACTORS = {3.6: "km/h", 2.23694: "mph", 1.0 / 3.6: "divided by 3.6 twice"}

Judged = tuple[list[Finding], dict[str, Estimate], Identity | None]


def yaw_rate(motion: Motion) -> tuple[Agreement | None, Expected]:
    """Against the change of yaw. A model forgets a wrong start of its yaw rate within the settling time."""
    reach = LIMITS.settling * float(np.median(np.abs(motion.velocity_x))) * HORIZON
    found = agreement(motion.time, motion.yaw, motion.time, motion.yaw_rate, GYRO_CUTOFF, True)
    return found, Expected("yaw_rate", "yaw", "rad/s", LIMITS.lag, GYRO_SCALE, GYRO_BIAS,
                           (LIMITS.grave_lag, 0.03, 0.01), reach, correlation=GYRO_CORRELATION)


def turn_lag(motion: Motion) -> float:
    """By how much the yaw rate lags yaw [s], where that hides how they agree; 0 where they agree without it."""
    found = agreement(motion.time, motion.yaw, motion.time, motion.yaw_rate, ACCELERATION_CUTOFF, True)
    if found is None or not (found.late and found.lag.significant) or abs(found.lag.value) < LIMITS.grave_lag:
        return 0.0
    # A yaw rate of the other sign fits half a period later, too.
    now = abs(found.correlation_now)
    return found.lag.value if found.correlation >= LIMITS.correlation and now < found.correlation - 0.05 else 0.0


def corrected_yaw_rate(motion: Motion, found: Agreement) -> Motion:
    """With the lag, scale and bias taken out, where they are known."""
    if found.correlation < LIMITS.correlation:
        return motion
    late = found.lag.value if found.lag.significant and found.late else 0.0
    known = found.correlation >= GYRO_CORRELATION
    rate = (motion.yaw_rate - found.bias.value) / found.scale.value if known else motion.yaw_rate
    return motion.with_(yaw_rate=np.interp(motion.time + late, motion.time, rate))


def accelerations(motion: Motion) -> list[Judged]:
    """Findings of both accelerations against the derivative of velocity; none where its axes are wrong."""
    if sideways(motion):
        return []
    derivative = {"acceleration_x": _slope(motion.time, motion.velocity_x) - motion.velocity_y * motion.yaw_rate,
                  "acceleration_y": _slope(motion.time, motion.velocity_y) + motion.velocity_x * motion.yaw_rate}
    speed = float(np.median(np.abs(motion.velocity_x)))
    lags = {"acceleration_x": ACCELERATION_LAG,
            "acceleration_y": max(ACCELERATION_LAG, LEVER / max(speed, MOVING))}
    channels = {name: values for name in derivative if (values := getattr(motion, name)) is not None}

    def against(name: str, values: np.ndarray) -> Agreement | None:
        return agreement(motion.time, derivative[name], motion.time, values, ACCELERATION_CUTOFF)
    agreements = {name: against(name, values) for name, values in channels.items()}
    crossed = zip(channels, reversed(channels.values()), strict=True)
    if len(channels) == 2 and not any(map(_correlates, agreements.values())) and all(
            _correlates(against(name, values)) for name, values in crossed):
        text = "acceleration_x and acceleration_y are exchanged (x is forward, y left)"
        return [([Finding("acceleration_axes", Severity.WARNING, (*channels,), text, advice=Advice(
            "run.yaml", "columns: {acceleration_x: acceleration_y, acceleration_y: acceleration_x}",
            {"columns": dict(zip(channels, reversed(channels), strict=True))}))], {}, None)]
    findings = []
    for name, found in agreements.items():
        expected = Expected(name, "velocity and yaw rate" if name[-1] == "y" else "velocity", "m/s^2", lags[name],
                            ACCELERATION_SCALE, LIMITS.bias_acceleration, (0.0, 0.0, GRAVE_ACCELERATION),
                            factors=FACTORS, why=LEANS)
        title = f"{'lateral' if name[-1] == 'y' else 'forward'} acceleration: sensor against velocity"
        findings.append((*judged(found, expected), identity(found, expected, title)))
    return findings


def _correlates(found: Agreement | None) -> bool:
    return found is not None and abs(found.correlation) >= LIMITS.correlation


def speeds(motion: Motion) -> list[Judged]:
    """Other sources of the speed against the INS's forward speed."""
    findings = []
    for name in motion.speeds:
        found = speed(motion, name)
        scale, lag = (WHEEL_SCALE, WHEEL_LAG) if name == "wheel_speed" else (0.005, 0.03)
        expected = Expected(name, "velocity_x", "m/s", lag, scale, np.inf, (0.0, 0.0, np.inf),
                            least_spread=SPEED_SPREAD, factors=SPEED_FACTORS)
        title = f"forward speed: {name.replace('_', ' ')} against velocity_x"
        findings.append((*judged(found, expected), identity(found, expected, title)))
    return findings


def speed(motion: Motion, name: str) -> Agreement | None:
    """Another source of the speed against the INS's forward speed."""
    return agreement(motion.time, motion.velocity_x, *motion.speeds[name], SPEED_CUTOFF, biased=False)


def _slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.gradient(values, time) if len(time) > 1 else np.zeros_like(values)
