"""check.json, and findings as plain values. The schema: docs/manual/checks.md."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from st_core.checks import SCHEMA, Advice, Checked, Finding, Identity, Severity, across_runs
from st_core.vehicle import VehicleParameters
from st_recordings.plain_json import finite
from st_recordings.results import versions

from . import check_wording as words


@dataclass(frozen=True)
class CheckedRun:
    """One run of `st check`. vehicle_from: file or recording. warnings: of the reading, with what was corrected."""

    name: str
    checked: Checked
    vehicle: VehicleParameters
    vehicle_from: str
    duration: float
    warnings: tuple[str, ...]
    files: Mapping[str, str]


@dataclass(frozen=True)
class FailedRun:
    """One that could not be read, and why."""

    name: str
    problem: str


def documents(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Findings as JSON has them."""
    return [finite(one.as_dict()) for one in findings]


def findings_in(about: Mapping[str, Any]) -> list[Finding]:
    """Findings of a run, read from a report (its key "findings")."""
    return [_finding(entry) for entry in about.get("findings", ())]


def _finding(entry: Mapping[str, Any]) -> Finding:
    values = dict(entry)
    advice = values.pop("cure")
    interval = tuple(entry["interval"]) if entry["interval"] else None
    return Finding(**{**values, "severity": Severity(entry["severity"]), "channels": tuple(entry["channels"]),
                      "interval": interval, "where": tuple(map(tuple, entry["where"])),
                      "advice": Advice(**advice) if advice else None,
                      "tried": tuple(entry["tried"]) if entry.get("tried") else None})


def document(good: Sequence[CheckedRun], failed: Sequence[FailedRun]) -> dict[str, Any]:
    """The content of check.json."""
    return {
        "schema": SCHEMA,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "vehicle": {source: {"name": car.name, "hash": car.hash}
                    for source, car in {run.vehicle_from: run.vehicle for run in good}.items()},
        "runs": {run.name: _run(run) for run in good},
        "together": [finite(one.as_dict()) for one in across_runs([run.checked for run in good])],
        "failed": {run.name: run.problem for run in failed},
    }


def _run(run: CheckedRun) -> dict[str, Any]:
    return {
        "verdict": words.verdict(run.checked), "vehicle": run.vehicle_from, "duration": run.duration,
        **finite(run.checked.as_dict()),
        "identities": [finite(_identity(one)) for one in run.checked.identities],
        "warnings": list(run.warnings), "files": dict(run.files),
    }


def _identity(one: Identity) -> dict[str, Any]:
    return {"name": one.name, "title": one.title, "unit": one.unit, "samples": len(one.time),
            "residual_rms": residual_rms(one), "findings": list(one.findings)}


def residual_rms(one: Identity) -> float:
    """Root mean square of measured minus derived, in the unit of the identity; NaN where nothing is known of both."""
    apart = np.asarray(one.measured) - np.asarray(one.derived)
    apart = apart[np.isfinite(apart)]
    return float(np.sqrt(np.square(apart).mean())) if len(apart) else float("nan")
