"""Formats the findings of the checks as text, for the terminal and for check.json (docs/manual/checks.md)."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from rich.markup import escape
from st_core.checks import Advice, Comparison, DriveCheck, Finding, Severity, compare_runs
from st_core.checks.finding import SCHEMA
from st_core.checks.position import CAUSES
from st_core.checks.sampling import UNITS as CHANNEL_UNITS
from st_core.regression import count_decimals
from st_core.vehicle import VehicleParameters
from st_recordings.paths import json_ready
from st_recordings.results import collect_versions

from ..terminal import format_count, print_line

ZONE_TOLERANCE = 120.0  # s; an offset this close to a multiple of half an hour is due to time zones
MAX_INTERVALS = 4  # time intervals of a finding that are listed
MAX_LISTED = 3  # findings in a headline
MAX_RUNS = 8  # runs that are printed one by one; with more runs, each error and warning is printed once
SEVERITY_ORDER = (Severity.ERROR, Severity.WARNING, Severity.NOTE)
MEANING = {Severity.ERROR: "an evaluation would be meaningless", Severity.WARNING: "an evaluation would be biased",
           Severity.NOTE: "negligible here"}
QUANTITY_UNITS = {**{f"{channel}_bias": unit for channel, unit in CHANNEL_UNITS.items()},
                  **{name: cause.unit for name, cause in CAUSES.items()},
                  "heading_misaligned": "rad", "steering_offset": "rad", "measuring_point": "m"}
ADVICE_PLACE = {"run.yaml": "in a run.yaml: ", "vehicle": "in the vehicle file: ", "option": "with the option ",
                "text": ""}
SEVERITY_STYLE = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.NOTE: "dim"}


def rank_severity(finding: Finding) -> int:
    """Sort key of findings: errors, then warnings, then notes."""
    return SEVERITY_ORDER.index(finding.severity)


def count_by_severity(findings: Sequence[Finding]) -> str:
    """Number of findings of each severity, such as "2 errors, 1 warning"; empty without findings."""
    counts = ((kind.value, sum(finding.severity is kind for finding in findings)) for kind in SEVERITY_ORDER)
    return ", ".join(format_count(count, name) for name, count in counts if count)


def format_verdict(result: DriveCheck) -> str:
    """Number of findings of a run by severity, and their meaning for an evaluation, in one line."""
    if not result.findings:
        compared = format_count(len(result.comparisons), "comparison")
        return f"no findings in {compared}" if result.comparisons else "nothing could be compared"
    return f"{count_by_severity(result.findings)}: {describe_meaning(result.findings)}"


def describe_meaning(findings: Sequence[Finding]) -> str:
    """Consequence of the most severe finding for an evaluation."""
    worst = min(findings, key=rank_severity).severity
    if worst is Severity.WARNING and all(f.concerns_only_acceleration for f in findings if f.severity is worst):
        return "results of identify and discover would be biased"
    return MEANING[worst]


def format_headline(result: DriveCheck) -> str:
    """Number of findings of a run by severity, and the texts of the most severe; `format_verdict` without findings."""
    if not result.findings:
        return format_verdict(result)
    worst = min(result.findings, key=rank_severity).severity
    texts = [finding.text for finding in result.findings if finding.severity is worst]
    more = f"; and {len(texts) - MAX_LISTED} more" if len(texts) > MAX_LISTED else ""
    if len(texts) > 1:  # in a list, the questions about causes at the end of the texts are left out
        texts = [re.sub(r"(: [^:]*\?)+$", "", text) for text in texts]
    return f"{count_by_severity(result.findings)}: {'; '.join(texts[:MAX_LISTED])}{more}"


def get_unit_symbol(unit: str) -> str:
    return "" if unit == "1" else unit.replace("^2", "²")


def format_estimate(value: float | None, interval: Sequence[float] | None = None, unit: str = "1") -> str:
    """An estimate rounded to its uncertainty: "57.30 ± 0.02 m"; asymmetric: "57.3 (56.9 to 58.8) m"; None, NaN: ""."""
    if value is None or not math.isfinite(value):
        return ""
    ending = f" {get_unit_symbol(unit)}" if get_unit_symbol(unit) else ""
    if interval is None or not interval[1] > interval[0]:
        return f"{value:.4g}{ending}"
    low, high = value - interval[0], interval[1] - value
    decimals = count_decimals(0.5 * (low + high))
    if min(low, high) <= 0.0 or max(low, high) > 1.5 * min(low, high):
        return f"{value:z.{decimals}f} ({interval[0]:z.{decimals}f} to {interval[1]:z.{decimals}f}){ending}"
    return f"{value:z.{decimals}f} ± {0.5 * (low + high):.{decimals}f}{ending}"


def format_quantity(name: str, value: Sequence[float]) -> str:
    """Text of an estimate (value, low, high). name: name of the estimate, such as yaw_rate_lag; determines the unit."""
    unit = QUANTITY_UNITS.get(name, "s" if name.endswith("_lag") else "1")
    return format_estimate(value[0], value[1:], unit)


def describe_intervals(finding: Finding) -> str:
    """Time intervals of a finding, or "whole run"."""
    if not finding.times:
        return "whole run"
    text = ", ".join(f"{start:.1f}{f' to {end:.1f}' if end - start >= 0.05 else ''} s"
                      for start, end in finding.times[:MAX_INTERVALS])
    more = len(finding.times) - MAX_INTERVALS
    return text + (f" and {more} more" if more > 0 else "")


def describe_effect(finding: Finding) -> str:
    """Effect of a finding on predictions or fits; empty if it is unknown and the finding is not an error."""
    if finding.concerns_only_acceleration:
        return "no effect on predictions, but results of identify and discover are biased"
    if finding.effect is None:
        return "predictions would be meaningless" if finding.severity is Severity.ERROR else ""
    size = f"{finding.effect:.0f}" if finding.effect >= 10.0 else f"{finding.effect:.2g}"
    return f"shifts the position after 5 s by about {size} m"


def describe_correction(advice: Advice | None) -> str:
    """The correction, with where to enter it; empty without advice."""
    return f"{ADVICE_PLACE[advice.kind]}{advice.line}" if advice else ""


def advise_steering_sign(findings: Iterable[Finding], source: str = "RUN", is_can: bool | None = None) -> str:
    """Advice for a steering angle with the opposite sign; empty without such a finding. is_can: whether the steering is
    in a CAN log (else in a table); None if unknown."""
    if not any(finding.name == "steering_sign" for finding in findings):
        return ""
    log = "add --steering-sign -1 (1 if car.yaml has -1), or change steering_sign in car.yaml"
    table = ("add --steering-field COLUMN --steering-sign -1, or write a run.yaml with "
             f"`st check {source} --propose-correction run.yaml` and use it instead")
    advice = {True: log, False: table, None: f"for CAN logs, {log}; for a table, {table}"}[is_can]
    return f"the steering angle has the opposite sign (left is positive): {advice}"


def describe_clocks(alignments: Mapping[str, Mapping[str, Any]]) -> str:
    """Text on the steering clock of each run; if more than two offsets are estimated, their range."""
    estimated = [alignment for alignment in alignments.values() if alignment["method"] not in ("none", "by hand")]
    texts = [f"{name}: {text}" for name, alignment in alignments.items() if (text := describe_clock(alignment))
             and (len(estimated) <= 2 or alignment["method"] == "by hand")]
    if len(estimated) <= 2:
        return "; ".join(texts)
    offsets = sorted(alignment["offset_s"] for alignment in estimated)
    deviations = [alignment["offset_deviation_s"] for alignment in estimated]
    finite = [deviation for deviation in deviations if deviation is not None]
    unknown = f" (unknown in {len(deviations) - len(finite)} of them)" if 0 < len(finite) < len(deviations) else ""
    doubtful_count = sum(alignment["verdict"] != "good" for alignment in estimated)
    summary = (f"INS minus steering clock of {len(estimated)} runs: {offsets[0]:+.3f} to {offsets[-1]:+.3f} s"
               f"{_note_time_zone(offsets[0])}, estimated from the data, standard deviation "
               f"{'up to ' if finite else ''}{_describe_deviation(max(finite, default=None))}{unknown}, "
               f"{doubtful_count or 'none'} of them doubtful")
    return "; ".join([summary, *texts])


def describe_clock(alignment: Mapping[str, Any]) -> str:
    """Text on the steering clock of a run, from the result of `summarise_alignment`; empty if it is the INS clock."""
    if alignment["method"] == "none":
        return ""
    origin = "set by hand" if alignment["method"] == "by hand" else (
        f"estimated from the data (by {alignment['method']}, standard deviation "
        f"{_describe_deviation(alignment['offset_deviation_s'])}, {alignment['verdict']})")
    return f"INS minus steering clock: {alignment['offset_s']:+.3f} s{_note_time_zone(alignment['offset_s'])}, {origin}"


def _describe_deviation(deviation: float | None) -> str:
    """Text of a standard deviation [s]; JSON has null for an infinite one."""
    return "unknown" if deviation is None else f"{1e3 * deviation:.1f} ms"


def _note_time_zone(offset: float) -> str:
    """Note on an offset [s] that is close to a difference between time zones; empty for other offsets."""
    half_hours = round(offset / 1800.0)
    if not 0 < abs(half_hours) <= 28 or abs(offset - 1800.0 * half_hours) > ZONE_TOLERANCE:
        return ""
    return f" (about {0.5 * half_hours:+g} h: one of the two clocks shows local time)"


@dataclass(frozen=True)
class CheckedRun:
    """One run of `st check`."""

    name: str
    result: DriveCheck
    vehicle: VehicleParameters
    vehicle_source: str  # file or recording with the vehicle parameters
    duration: float  # s
    warnings: tuple[str, ...]  # warnings of the reader, including its corrections
    files: Mapping[str, str]  # sha256 by path
    alignment: Mapping[str, Any]  # from `summarise_alignment`
    arguments: str  # arguments of `st check` that read this run


def findings_as_json(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    return [json_ready(finding.as_dict()) for finding in findings]


def build_document(runs: Sequence[CheckedRun], unreadable: Mapping[str, str]) -> dict[str, Any]:
    """The content of check.json. unreadable: problem by name of each run that could not be read."""
    return {
        "schema": SCHEMA,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": collect_versions(),
        "vehicle": {source: {"name": car.name, "hash": car.hash}
                    for source, car in {run.vehicle_source: run.vehicle for run in runs}.items()},
        "runs": {run.name: {
            "verdict": format_verdict(run.result), "vehicle": run.vehicle_source, "duration": run.duration,
            **run.result.as_dict(),
            "comparisons": [{"name": c.name, "title": c.title, "unit": c.unit, "samples": len(c.time),
                             "residual_rms": compute_residual_rms(c), "findings": c.findings}
                            for c in run.result.comparisons],
            "warnings": run.warnings, "files": run.files, "alignment": run.alignment,
        } for run in runs},
        "combined_estimates": [entry.as_dict() for entry in compare_runs([run.result for run in runs])],
        "failed": unreadable,
    }


def compute_residual_rms(comparison: Comparison) -> float:
    """Root mean square of measured minus derived values, in the unit of the comparison; NaN without common samples."""
    residual = np.asarray(comparison.measured) - np.asarray(comparison.derived)
    residual = residual[np.isfinite(residual)]
    return float(np.sqrt(np.square(residual).mean())) if len(residual) else float("nan")


def print_run(run: CheckedRun) -> None:
    """Print the verdict on a run, its clock, and each finding with its correction."""
    worst = min((finding.severity for finding in run.result.findings), key=SEVERITY_ORDER.index, default=Severity.NOTE)
    colour = "green" if worst is Severity.NOTE else SEVERITY_STYLE[worst]
    if hint := advise_steering_sign(run.result.findings, run.arguments, run.alignment["method"] != "none"):
        print_line(f"[bold red]{escape(run.name)}: {escape(hint)}[/]")
    print_line(f"[bold]{escape(run.name)}[/bold]: [{colour}]{escape(format_verdict(run.result))}[/]  "
               f"[dim]{run.duration:.0f} s, {escape(run.vehicle.name)} from {escape(run.vehicle_source)}[/]")
    if text := describe_clock(run.alignment):
        print_line(f"  {escape(text)}")
    for finding in run.result.findings:
        print_line(f"  [{SEVERITY_STYLE[finding.severity]}]{finding.severity.value}[/] "
                   f"[bold]{escape(finding.name)}[/bold]: {escape(finding.text)}")
        details = "; ".join(filter(None, (describe_intervals(finding), describe_effect(finding))))
        print_line(f"    [dim]{escape(details)}[/dim]")
        if finding.advice:
            print_line(f"    {'correction, ' if ADVICE_PLACE[finding.advice.kind] else 'advice: '}"
                       f"{escape(describe_correction(finding.advice))}")


def print_runs(runs: Sequence[CheckedRun]) -> None:
    """Print each run; for more than MAX_RUNS, print each error and warning once, with the names of its runs."""
    if len(runs) <= MAX_RUNS:
        for run in runs:
            print_run(run)
        return
    if text := describe_clocks({run.name: run.alignment for run in runs}):
        print_line(f"  {escape(text)}")
    print_findings({run.name: run.result.findings for run in runs}, "report.html")
    clean = [run.name for run in runs if not run.result.findings]
    names = f": {', '.join(clean)}" if clean else ""
    print_line(f"[green]no findings[/] in {len(clean)} of {len(runs)} runs{escape(names)}")
    hints = {advise_steering_sign(run.result.findings, is_can=run.alignment["method"] != "none") for run in runs}
    for hint in sorted(filter(None, hints)):
        print_line(f"[bold red]{escape(hint)}[/]")


def group_findings(runs: Mapping[str, Sequence[Finding]]) -> list[tuple[Finding, list[str]]]:
    """Findings grouped by name, channels and sign of the value, the most severe group first. For each group: its most
    severe finding (of equally severe ones, that with the largest effect), and the names of its runs."""
    by_key: dict[tuple[str, tuple[str, ...], bool], list[tuple[Finding, str]]] = {}
    for name, findings in runs.items():
        for finding in findings:
            key = finding.name, finding.channels, (finding.value or 0.0) < 0.0
            by_key.setdefault(key, []).append((finding, name))

    def order(finding: Finding) -> tuple[int, float]:
        unknown = math.inf if finding.severity is Severity.ERROR else 0.0
        return rank_severity(finding), -(unknown if finding.effect is None else finding.effect)

    groups = [(min((finding for finding, _ in group), key=order), [name for _, name in group])
              for group in by_key.values()]
    return sorted(groups, key=lambda group: order(group[0]))


def print_findings(runs: Mapping[str, Sequence[Finding]], details: str = "st check") -> None:
    """Print each error and warning once, and the number of notes. details: command or file that lists everything."""
    notes = 0
    for finding, names in group_findings(runs):
        if finding.severity is Severity.NOTE:
            notes += len(names)
            continue
        parts = [finding.text, describe_effect(finding), describe_correction(finding.advice)] if len(names) == 1 else [
            f"{finding.text} (largest of {len(names)})", describe_effect(finding), f"corrections: {details}"]
        severity = finding.severity
        print_line(f"{escape(', '.join(dict.fromkeys(names)))}: [{SEVERITY_STYLE[severity]}]{severity.value}: "
                   f"{escape(' | '.join(filter(None, parts)))}[/]")
    if notes:
        print_line(f"[dim]{format_count(notes, 'note')} of the checks, negligible here; see {details}[/dim]")
