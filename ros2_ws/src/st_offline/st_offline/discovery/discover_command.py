"""The command `st discover`: reads recordings, identifies effects, prints the results, and writes them into files."""

import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.progress import Progress
from st_core.augmented import AugmentedModel
from st_core.checks import Severity
from st_core.discovery import Discovery
from st_core.discovery.axles import SMALL_SLIP
from st_core.discovery.decision import MINOR
from st_core.discovery.error_regions import Samples, compute_window_errors
from st_core.discovery.library_fit import apply_clock_corrections
from st_core.effects import load_folder
from st_core.errors import ConfigurationError, add_prefix
from st_core.model_file import Interval, ModelFile, ModelProvenance
from st_core.relations import RelationSearch, find_relation, needs_search
from st_core.vehicle import FILE_QUANTITIES
from st_recordings.car import read_model
from st_recordings.paths import json_text, new_folder
from st_recordings.results import collect_versions
from st_recordings.runs import find_runs
from st_recordings.runs.errors import join_problems

from ..checking.check_report import findings_as_json, get_unit_symbol
from ..evaluation.drawing import FigureOutput, PageFigure, check_formats
from ..pages import Table, load_template
from ..terminal import console, list_files, make_progress_bars, make_table, report_problem
from . import quantities, report_text
from .drives import Drive, Request, get_logs, read_drives, read_or_discover
from .figures import draw_agreement, draw_axle_curves, draw_maps, draw_relation, draw_waterfall
from .relation_report import RelationReport, build_relation_document, report_relation, write_files
from .vehicle_update import VehicleUpdate, update_vehicle

SCHEMA = 4
MAX_ROWS = 8  # of regions, other effects and undetectable effects; discovery.json contains all
FILE_MEANINGS = {
    "report.html": "one page, with all figures", "discovery.json": "all numbers; keys in docs/manual/discovery.md",
    "vehicle.yaml": "the corrected vehicle file, for --vehicle of every command",
    "effects": "the proposed relation as an effect; give its folder as --effects to st evaluate, st demo, st live",
    "proposed.yaml": "a model with the relation, for --model with --effects and the original vehicle file",
    "model.yaml": "effects that are not in the vehicle file, for --model of st demo, st live, st evaluate"}


def run_command(request: Request) -> int:
    """Run the command; returns the exit status: 1 if a run could not be used, else 0. Raises ConfigurationError for
    invalid options or recordings, StCoreError if a search is not possible, OutputError if the folder is unusable."""
    check_formats(request.formats)
    effect_hashes: dict[str, str] = {}
    if request.effects is not None:
        load_folder(str(request.effects.absolute()))
        effect_hashes = {file.name: hashlib.sha256(file.read_bytes()).hexdigest()
                         for file in sorted(request.effects.glob("*.py"))}
    base, *_ = add_prefix("--base ", lambda: read_model(request.base, request.vehicle, request.vehicle_file))
    folder = new_folder(request.output, "discover")
    times = [time.perf_counter()]
    with make_progress_bars() as progress:
        drives, reference = _read_runs(request, progress)
        request = replace(request, drives=drives, reference_drives=reference, effect_hashes=effect_hashes)
        times.append(time.perf_counter())
        discovery, from_cache = read_or_discover(request, base, progress)
        request = replace(request, drives=[
            replace(d, log=apply_clock_corrections([d.log], discovery.clock_errors)[0]) if d.log else d
            for d in drives])
        times.append(time.perf_counter())
        search = None
        if needs_search(discovery) if request.propose is None else request.propose:
            bar = progress.add_task("searching for a relation beyond the library", total=None)
            reported = {(f.name, channel) for d in drives if d.log is not None for f in d.findings
                        if f.severity is not Severity.NOTE for channel in f.channels}
            search = find_relation(discovery, get_logs(request.drives), request.vehicle, request.settings,
                                   request.jobs, lambda: progress.advance(bar), reported)
            times.append(time.perf_counter())
    seconds = dict(zip(("read", "discover", "propose"), np.diff(times).tolist(), strict=False))
    with console.status("drawing, writing the report"):
        output = FigureOutput(folder / "figures", request.formats)
        figures = draw_figures(discovery, request, output) if request.report else None
        if figures is not None and search and search.relation:
            figures.insert(0, draw_relation(search.relation, output))
        update = update_vehicle(discovery, request)
        report = report_relation(search, discovery, request.vehicle, str(folder)) if search else None
        files = write_results(discovery, request, update, folder, figures, seconds, search, report)
    print_result(discovery, update, request.all_drives, files, from_cache, report)
    return 1 if any(d.problem for d in request.all_drives) else 0


