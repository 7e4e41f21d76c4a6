"""The keys of a run.yaml that say how a recording is to be understood: columns, units, correct, leave_out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from st_core.corrections import CHANNELS, Correction, check_corrections
from st_core.errors import StCoreError

from .columns import COLUMNS, Layout
from .errors import RunError
from .units import UNITS, unit_named

KEYS = ("columns", "units", "correct", "leave_out")


def understood(path: Path, content: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """layout, correct and leave_out of a run.yaml, where they are given. kind: csv or another. Raises RunError."""
    for key in ("columns", "units"):
        if key in content and kind != "csv":
            raise RunError(path, f"{key}: only a csv has columns; the units of others are known",
                           "correct: changes values of every kind of recording")
    settings: dict[str, Any] = {}
    if "columns" in content or "units" in content:
        settings["layout"] = Layout(_columns(path, content.get("columns", {})), _units(path, content.get("units", {})),
                                    path)
    if "correct" in content:
        settings["correct"] = _corrections(path, content["correct"])
    if "leave_out" in content:
        settings["leave_out"] = _stretches(path, content["leave_out"])
    return settings


def _columns(path: Path, value: Any) -> dict[str, str]:
    for channel, name in _mapping(path, "columns", value, COLUMNS).items():
        if not isinstance(name, str) or not name:
            raise RunError(path, f"columns: {channel}: {name!r} is not the name of a column", "put it in quotes")
    return dict(value)


def _units(path: Path, value: Any) -> dict[str, str]:
    units = {}
    for channel, text in _mapping(path, "units", value, COLUMNS).items():
        kind = COLUMNS[channel].kind
        unit = unit_named(kind, text) if isinstance(text, str) else None
        if unit is None:
            raise RunError(path, f"units: {channel}: {str(text)[:40]!r} is no unit of {kind}",
                           f"known are {', '.join(UNITS[kind])}")
        units[channel] = unit
    return units


def _corrections(path: Path, value: Any) -> dict[str, Correction]:
    corrections = {}
    for channel, given in _mapping(path, "correct", value, CHANNELS).items():
        taken = CHANNELS[channel]
        entries = _mapping(path, f"correct: {channel}", given, taken)
        for key, number in entries.items():
            if isinstance(number, bool) or not isinstance(number, int | float) or not np.isfinite(number):
                raise RunError(path, f"correct: {channel}: {key}: {str(number)[:40]!r} is not a number")
        corrections[channel] = Correction(**{key: float(number) for key, number in entries.items()})
    try:
        check_corrections(corrections)
    except StCoreError as error:
        raise RunError(path, f"correct: {error}") from None
    return corrections


def _stretches(path: Path, value: Any) -> tuple[tuple[float, float], ...]:
    try:
        stretches = tuple((float(start), float(end)) for start, end in value)
    except (TypeError, ValueError):
        stretches = ((np.nan, np.nan),)
    for start, end in stretches:
        if not start < end:
            raise RunError(path, "leave_out: a list of [start, end] is wanted, in seconds after the first INS "
                           "measurement, start before end")
    return stretches


def _mapping(path: Path, key: str, value: Any, known: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RunError(path, f"{key}: a mapping is wanted", f"known keys are {', '.join(known)}")
    unknown = [name for name in value if name not in known]
    if unknown:
        raise RunError(path, f"{key}: {unknown[0]} is not known", f"known are {', '.join(known)}")
    return value
