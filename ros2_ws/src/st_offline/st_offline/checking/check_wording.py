"""What a check found, in words: the same in the terminal, on every page and in every verb."""

import math
from collections.abc import Sequence

from st_core.checks import Advice, Checked, Finding, Severity

MOST_STRETCHES = 4
MOST_LISTED = 3  # findings in a headline
GRAVITY = (Severity.ERROR, Severity.WARNING, Severity.NOTE)
MEANING = {
    Severity.ERROR: "an evaluation would be meaningless", Severity.WARNING: "an evaluation would be biased",
    Severity.NOTE: "harmless here",
}
QUANTITIES = {"yaw_rate_bias": "rad/s", "yaw_offset": "rad", "heading_misaligned": "rad", "steering_offset": "rad",
              "position_reference": "m", "measuring_point": "m"}
PLACE = {"run.yaml": "in its run.yaml: ", "vehicle": "in the vehicle file: ", "option": "with the option ", "look": ""}


def gravity(finding: Finding) -> int:
    """Sorts by severity, errors first; findings of one severity stay in their order."""
    return GRAVITY.index(finding.severity)


def counts(findings: Sequence[Finding]) -> str:
    """"2 errors, 1 warning"; empty for none."""
    numbers = ((severity.value, sum(one.severity is severity for one in findings)) for severity in GRAVITY)
    return ", ".join(f"{count} {name}{'' if count == 1 else 's'}" for name, count in numbers if count)


def verdict(checked: Checked) -> str:
    """One line on a run: how many findings, and what they mean for an evaluation."""
    if not checked.findings:
        count = len(checked.identities)
        compared = f"in {count} comparison{'' if count == 1 else 's'}" if count else "but there was nothing to compare"
        return f"nothing found, {compared}"
    worst = min(checked.findings, key=gravity).severity
    if worst is Severity.WARNING and all(one.of_acceleration for one in checked.of(worst)):
        return f"{counts(checked.findings)}: identify and discover would be misled"
    return f"{counts(checked.findings)}: {MEANING[worst]}"


def answer(checked: Checked) -> str:
    """Verdict with the most severe findings."""
    if not checked.findings:
        return verdict(checked)
    worst = min(checked.findings, key=gravity).severity
    texts = [one.text for one in checked.findings if one.severity is worst]
    more = f"; and {len(texts) - MOST_LISTED} more" if len(texts) > MOST_LISTED else ""
    return f"{counts(checked.findings)}: {'; '.join(texts[:MOST_LISTED])}{more}"


def unit(text: str) -> str:
    return "" if text == "1" else text.replace("^2", "²")


def number(value: float | None, interval: Sequence[float] | None = None, of: str = "1") -> str:
    """An estimate with the digits its interval bears: "57.30 ± 0.02 m"; empty for none."""
    if value is None:
        return ""
    ending = f" {unit(of)}" if unit(of) else ""
    if interval is None or not interval[1] > interval[0]:
        return f"{value:.4g}{ending}"
    low, high = value - interval[0], interval[1] - value
    decimals = min(max(1 - math.floor(math.log10(0.5 * (low + high)) + 1e-6), 0), 6)
    if min(low, high) <= 0.0 or max(low, high) > 1.5 * min(low, high):
        return f"{value:.{decimals}f} ({interval[0]:.{decimals}f} to {interval[1]:.{decimals}f}){ending}"
    return f"{value:.{decimals}f} ± {0.5 * (low + high):.{decimals}f}{ending}"


def estimate(finding: Finding) -> str:
    return number(finding.value, finding.interval, finding.unit)


def quantity(name: str, value: Sequence[float]) -> str:
    """An estimate (value, low, high) by the name of the finding it would be."""
    kind = name.rpartition("_")[2]
    of = QUANTITIES.get(name, {"lag": "s", "bias": "m/s^2"}.get(kind, "1"))
    return number(value[0], value[1:], of)


def where(finding: Finding) -> str:
    """The stretches of the run, or "whole run"."""
    if not finding.where:
        return "whole run"
    shown = ", ".join(_stretch(*ends) for ends in finding.where[:MOST_STRETCHES])
    more = len(finding.where) - MOST_STRETCHES
    return shown + (f" and {more} more" if more > 0 else "")


def _stretch(start: float, end: float) -> str:
    first, last = f"{start:.1f}", f"{end:.1f}"
    return f"{first} s" if first == last else f"{first} to {last} s"


def effect(finding: Finding) -> str:
    """What it does to a position after 5 s; empty where that means nothing."""
    if finding.of_acceleration:
        return "no effect on a prediction, but identify and discover are misled"
    if finding.effect is None:
        return "no prediction would mean anything" if finding.severity is Severity.ERROR else ""
    size = f"{finding.effect:.0f}" if finding.effect >= 10.0 else f"{finding.effect:.2g}"
    return f"shifts the position after 5 s by about {size} m"


def correction(found: Advice | None) -> str:
    """What corrects it and where that is written; empty where nothing is known."""
    return f"{PLACE[found.kind]}{found.line}" if found else ""


def line(finding: Finding) -> str:
    """Everything in one line, for verbs that speak of other things."""
    parts = [f"{finding.severity.value}: {finding.text}", where(finding), effect(finding)]
    text = " | ".join(part for part in parts if part)
    if finding.advice is None:
        return text
    return f"{text} | {'correction' if PLACE[finding.advice.kind] else 'advice'}: {correction(finding.advice)}"