def _read_runs(request: Request, progress: Progress) -> tuple[list[Drive], list[Drive]]:
    """(suspect, reference) drives, with distinct names. Raises ConfigurationError if no suspect drive can be used, if
    none of the given reference drives can be used, and for the problems found by `_check_reference`."""
    sources = find_runs(request.runs)
    reference_sources = find_runs(request.reference) if request.reference else []
    if not sources:
        raise ConfigurationError("no recording found: give bags, .ncom with CAN logs, CSV files, run.yaml, or folders")
    bar = progress.add_task("reading the runs", total=len(sources) + len(reference_sources))
    drives = read_drives([*sources, *reference_sources], request.vehicle, request.read_settings, request.jobs,
                         lambda: progress.advance(bar), request.force)
    suspect, reference = drives[:len(sources)], drives[len(sources):]
    if not get_logs(suspect):
        raise ConfigurationError("no run can be used: " + join_problems(d.problem for d in suspect))
    if reference_sources and not get_logs(reference):
        raise ConfigurationError("no --reference run can be used: " + join_problems(d.problem for d in reference))
    _check_reference(suspect, reference)
    names, reference_drives = {d.name for d in suspect}, []
    for drive in reference:  # results identify runs by name
        name = f"{drive.name} (reference)" if drive.name in names else drive.name
        reference_drives.append(replace(drive, name=name, log=replace(drive.log, name=name) if drive.log else None))
    return suspect, reference_drives


def _check_reference(suspect: Sequence[Drive], reference: Sequence[Drive]) -> None:
    """Raise ConfigurationError for a drive given as run and as reference, and for a reference of a different car."""
    suspect_hashes = {digest for d in suspect if d.log is not None for digest in d.metadata["files"].values()}
    cars = {d.metadata["vehicle"]: d.name for d in suspect if d.log is not None and d.metadata["vehicle"]}
    for drive in (d for d in reference if d.log is not None):
        if suspect_hashes & set(drive.metadata["files"].values()):
            raise ConfigurationError(f"{drive.name} is given as a run and as --reference: remove it from one list")
        if (recorded := drive.metadata["vehicle"]) and cars and recorded not in cars:
            car, name = next(iter(cars.items()))
            raise ConfigurationError(f"--reference {drive.name} was recorded with {recorded!r}, {name} "
                                     f"with {car!r}: a reference is a drive of the same car without the fault")


def draw_figures(discovery: Discovery, request: Request, output: FigureOutput) -> list[PageFigure]:
    """Draw the figures of a discovery for which there are data."""
    runs = get_logs(request.drives)
    # discovery.errors contains only the channels that all runs have.
    settings = replace(request.settings, channels=tuple(c for c in discovery.errors if c in request.settings.channels))

    def compute_errors(model: AugmentedModel) -> Samples:
        return compute_window_errors(runs, model, request.vehicle, settings, discovery.acceleration_gain)

    after = compute_errors(discovery.model) if discovery.model else None
    figures = (draw_waterfall(discovery, output), draw_axle_curves(discovery, output),
               draw_maps(discovery, runs, compute_errors(discovery.base), after, output),
               draw_agreement(discovery, output))
    return [figure for figure in figures if figure]


