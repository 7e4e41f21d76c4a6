"""The command `st check`: checks runs, prints the findings, and writes check.json, a page and a run.yaml."""

import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml
from rich.markup import escape
from st_core.checks import Comparison, Finding, Severity, compare_runs
from st_core.corrections import Correction
from st_core.errors import ConfigurationError
from st_core.models import TYRE_MODELS
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR
from st_core.vehicle import VehicleParameters
from st_recordings.paths import OutputError, json_text, new_folder
from st_recordings.results import find_configuration
from st_recordings.runs import ReadSettings, RunSource, find_runs, read
from st_recordings.runs.bag import read_metadata_records
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import add_steering_column
from st_recordings.runs.errors import escape_unprintable, join_problems
from st_recordings.runs.readers import READERS
from st_recordings.runs.run_file import RUN_FILE, RUN_SUFFIX, TABLE_KEYS
from st_recordings.runs.run_types import summarise_alignment

from ..evaluation import drawing
from ..evaluation.work import to_file_name
from ..pages import load_template
from ..terminal import console, list_files, make_progress_bars, print_line, report_problem
from . import check_report
from .check_report import CheckedRun, build_document, compute_residual_rms, print_runs
from .gate import RUN_ERRORS, check_log, describe_problem

MAX_FIGURES = 6  # on the page
LABEL_CHARACTERS = 12  # per line of a vertical axis label, so that the labels of both panels do not overlap
MAX_LINE_GAP = 1.5  # s; a line is interrupted at longer gaps
MIN_SHADE_WIDTH = 0.004  # fraction of the time axis; narrower shading would be invisible
SHADES = {Severity.ERROR: drawing.BAD_COLOUR, Severity.WARNING: drawing.WARN_COLOUR, Severity.NOTE: MEASURED_COLOUR}


@dataclass(frozen=True)
class CheckJob:
    """Options of `st check`."""

    paths: Sequence[Path]
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_is_given: bool  # whether the user named that file
    read_settings: ReadSettings
    output: Path | None = None  # folder, None for runs/check-<time>
    json: Path | None = None  # file instead of check.json in that folder
    correction_file: Path | None = None  # run.yaml to write


def run_command(job: CheckJob, report_vehicle: Callable[[str], None] | None = None) -> int:
    """Run the command; returns the exit status: 1 if a run has an error or could not be read, else 0. report_vehicle:
    called with each `vehicle_source`, if the user named no file. Raises ConfigurationError, OutputError."""
    sources = find_runs(job.paths)
    if job.correction_file is not None:
        check_file_name(job.correction_file)
        if len(sources) != 1:
            raise ConfigurationError(f"--propose-correction: {len(sources)} runs were given, but corrections "
                                     "are proposed for one run: give one")
    folder = new_folder(job.output, "check", create=False)
    checked_runs: list[CheckedRun] = []
    unreadable: dict[str, str] = {}
    with make_progress_bars() as progress:
        for source in progress.track(sources, description="checking"):
            try:
                checked_runs.append(check_run(source, job))
            except RUN_ERRORS as error:
                unreadable[source.name] = describe_problem(error, source)
    if not checked_runs:
        raise ConfigurationError("no run can be read: " + join_problems(unreadable.values()))
    new_folder(folder, "")
    print_runs(checked_runs)
    for name, problem in unreadable.items():
        report_problem(name, problem)
    if estimates := compare_runs([run.result for run in checked_runs]):
        print_line("\n  ".join(["[bold]all runs together[/bold]", *(escape(estimate.text) for estimate in estimates)]))
    if report_vehicle and not job.vehicle_is_given:
        for file in sorted({run.vehicle_source for run in checked_runs}):
            report_vehicle(file)
    content = build_document(checked_runs, unreadable)
    page, numbers = folder / "report.html", job.json or folder / "check.json"
    with console.status("drawing, writing the page"):
        write_page(page, checked_runs, unreadable, content)
        numbers.parent.mkdir(parents=True, exist_ok=True)
        numbers.write_text(json_text(content), encoding="utf-8")
    files = {page: "one page, with the findings and figures", numbers: "all numbers; keys in docs/manual/checks.md"}
    if target := job.correction_file:
        target.parent.mkdir(parents=True, exist_ok=True)
        text = make_run_yaml(sources[0], checked_runs[0].result.findings, target, job.read_settings)
        target.write_text(text, encoding="utf-8")
        files[target] = "the run with its corrections, for every command"
    list_files(files)
    return int(bool(unreadable) or any(run.result.with_severity(Severity.ERROR) for run in checked_runs))


