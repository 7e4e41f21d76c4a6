"""Findings of scale, bias and lag of one channel against the same quantity from others."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .finding import Advice, Finding, Identity, Severity
from .lag import Agreement
from .limits import LIMITS
from .regression import Estimate, with_systematic


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
    half = 0.5 * (one.interval[1] - one.interval[0])
    digits = min(max(1 - math.floor(math.log10(half)), 0), 6) if half > 0.0 else 3
    return f"{one.value:.{digits}f} ± {half:.{digits}f}"


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
    severity = LIMITS.severity(effect)
    if grave and severity is Severity.NOTE:
        severity = Severity.WARNING
    return Finding(f"{expected.channel}_{kind}", severity, (expected.channel,), text, one.value, unit, one.interval, (),
                   effect if expected.reach else None,
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