def write_results(discovery: Discovery, request: Request, update: VehicleUpdate | None, folder: Path,
                  figures: Sequence[PageFigure] | None, seconds: dict[str, float],
                  search: RelationSearch | None = None, report: RelationReport | None = None) -> dict[str, Path]:
    """Write all files; returns their paths by kind. figures: for the page; None: no page. report: that of `search`."""
    files = {"discovery.json": folder / "discovery.json"}
    if update is not None:
        model = None if discovery.increases_error else build_model_file(discovery, request, update)
        for name, text in (("vehicle.yaml", update.text), ("model.yaml", model.to_yaml() if model else "")):
            if text:
                files[name] = folder / name
                files[name].write_text(text, encoding="utf-8")
    content = build_document(discovery, request, update, seconds)
    if search:
        content["relation"] = build_relation_document(search)
        created, runs = content["provenance"]["created"], list(content["provenance"]["runs"])
        files |= write_files(search, request.vehicle, runs, created, request.file_hashes, folder)
    files["discovery.json"].write_text(json_text(content), encoding="utf-8")
    if figures is not None:
        files = {"report.html": folder / "report.html", **files}
        write_page(files["report.html"], discovery, update, request.all_drives, content, figures, report)
    return files


def build_document(discovery: Discovery, request: Request, update: VehicleUpdate | None,
                   seconds: Mapping[str, float]) -> dict[str, Any]:
    """The content of discovery.json. seconds: duration of each stage."""
    changes = {} if update is None else {key: {"before": before, "after": after, "interval": (low, high)}
                                         for key, (before, after, low, high) in update.changes.items()}
    file = {"folded": update.folded if update else (), "not_folded": update.not_folded if update else {},
            "changes": changes, "error": update.error if update else (),
            "implausible_values": update.implausible_values if update else ()}
    runs, reference = ({d.name: {**d.metadata, "findings": findings_as_json(d.findings)} for d in drives if d.log}
                       for drives in (request.drives, request.reference_drives))
    provenance = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "vehicle": {"name": request.vehicle.name, "file": request.vehicle_file, "hash": request.vehicle.hash},
        "base": {"model": request.base, "values": {
            e.name: discovery.base.values[e.name] for e in discovery.base.active_effects}},
        "settings": asdict(request.settings),
        "runs": runs,
        "reference": reference,
        "refused": {d.name: findings_as_json(d.findings) for d in request.all_drives if d.problem and d.findings},
        "not_used": {d.name: d.problem for d in request.all_drives if d.problem},
        "user_defined_effects": request.effect_hashes,
        "versions": collect_versions(),
        "seconds": seconds,
    }
    return {"schema": SCHEMA, **discovery.document(), "files": {"vehicle.yaml": file}, "provenance": provenance}


def build_model_file(discovery: Discovery, request: Request, update: VehicleUpdate) -> ModelFile | None:
    """Model file with the effects of `update.model` that are not at their null values; None without any.

    Intervals of changes relative to reference drives are shifted to the total values. Effective corrections: folded
    effects, reported ones outside their intervals, and others, except minor ones, that differ from `discovery.named`.
    """
    intervals: dict[tuple[str, str], Interval] = {}
    for named_effect in discovery.effects:
        for name, p in named_effect.parameters.items():
            assert discovery.named is not None  # because there are reported effects
            total = discovery.named.values[named_effect.name][name]
            low, high = (total + end - p.value for end in p.interval)
            intervals[named_effect.name, name] = (min(low, total), max(high, total))
    companion = f", for the vehicle.yaml corrected for {', '.join(update.folded)}" if update.folded else ""
    note = f"st discover, outcome {discovery.outcome}, from {request.base}{companion}"
    provenance = ModelProvenance(f"{datetime.now(UTC):%Y-%m-%d}", data=request.file_hashes, note=note)
    named = {e.name: e.parameters for e in discovery.effects}
    complete = ModelFile.from_model(update.model, update.vehicle, provenance, intervals)
    base_source = ("st discover: value fitted to the reference drives" if request.reference_drives
                   else "part of the base model")
    minor = {r.subject: r.text for r in discovery.reasons if r.rule == MINOR}
    effects = {}
    for effect in update.model.active_effects:
        name, values = effect.name, update.model.values[effect.name]
        if name in update.folded or discovery.named is None:
            is_effective = True
        elif name in named:
            is_effective = any(not p.interval[0] <= values[key] <= p.interval[1] for key, p in named[name].items())
        else:
            is_effective = name not in minor and values != discovery.named.values.get(name)
        source = ("st discover: effective correction" if is_effective else
                  "st discover: found in the runs" if name in named else
                  f"st discover: minor effect: {minor[name]}" if name in minor else base_source)
        fitted = {p.name for p in effect.parameters if p.fit}
        effects[name] = {parameter: estimate if parameter not in fitted else replace(
            estimate, source=source, effective=is_effective, interval=None if is_effective else estimate.interval)
            for parameter, estimate in complete.effects[name].items()}
    return replace(complete, effects=effects) if effects else None