def check_run(source: RunSource, job: CheckJob) -> CheckedRun:
    """Read and check one run. Raises one of gate.RUN_ERRORS for a run that cannot be read."""
    car, car_source = job.vehicle, job.vehicle_file
    if source.kind == "bag" and not job.vehicle_is_given:
        car, _, car_source = find_configuration(read_metadata_records(source.path), None)
    run = read(source, car, job.read_settings)
    result = check_log(run.log, car, run.auxiliary, TYRE_MODELS)
    return CheckedRun(source.name, result, car, car_source, run.log.duration, run.warnings, run.provenance["files"],
                      summarise_alignment(run.alignment), source.arguments)


def check_file_name(file: Path) -> None:
    """Raise OutputError for a file name that no command reads, and for an existing file."""
    if file.name != RUN_FILE and not file.name.endswith(RUN_SUFFIX):
        raise OutputError(f"--propose-correction {file}: name it run.yaml or NAME.run.yaml; commands read only these")
    if file.exists():
        raise OutputError(f"--propose-correction {file}: exists; choose another name (existing files are not "
                          "overwritten)")


def make_run_yaml(source: RunSource, findings: Sequence[Finding], file: Path, read_settings: ReadSettings) -> str:
    """Text of a run.yaml: comments with the findings, the run as it was read, and its corrections.

    A correction is written only as a comment if it belongs in the vehicle file or an option, is negligible, conflicts
    with an earlier finding, or concerns the units of a run without a table. Paths are relative to `file`.
    """
    corrections: dict[str, Any] = {}
    lines = ["# Proposed by st check. Every command that reads this file lists its corrections.\n"]
    for finding in findings:
        lines.append(f"# {finding.severity.value}: {finding.name}: {escape_unprintable(finding.text)}\n")
        advice = finding.advice
        if advice is None:
            continue
        if advice.kind != "run.yaml":
            comment = check_report.describe_correction(advice)
        elif finding.severity is Severity.NOTE:
            comment = f"not applied, negligible: {advice.line}"
        elif not READERS[source.kind].is_table and "units" in advice.entry:
            comment = f"not applied, only {' and '.join(TABLE_KEYS)} files have units: {advice.line}"
        else:
            joined = _merge(corrections, as_yaml_values(advice.entry))
            if joined == _merge(joined, corrections):
                corrections = joined
                continue
            comment = f"not applied, an earlier finding proposes a different value: {advice.line}"
        lines.append(f"#   {escape_unprintable(comment)}\n")
    if options := _format_steering_options(read_settings):
        lines.append(f"# read with {options}\n")
    settings = append_corrections(_merge_settings(source, file, read_settings), corrections)
    parts = [_make_relative(path, file) for path in source.files]
    files = {READERS[source.kind].key: parts if READERS[source.kind].is_table and len(parts) > 1 else parts[0],
             **({"can": [_make_relative(path, file) for path in source.can]} if source.can else {})}
    content = {"name": source.name, **files, **settings}
    return "".join(lines) + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)


def _format_steering_options(settings: ReadSettings) -> str:
    options = []
    if (steering := settings.steering) is not None:
        options = [*([f"--steering-topic {steering.topic}"] if steering.topic else []),
                   f"--steering-field {steering.field!r} --steering-is {steering.quantity}"]
    if settings.steering_sign != 1 or settings.steering_latency:
        options.append(f"--steering-sign {settings.steering_sign} --steering-latency {settings.steering_latency:g}")
    return escape_unprintable(" ".join(options))


