"""What runs say of bands as sums, so that runs can be added; and the shares and means made of them."""

from collections.abc import Mapping, Sequence
from typing import Any

Sums = dict[str, Any]
ENOUGH = 200
"""Starts of a cell from which on its coverage counts: below, chance alone moves 90 % by more than two."""


def pooled_sums(entries: Sequence[Sums]) -> Sums:
    """Several nested sums added, key by key; lists joined."""
    total: Sums = {}
    for one in entries:
        _add(total, one)
    return total


def _add(total: Sums, one: Mapping[str, Any]) -> None:
    for key, value in one.items():
        if isinstance(value, Mapping):
            _add(total.setdefault(key, {}), value)
        elif isinstance(value, list):
            total[key] = [*total.get(key, []), *value]
        else:
            total[key] = total.get(key, 0) + value


def finished(sums: Sums) -> dict[str, Any]:
    """{model: {mode: shares and means}} and what is said beside them; None where no start had a band."""
    return {"known_recordings": sums.get("known_recordings", []),
            "models": {model: {mode: _question(one) for mode, one in modes.items()}
                       for model, modes in sums.get("models", {}).items()}}


def _question(sums: Sums) -> dict[str, Any]:
    count = sums["starts"]
    means = _divided({key: sums[key] for key in ("coverage", "axes", "seconds", "interval_score", "crps", "half_width",
                                                 "reliability") if key in sums}, count)
    conditions = [{"quantity": quantity, "label": label, "starts": one["starts"],
                   "coverage": _divided(one["coverage"], one["starts"])}
                  for quantity, labels in sums["conditions"].items() for label, one in labels.items()]
    return {"starts": count, "without_band": sums["without_band"], **means, "conditions": conditions,
            "worst_cell": worst_cell(sums["cells"])}


def _divided(value: Any, count: int) -> Any:
    if isinstance(value, Mapping):
        return {key: _divided(one, count) for key, one in value.items()}
    return value / count if count else None


def worst_cell(cells: Mapping[str, Mapping[str, Any]], level: str = "0.9") -> dict[str, Any] | None:
    """The cell of at least ENOUGH starts with the least coverage at a level; None without one."""
    known = [(one["coverage"][level] / one["starts"], name, one["starts"]) for name, one in cells.items()
             if one["starts"] >= ENOUGH and level in one["coverage"]]
    if not known:
        return None
    share, name, starts = min(known)
    return {"cell": name, "coverage": share, "starts": starts}
