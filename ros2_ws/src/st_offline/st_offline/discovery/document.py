"""The files of a discovery: discovery.json (schema in docs/manual/discovery.md) and model.yaml."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from st_core.discovery import Discovery
from st_core.model_file import Interval, ModelFile, Provenance
from st_recordings.plain_json import finite
from st_recordings.results import versions

from .mending import Mended
from .question import Question

SCHEMA = 2


def document(found: Discovery, question: Question, mended: Mended | None,
             seconds: Mapping[str, float]) -> dict[str, Any]:
    """The content of discovery.json."""
    changes = {} if mended is None else {
        key: dict(zip(("before", "after", "interval"), (before, after, (low, high)), strict=True))
        for key, (before, after, low, high) in mended.changes.items()}
    files = {"vehicle.yaml": {"folded": mended.folded if mended else (), "kept": mended.kept if mended else {},
                              "changes": changes}}
    return {"schema": SCHEMA, **finite(found.document()), "mended": finite(files),
            "provenance": finite(provenance(found, question, seconds))}


def provenance(found: Discovery, question: Question, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Everything the answer depends on."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehicle": {"name": question.vehicle.name, "file": question.vehicle_file, "hash": question.vehicle.hash},
        "base": {"model": question.base, "values": {e: dict(v) for e, v in found.base.values.items()
                                                    if _not_null(found, e)}},
        "settings": asdict(question.settings),
        "runs": {d.name: d.about for d in question.runs if d.log is not None},
        "reference": {d.name: d.about for d in question.reference if d.log is not None},
        "refused": {d.name: d.about["findings"] for d in (*question.runs, *question.reference)
                    if d.problem and d.about},
        "not_used": {d.name: d.problem for d in (*question.runs, *question.reference) if d.problem},
        "effects_of_the_user": dict(question.effects),
        "versions": versions(),
        "seconds": dict(seconds),
    }


def _not_null(found: Discovery, name: str) -> bool:
    effect = next(e for e in found.base.effects if e.name == name)
    return any(p.fit and found.base.values[name][p.name] != p.null for p in effect.parameters)


def model_file(found: Discovery, question: Question, mended: Mended) -> ModelFile | None:
    """What vehicle.yaml does not hold, on that vehicle; None where nothing is left. Effects at null are left out.

    With a reference a value may be a change against it; the interval is moved to the total.
    """
    intervals: dict[tuple[str, str], Interval] = {}
    for one in found.effects:
        for name, p in one.parameters.items():
            assert found.model is not None  # it holds the effects
            total = found.model.values[one.name][name]
            low, high = (total + edge - p.value for edge in p.interval)
            intervals[one.name, name] = (min(low, total), max(high, total))
    files = {f"{d.name}: {Path(name).name}": digest for d in (*question.runs, *question.reference) if d.log is not None
             for name, digest in d.about["files"].items()}
    beside = f", beside vehicle.yaml with {', '.join(mended.folded)}" if mended.folded else ""
    note = f"st discover, outcome {found.outcome}, from {question.base}{beside}"
    about = Provenance(f"{datetime.now(UTC):%Y-%m-%d}", data=files, note=note)
    chosen = {e.name for e in found.effects}
    whole = ModelFile.of(mended.model, mended.vehicle, about, intervals, "st discover: found in the runs")
    learnt = "st discover: the healthy car's, from the reference drives" if question.reference else "part of the base"
    kept = {}
    for effect in mended.model.effects:
        values = mended.model.values[effect.name]
        if all(values[p.name] == p.null for p in effect.parameters if p.fit):
            continue
        estimates = whole.effects[effect.name]
        kept[effect.name] = estimates if effect.name in chosen else {
            p.name: replace(estimates[p.name], source=learnt) if p.fit else estimates[p.name]
            for p in effect.parameters}
    if not kept:
        return None
    return ModelFile(whole.base, kept, whole.vehicle, whole.vehicle_name, whole.vehicle_hash, about)