def append_corrections(settings: Mapping[str, Any], corrections: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run.yaml with further corrections (2), which act after the existing ones (1):

        scale = scale2 scale1,  add = scale2 add1 + add2,  earlier = earlier1 + earlier2,  ahead = ahead1 + ahead2
    """
    result = _merge(settings, corrections)
    for channel, second in corrections.get("correct", {}).items():
        first, scale = settings.get("correct", {}).get(channel, {}), second.get("scale", 1.0)
        combined = {"scale": first.get("scale", 1.0) * scale,
                    "add": scale * first.get("add", 0.0) + second.get("add", 0.0),
                    **{key: first.get(key, 0.0) + second.get(key, 0.0) for key in ("earlier", "ahead")}}
        result["correct"][channel].update({key: combined[key] for key in combined.keys() & result["correct"][channel]})
    return result


def _merge(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Both mappings; for a key in both: mappings merged, lists joined without repetition, else the second value."""
    joined = {**first}
    for key, value in second.items():
        if isinstance(value, list):
            joined[key] = [*joined.get(key, ()), *(item for item in value if item not in joined.get(key, ()))]
        else:
            joined[key] = _merge(joined.get(key, {}), value) if isinstance(value, Mapping) else value
    return joined


def _merge_settings(source: RunSource, file: Path, read_settings: ReadSettings) -> dict[str, Any]:
    """Settings of the run.yaml of the run, overridden by the options of the command line. A run.yaml cannot state the
    sign of a steering column, so with --steering-sign -1 it does not name the column."""
    # A car whose recordings are tables has neither DBC nor signal table.
    bus = {"dbc": read_settings.dbc, "signals": read_settings.signals}
    options = {**{key: path for key, path in bus.items() if path and path.exists()}, "offset": read_settings.offset,
               "ins_can_latency": list(read_settings.ins_can_latency) if read_settings.ins_can_latency else None}
    settings = {**source.settings, **{key: value for key, value in options.items() if value is not None}}
    layout = settings.pop("layout", None)
    if read_settings.steering is not None and read_settings.steering.sign == 1 and source.kind in TABLE_KEYS:
        layout = add_steering_column(layout or Layout(), read_settings.steering)
    result = {key: _make_relative(value, file) if isinstance(value, Path) else as_yaml_values(value)
             for key, value in settings.items()}
    if layout is not None:
        result |= {key: as_yaml_values(value) for key in ("columns", "units") if (value := getattr(layout, key))}
    if source.labels:
        result["labels"] = [{"name": label.name, "start": label.start, "end": label.end} for label in source.labels]
    return result


def as_yaml_values(value: Any) -> Any:
    """Mappings, sequences, corrections and numbers as plain values for YAML; floats with 15 significant digits."""
    if isinstance(value, Correction):
        return {field.name: as_yaml_values(getattr(value, field.name)) for field in fields(value)
                if getattr(value, field.name) != field.default}
    if isinstance(value, Mapping):
        return {str(key): as_yaml_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_yaml_values(item) for item in value]
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _make_relative(path: Path, file: Path) -> str:
    return Path(os.path.relpath(path.absolute(), file.absolute().parent)).as_posix()


def draw_comparison(comparison: Comparison, run: CheckedRun, prefix: str) -> drawing.PageFigure:
    """Draw one comparison, with the time intervals of its findings shaded. prefix: start of the title."""
    findings = sorted((finding for finding in run.result.findings if finding.name in comparison.findings),
                      key=check_report.rank_severity)
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(drawing.WIDTH, 3.1), sharex=True, height_ratios=(3, 2))
    for axes, values, colour, width, label in (
            (upper, comparison.measured, MEASURED_COLOUR, 2.6, comparison.measured_label),
            (upper, comparison.derived, MODEL_COLOUR["kinematic"], 0.9, comparison.derived_label),
            (lower, comparison.measured - comparison.derived, drawing.TEXT_COLOUR, 0.9, None)):
        line = drawing.reduce_points(*drawing.cut_at_gaps(comparison.time, values, MAX_LINE_GAP))
        axes.plot(*line, color=colour, lw=width, label=label)
    shortest = MIN_SHADE_WIDTH * float(np.ptp(upper.get_xlim()))
    for finding in findings:
        for start, end in finding.times:
            for axes in (upper, lower):
                axes.axvspan(start, max(end, start + shortest), color=SHADES[finding.severity], alpha=0.3, lw=0)
    lower.axhline(0.0, color=drawing.TEXT_COLOUR, lw=0.5)
    lower.set_xlabel("time after the first INS measurement, s")
    unit = check_report.get_unit_symbol(comparison.unit) or "1"
    upper.set_ylabel(f"{textwrap.fill(comparison.title.partition(':')[0], LABEL_CHARACTERS)}\n{unit}")
    lower.set_ylabel(f"difference\n{unit}")
    figure.align_ylabels()
    output = drawing.FigureOutput(None, (), f"{to_file_name(run.name)}-")
    shaded = ", shaded where a finding applies" if any(finding.times for finding in findings) else ""
    caption = f"Grey: {comparison.measured_label}; blue: {comparison.derived_label}; below, grey minus blue{shaded}."
    size = f"{compute_residual_rms(comparison):.2g} {check_report.get_unit_symbol(comparison.unit)}".strip()
    finding_text = findings[0].text if findings else f"no finding; they differ by {size} (root mean square)"
    title = f"{prefix}{comparison.title[0].upper()}{comparison.title[1:]}: {finding_text}"
    return drawing.save_figure(figure, output, f"comparison-{comparison.name}", title, caption)


