"""The files of a discovery: discovery.json (schema in docs/manual/discovery.md), model.yaml and the report."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from st_core.discovery import Discovery
from st_core.discovery.result import FittedParameter
from st_core.model_file import Interval, ModelFile, Provenance
from st_recordings.plain_json import finite
from st_recordings.results import versions

from ..evaluation.drawing import Drawn
from ..pages import template
from . import quantities, report_text
from .relation_report import RelationReport
from .request import Request
from .vehicle_update import VehicleUpdate

SCHEMA = 2
VERDICTS = ("stated", "alternative", "bound")  # first in the table of all effects


def document(found: Discovery, request: Request, update: VehicleUpdate | None,
             seconds: Mapping[str, float]) -> dict[str, Any]:
    """The content of discovery.json."""
    changes = {} if update is None else {
        key: dict(zip(("before", "after", "interval"), (before, after, (low, high)), strict=True))
        for key, (before, after, low, high) in update.changes.items()}
    files = {"vehicle.yaml": {"folded": update.folded if update else (), "kept": update.kept if update else {},
                              "changes": changes, "error": update.error if update else (),
                              "objections": update.objections if update else ()}}
    return {"schema": SCHEMA, **finite(found.document()), "mended": finite(files),
            "provenance": finite(provenance(found, request, seconds))}


def provenance(found: Discovery, request: Request, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Everything the answer depends on."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehicle": {"name": request.vehicle.name, "file": request.vehicle_file, "hash": request.vehicle.hash},
        "base": {"model": request.base, "values": {e: dict(v) for e, v in found.base.values.items()
                                                    if _not_null(found, e)}},
        "settings": asdict(request.settings),
        "runs": {d.name: d.about for d in request.drives if d.log is not None},
        "reference": {d.name: d.about for d in request.healthy if d.log is not None},
        "refused": {d.name: d.about["findings"] for d in (*request.drives, *request.healthy)
                    if d.problem and d.about},
        "not_used": {d.name: d.problem for d in (*request.drives, *request.healthy) if d.problem},
        "effects_of_the_user": dict(request.own_effects),
        "versions": versions(),
        "seconds": dict(seconds),
    }


def _not_null(found: Discovery, name: str) -> bool:
    effect = next(e for e in found.base.effects if e.name == name)
    return any(p.fit and found.base.values[name][p.name] != p.null for p in effect.parameters)


def model_file(found: Discovery, request: Request, update: VehicleUpdate) -> ModelFile | None:
    """What vehicle.yaml does not hold, on that vehicle; None where nothing is left. Effects at null are left out.

    With a reference a value may be a change against it; the interval is moved to the total.
    """
    intervals: dict[tuple[str, str], Interval] = {}
    for one in found.effects:
        for name, p in one.parameters.items():
            assert found.named is not None  # it holds the effects
            total = found.named.values[one.name][name]
            low, high = (total + edge - p.value for edge in p.interval)
            intervals[one.name, name] = (min(low, total), max(high, total))
    files = {f"{d.name}: {Path(name).name}": digest for d in (*request.drives, *request.healthy) if d.log is not None
             for name, digest in d.about["files"].items()}
    companion = f", used with the vehicle.yaml that has {', '.join(update.folded)}" if update.folded else ""
    note = f"st discover, outcome {found.outcome}, from {request.base}{companion}"
    about = Provenance(f"{datetime.now(UTC):%Y-%m-%d}", data=files, note=note)
    stated = {e.name: e.parameters for e in found.effects}
    whole = ModelFile.of(update.model, update.vehicle, about, intervals, "st discover: found in the runs")
    learnt = "st discover: the healthy car's, from the reference drives" if request.healthy else "part of the base"
    minor = {e.name for e in found.minor}
    kept = {}
    for effect in update.model.effects:
        name, values = effect.name, update.model.values[effect.name]
        if all(values[p.name] == p.null for p in effect.parameters if p.fit):
            continue
        effective = name in update.folded or found.named is None or (
            not _inside(values, stated[name]) if name in stated
            else name not in minor and values != found.named.values.get(name))
        if name in stated and not effective:
            kept[name] = whole.effects[name]
            continue
        source = ("st discover: effective correction" if effective else
                  "st discover: too small to be named" if name in minor else learnt)
        kept[name] = {p.name: replace(whole.effects[name][p.name], source=source, effective=effective,
                                      interval=None if effective else whole.effects[name][p.name].interval)
                      if p.fit else whole.effects[name][p.name] for p in effect.parameters}
    if not kept:
        return None
    return ModelFile(whole.base, kept, whole.vehicle, whole.vehicle_name, whole.vehicle_hash, about)


def _inside(values: Mapping[str, float], parameters: Mapping[str, FittedParameter]) -> bool:
    return all(p.interval[0] <= values[name] <= p.interval[1] for name, p in parameters.items())


def write_page(file: Path, found: Discovery, update: VehicleUpdate | None, content: dict[str, Any],
               figures: Sequence[Drawn], law: RelationReport | None = None) -> None:
    """content: of discovery.json. law: of the relation proposed beyond the library."""
    about = content["provenance"]
    refused = {name: {"findings": findings} for name, findings in about["refused"].items()}
    order = {verdict: place for place, verdict in enumerate(VERDICTS)}
    ranked = sorted(found.candidates, key=lambda c: (order.get(c.verdict, len(order)), -c.gain))
    text = template("discovery", "discovery.html.jinja", plain=quantities.plain, channel=quantities.channel).render(
        title=report_text.title(found), found=found, update=update, verdict=report_text.verdict(found, update),
        content=content, figures=figures, candidates=ranked, words=report_text, law=law,
        quantities=quantities, size=quantities.size, recordings={**refused, **about["runs"], **about["reference"]})
    file.write_text(text, encoding="utf-8")
