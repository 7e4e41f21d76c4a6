"""Block F: compares the answer for edited drives with the answer for the drives as recorded.

The value before the edit is that of a stated effect, or else of a candidate, in the answer for the drives as recorded.
"""

from dataclasses import dataclass
from typing import Any

from .edits import EDITS
from .effects import null_value

Record = dict[str, Any]
Stated = dict[tuple[str, str], tuple[float, float, float]]
"""(effect, parameter) -> value, low, high."""


@dataclass(frozen=True)
class EditComparison:
    """Comparison for one edit."""

    # Whether the interval of the stated value contains the expected one, or the effect is an alternative of another.
    moved: bool
    others: tuple[str, ...]  # other effects of which a value has changed
    expected: float  # value of the edited parameter
    stated: tuple[float, float, float] | None


def compare_edit(plain: Record, r: Record) -> EditComparison:
    edit = EDITS[r["kind"]]
    before, after = stated_values(plain), stated_values(r)
    key = edit.effect, edit.parameter
    start = before[key][0] if key in before else plain["on_top"][edit.effect][edit.parameter]
    expected = edit.expected(start, r["size"])
    if edit.effect == "steering_offset" and ("steering_ratio", "factor") in before:
        # An offset of the recorded angle is divided by the steering ratio.
        expected = start - r["size"] / before["steering_ratio", "factor"][0]
    value = after.get(key)
    moved = value[1] <= expected <= value[2] if value else edit.effect in alternatives(r)
    others = {k for k in (*before, *after) if k[0] != edit.effect and not _same(k, before, after, plain, r)}
    return EditComparison(moved, tuple(sorted({effect for effect, _ in others})), expected, value)


def stated_values(r: Record) -> Stated:
    return {(e["name"], n): tuple(v) for e in r["effects"] for n, v in e["values"].items()}


def alternatives(r: Record) -> set[str]:
    return {name for e in r["effects"] for name in e["alternatives"]}


def _same(key: tuple[str, str], before: Stated, after: Stated, plain: Record, r: Record) -> bool:
    """Whether one of the two values is inside the interval of the other.

    A value that is not stated is null, unless its effect has become an alternative of a stated one.
    """
    effect = key[0]
    if key in before and key in after:
        (a, a_low, a_high), (b, b_low, b_high) = before[key], after[key]
        return a_low <= b <= a_high or b_low <= a <= b_high
    if effect in alternatives(r if key in before else plain):
        return True
    _, low, high = before.get(key) or after[key]
    return low <= null_value(*key) <= high