def make_title(runs: Sequence[CheckedRun]) -> str:
    """Title of the page: the verdict on all runs."""
    if len(runs) == 1:
        return f"{runs[0].name}: {check_report.format_headline(runs[0].result)}"
    affected = {severity: [run.name for run in runs if run.result.with_severity(severity)]
                for severity in check_report.SEVERITY_ORDER[:2]}
    if not any(affected.values()):
        return f"{len(runs)} runs: no error and no warning"
    counts = [f"{severity.value}s in {len(names)} of {len(runs)} runs ({', '.join(names)})"
              for severity, names in affected.items() if names]
    sentence = "; ".join(counts)
    return sentence[0].upper() + sentence[1:]


def make_summary(runs: Sequence[CheckedRun]) -> list[str]:
    """At most three sentences: meaning of the findings, recommendation, clocks."""
    findings = [finding for run in runs for finding in run.result.findings]
    worst = min(findings, key=check_report.rank_severity, default=None)
    clocks = check_report.describe_clocks({run.name: run.alignment for run in runs})
    if worst is None or worst.severity is Severity.NOTE:
        return ["No finding requires a correction of these runs.", *([f"{clocks}."] if clocks else [])]
    sizes = [finding.effect for finding in findings
             if finding.severity is not Severity.NOTE and finding.effect is not None]
    size = f", by up to {max(sizes):.2g} m after 5 s" if sizes and worst.severity is Severity.WARNING else ""
    rejection = ": other commands reject such a run unless --force is given" if worst.severity is Severity.ERROR else ""
    meaning = check_report.describe_meaning(findings)
    sign_advice = next(filter(None, (check_report.advise_steering_sign(
        run.result.findings, run.arguments, run.alignment["method"] != "none") for run in runs)), "")
    correction = (f"To correct the recording, run `st check {runs[0].arguments if len(runs) == 1 else 'RUN'} "
                  "--propose-correction run.yaml` with the other options of this check, and use the run.yaml that it "
                  "writes instead of the recording.")
    is_correctable = any(finding.advice is not None and finding.advice.kind == "run.yaml" for finding in findings
                         if finding.severity is not Severity.NOTE)
    sentences = (f"{meaning[0].upper()}{meaning[1:]}{size}{rejection}.",
                 f"{sign_advice[0].upper()}{sign_advice[1:]}." if sign_advice else correction if is_correctable else "",
                 f"{clocks}." if clocks else "")
    return [sentence for sentence in sentences if sentence]


def write_page(file: Path, runs: Sequence[CheckedRun], unreadable: Mapping[str, str], content: dict[str, Any]) -> None:
    """Write the page, with the MAX_FIGURES comparisons with the worst findings. content: content of check.json."""
    def rank(pair: tuple[Comparison, CheckedRun]) -> tuple[int, float]:
        comparison, run = pair
        findings = [finding for finding in run.result.findings if finding.name in comparison.findings]
        worst = min(map(check_report.rank_severity, findings), default=len(check_report.SEVERITY_ORDER))
        return worst, -max((finding.effect or 0.0 for finding in findings), default=0.0)

    pairs = sorted(((comparison, run) for run in runs for comparison in run.result.comparisons), key=rank)
    figures = [draw_comparison(comparison, run, f"{run.name}: " if len(runs) > 1 else "")
               for comparison, run in pairs[:MAX_FIGURES]]
    text = load_template("checking/check.html.jinja").render(
        title=make_title(runs), summary=make_summary(runs), runs=runs, content=content, figures=figures,
        problems=unreadable, groups=check_report.group_findings({run.name: run.result.findings for run in runs}))
    file.write_text(text, encoding="utf-8")