def write_page(file: Path, discovery: Discovery, update: VehicleUpdate | None, recordings: Sequence[Drive],
               content: dict[str, Any], figures: Sequence[PageFigure], relation: RelationReport | None = None) -> None:
    """Write the page. recordings: all runs, also those that cannot be used. content: content of discovery.json."""
    findings = {drive.name: drive.findings for drive in recordings}
    text = load_template("discovery/discovery.html.jinja").render(
        title=report_text.format_title(discovery), discovery=discovery, content=content, figures=figures,
        relation=relation, report=report_text, summary=report_text.summarise(discovery, update, findings),
        details=report_text.list_details(discovery, update), findings=findings, **_make_tables(discovery, content))
    file.write_text(text, encoding="utf-8")


def _make_tables(discovery: Discovery, content: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables of the page by layout (narrow, wide), without empty ones."""
    metres = quantities.format_metres
    channels = []
    for name, error in sorted(discovery.errors.items(), key=lambda item: item[1].augmented / max(item[1].base, 1e-12)):
        factor, unit = quantities.get_display_unit(error.unit)
        before, after, floor, worst, low, high = (f"{factor * x:.3g}" for x in (
            error.base, error.augmented, error.floor, error.worst, *error.interval))
        channels.append((f"{quantities.label_channel(name)}, {unit}", before, after, f"{low} to {high}", floor,
                         f"{error.worst_run} {worst}" if error.worst_run else "", ", ".join(error.worse_runs)))
    changes = [_make_change_row(key, change) for key, change in content["files"]["vehicle.yaml"]["changes"].items()]
    parts = [(b.part, f"{metres(b.added_last)}, {100 * b.share_added_last:.0f} %",
              f"{metres(b.added_first)}, {100 * b.share_added_first:.0f} %", f"{100 * b.loss_added_last:.0f} %",
              f"{100 * b.loss_added_first:.0f} %") for b in sorted(discovery.budget, key=lambda b: -b.added_last)]
    regions = [(quantities.label_channel(r.channel), *report_text.describe_condition(r))
               for r in sorted(discovery.large_error_regions, key=lambda r: -r.interval[0])[:MAX_ROWS]]
    combinations = [(f"{c.name}, {c.unit}".replace("^2", "²"), f"{c.value:.4g}",
                     f"{c.interval[0]:.4g} to {c.interval[1]:.4g}", f"{c.file:.4g}")
                    for c in sorted(discovery.combinations, key=lambda c: -abs(c.value - c.file)
                                    / max(c.interval[1] - c.interval[0], 1e-12))]
    expected = "the noise" if discovery.start == "vehicle file" else "the error of the reference drives"
    narrow = (
        Table("Corrections of the vehicle file", "Values and intervals of the effects as entries of the file, in SI "
              "units.", ("key", "given file", "vehicle.yaml", "95 % interval"), changes),
        Table("Held-out error of each channel", "Root mean square at the end of the horizon (position after 5 s: "
              "mean). \"After\" is with all effects. Sorted by the relative reduction.",
              ("channel", "before", "after", "reduced by (95 %)", "noise", "worst run", "runs with a larger error"),
              channels),
        Table("Parts of the error", "Reduction of the mean position error at the end of the horizon by each part when "
              "it is added to the model last, after all other parts, or first, as the only one. Loss: reduction of the "
              "sum that the fit minimises. The unexplained part includes the noise.",
              ("part", "added last", "added first", "loss, added last", "loss, added first"), parts),
        Table("Where the base model has the largest errors", "",
              ("channel", "driving condition", f"ratio to {expected} (95 %)"), regions),
        Table("Identifiable combinations", "Predictions depend on these combinations. The interval of a single effect "
              "differs, because it also depends on the uncertainties of the vehicle file. Cornering stiffness: secant "
              f"at a slip angle of {math.degrees(SMALL_SLIP):.1f}°. Stability factor K: road-wheel angle = wheelbase / "
              "radius (1 + K v²). Yaw gain: yaw rate per steering-wheel angle.",
              ("combination", "value", "95 % interval", "vehicle file"), combinations))
    return {"narrow": [table for table in narrow if table.rows],
            "wide": [table for table in _make_wide_tables(discovery) if table.rows]}


def _make_change_row(key: str, change: Mapping[str, Any]) -> tuple[str, str, str, str]:
    quantity = FILE_QUANTITIES[key]
    unit, limits = get_unit_symbol(quantity.si_unit), (quantity.minimum, quantity.maximum)
    at_limit = any(math.isclose(change["after"], limit, rel_tol=1e-4) for limit in limits)
    return (f"{key}, {unit}" if unit else key, f"{change['before']:.5g}",
            f"{change['after']:.5g}{' (at its limit)' if at_limit else ''}",
            f"{change['interval'][0]:.5g} to {change['interval'][1]:.5g}")


def _make_wide_tables(discovery: Discovery) -> list[Table]:
    tested = [c for c in discovery.candidates if c.name not in {e.name for e in (*discovery.effects, *discovery.minor)}]
    candidates = [
        (quantities.to_words(c.name), quantities.format_fitted(c.name, c.parameters), f"{100 * c.gain:.1f}", c.verdict,
         c.reason)
        for c in sorted(tested, key=lambda c: (c.verdict not in ("alternative", "varies"), -c.gain))[:MAX_ROWS]]
    undetectable = report_text.list_undetectable(discovery)[:MAX_ROWS]
    return [
        Table("Effects that are not separable", "Separation: the part of the effect that the alternative and the "
              "other effects cannot reproduce.", report_text.PAIR_HEAD, report_text.list_pair_rows(discovery)),
        Table("Other effects that were tried", "Improvement: reduction of the errors over all channels by this effect "
              "when it is added to the model. An alternative is fitted in place of the reported effect.",
              ("effect", "fitted", "improvement, %", "verdict", "reason"), candidates,
              f"the first {len(candidates)} of {len(tested)}; all in discovery.json"),
        Table("Not detectable in these drives", "In brackets: change of the position by a typical size.",
              ("effect", "typical size", "reason", "recommended manoeuvre"), undetectable,
              f"the first {len(undetectable)} of {len(discovery.not_testable)}")]


def print_result(discovery: Discovery, update: VehicleUpdate | None, recordings: Sequence[Drive],
                 files: Mapping[str, Path], from_cache: bool, relation: RelationReport | None = None) -> None:
    """Print the result, its effects, the recommendations and the files. recordings: as for `write_page`."""
    def print_entry(name: str, text: str) -> None:
        console.print(f"[bold]{name}[/bold]: {escape(text)}", highlight=False)

    for role, text in report_text.describe_drives(discovery):
        print_entry(role, text)
    for headline in filter(None, (report_text.format_title(discovery), relation.headline if relation else "")):
        console.print(f"[bold]{escape(headline)}[/bold]", highlight=False)
    if relation is not None and not relation.headline:
        print_entry("proposal", relation.groups[0][1][0])
    if discovery.effects:
        rows = [dict(zip(report_text.EFFECT_HEAD[:-1], map(escape, row[:-1]), strict=True)) for row in
                report_text.list_effect_rows(discovery)]
        console.print(make_table(rows))
        console.print(f"[dim]{report_text.EFFECT_NOTE}.[/dim]", highlight=False)
    findings = {drive.name: drive.findings for drive in recordings}
    advice = report_text.recommend(discovery, update)[1:3]  # the page contains all
    for heading, text in (*report_text.summarise(discovery, update, findings), *(("to do", text) for text in advice),
                          *(("warning", text) for text in discovery.warnings)):
        print_entry(heading, text)
    for drive in recordings:
        if drive.problem:
            report_problem(drive.name, drive.problem)
    if from_cache:
        console.print("[dim]Cached result for the same inputs; --fresh repeats the search.[/dim]")
    list_files({file: FILE_MEANINGS[name] for name, file in files.items()})
