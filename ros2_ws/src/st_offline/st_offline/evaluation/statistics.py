"""Content of evaluation.json for one run: plain values, from a LogEvaluation (docs/manual/evaluation.md)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from st_core.binning import bins
from st_core.log_evaluation import ALL, AXES, LogEvaluation, ModelErrors

from .drive_parts import DrivePart, assign

KINDS = ("mean", "max", "rmse")

Entry = dict[str, Any]


def entry(errors: ModelErrors, select: np.ndarray | slice = ALL) -> Entry:
    """Statistics over horizon means, and under `samples` over all points of all horizons; None where nothing counts."""
    complete = errors.complete[select]
    count = int(complete.sum())
    return {
        "n_starts": count, "n_incomplete": len(complete) - count,
        **{axis: _kinds(*values) for axis, values in errors.by_axis("means", select).items()},
        "samples": {"n_starts": count, **{axis: _kinds(*v) for axis, v in errors.by_axis("samples", select).items()}},
    }


def by_model(evaluation: LogEvaluation, select: np.ndarray | slice = ALL) -> dict[str, dict[str, Entry]]:
    """{model: {mode: entry}} over the selected starts (rows)."""
    return {model: {mode: entry(evaluation.errors[model, mode], select) for mode in evaluation.modes}
            for model in evaluation.models}


def by_second(evaluation: LogEvaluation) -> dict[str, dict[str, dict[str, Entry]]]:
    """{model: {mode: {second: {axis: {mean, max, rmse}}}}}: the error at 1, 2, ... s, over the complete starts."""
    return {model: {mode: _seconds(evaluation.errors[model, mode]) for mode in evaluation.modes}
            for model in evaluation.models}


def _seconds(errors: ModelErrors) -> dict[str, Entry]:
    values = errors.at_seconds[errors.complete]
    if not len(values):
        return {}
    return {str(k + 1): {axis: _kinds(float(v.mean()), float(np.abs(v).max()), float(np.sqrt(np.square(v).mean())))
                         for axis, v in zip(AXES, values[:, k].T, strict=True)} for k in range(values.shape[1])}


def by_bin(evaluation: LogEvaluation) -> list[Entry]:
    """One entry for each bin with a start; see st_core.binning."""
    return [{"quantity": b.quantity, "label": b.label, "low": b.low, "high": b.high,
             "models": by_model(evaluation, b.select)} for b in bins(evaluation)]


def by_manoeuvre(evaluation: LogEvaluation, parts: Sequence[DrivePart]) -> list[Entry]:
    """One entry for each part of the drive; a start belongs to the part that contains the middle of its horizon."""
    middles = evaluation.time + 0.5 * float(evaluation.horizon[-1])
    return [{"name": part.name, "start": part.start, "end": part.end,
             "heading_change_deg": math.degrees(part.heading_change), "models": by_model(evaluation, rows)}
            for part, rows in zip(parts, assign(parts, middles), strict=True)]


def pooled(entries: Sequence[Mapping[str, Mapping[str, Entry]]]) -> dict[str, dict[str, Entry]]:
    """{model: {mode: entry}} of several such documents together, as if their starts were those of one run."""
    found: dict[str, dict[str, list[Entry]]] = {}
    for document in entries:
        for model, modes in document.items():
            for mode, one in modes.items():
                found.setdefault(model, {}).setdefault(mode, []).append(one)
    return {model: {mode: _joined(parts) for mode, parts in modes.items()} for model, modes in found.items()}


def pooled_by(entries: Sequence[Entry], *keys: str) -> list[Entry]:
    """Entries that agree in `keys` joined into one, in order of first appearance of each."""
    groups: dict[tuple, list[Entry]] = {}
    for one in entries:
        groups.setdefault(tuple(one[key] for key in keys), []).append(one)
    return [{**{k: v for k, v in group[0].items() if k in {*keys, "low", "high"}}, "count": len(group),
             "models": pooled([one["models"] for one in group])} for group in groups.values()]


def _joined(entries: Sequence[Entry]) -> Entry:
    joined: Entry = {key: sum(e[key] for e in entries) for key in ("n_starts", "n_incomplete") if key in entries[0]}
    for axis in AXES:
        known = [(e["n_starts"], e[axis]) for e in entries if e["n_starts"]]
        total = sum(n for n, _ in known)
        joined[axis] = _kinds(
            sum(n * v["mean"] for n, v in known) / total, max(v["max"] for _, v in known),
            math.sqrt(sum(n * v["rmse"] ** 2 for n, v in known) / total)) if total else _kinds(*[math.nan] * 3)
    if "samples" in entries[0]:
        joined["samples"] = _joined([e["samples"] for e in entries])
    return joined


def _kinds(*values: float) -> Entry:
    """JSON has no NaN: nothing scored is None."""
    return {kind: float(v) if math.isfinite(v) else None for kind, v in zip(KINDS, values, strict=True)}
