"""The command `st discover`: reads recordings, identifies effects, writes and prints the results."""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from st_core.augmented import AugmentedModel
from st_core.checks import Severity
from st_core.discovery import Discovery
from st_core.discovery.error_regions import Samples, compute_window_errors
from st_core.discovery.library_fit import apply_clock_corrections
from st_core.effects import load_folder
from st_core.errors import ConfigurationError
from st_core.models import Model
from st_core.relations import RelationSearch, find_relation, needs_search
from st_recordings.car import read_model
from st_recordings.paths import json_text, new_folder
from st_recordings.runs import find_runs
from st_recordings.runs.errors import join_problems

from ..evaluation.drawing import FigureOutput, PageFigure, check_formats
from ..terminal import make_progress_bars
from .discovery_report import build_document, build_model_file, print_result, write_page
from .drives import Drive, Request, find_result, get_logs, read_drives
from .figures import draw_agreement, draw_axle_curves, draw_maps, draw_relation, draw_waterfall
from .relation_report import RelationReport, build_relation_document, report_relation, write_files
from .vehicle_update import VehicleUpdate, update_vehicle


def run_command(request: Request, console: Console) -> int:
    """Run the command; returns the exit status: 1 if a run could not be used, else 0. Raises ConfigurationError for
    invalid options or recordings, StCoreError if a search is not possible, OutputError if the folder is unusable."""
    check_formats(request.formats)
    base, effect_hashes = _load_base_and_effects(request)
    folder = new_folder(request.output, "discover")
    times = [time.perf_counter()]
    with make_progress_bars(console) as progress:
        drives, reference = _read_runs(request, progress)
        request = replace(request, drives=drives, reference_drives=reference, effect_hashes=effect_hashes)
        times.append(time.perf_counter())
        discovery, from_cache = find_result(request, base, progress)
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
    print_result(discovery, update, request.all_drives, files, from_cache, console, report)
    return 1 if any(d.problem for d in request.all_drives) else 0


def _load_base_and_effects(request: Request) -> tuple[Model, dict[str, str]]:
    """(base model, sha256 of each file of user-defined effects). Loads these effects."""
    hashes: dict[str, str] = {}
    if request.effects is not None:
        load_folder(str(request.effects.absolute()))
        hashes = {file.name: hashlib.sha256(file.read_bytes()).hexdigest()
                  for file in sorted(request.effects.glob("*.py"))}
    try:
        return read_model(request.base, request.vehicle, request.vehicle_file)[0], hashes
    except ConfigurationError as error:
        raise ConfigurationError(f"--base {error}") from None


def _read_runs(request: Request, progress: Progress) -> tuple[list[Drive], list[Drive]]:
    """(suspect, reference) drives, with distinct names. Raises ConfigurationError if no suspect drive can be used, or
    none of the reference drives that were given, and as `_check_reference` does."""
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
    """Write all files; returns their paths by kind. figures: for the page; None: no page. report: report on
    `search`."""
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
