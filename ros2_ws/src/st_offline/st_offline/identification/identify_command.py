"""The command `st identify`: runs an experiment, prints the result and writes its files."""

import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from st_core.checks import Finding
from st_core.handling import find_implausible_values
from st_core.identification import result
from st_core.vehicle import FILE_QUANTITIES, VehicleParameters
from st_recordings.paths import json_text, new_folder
from st_recordings.results import collect_versions
from st_recordings.runs import find_runs
from st_recordings.runs.errors import logged_warnings
from st_recordings.runs.load import hash_files

from ..checking.check_report import findings_as_json, print_findings
from ..discovery.vehicle_update import edit_vehicle_text
from ..evaluation.drawing import FigureOutput, PageFigure
from ..pages import load_template
from ..terminal import console, list_files, make_table, print_line
from .driving import DRIVE_EXPERIMENTS
from .experiment import COLUMN_NAMES, Experiment, IdentificationJob, make_estimate_rows
from .static_tests import CG_HEIGHT, LAMBDA, SCALES, STEERING_RATIO, TYRE

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment for experiment in (SCALES, CG_HEIGHT, STEERING_RATIO, TYRE, *DRIVE_EXPERIMENTS, LAMBDA)}
"""All experiments of `st identify`, in the recommended order."""
STATUS_STYLE = {"identified": "green", "doubtful": "yellow", "unidentifiable": "red"}


def run_command(job: IdentificationJob) -> int:
    """Run the command; returns the exit status: 0 if any parameter is identified or doubtful, else 1.
    Raises StCoreError, RunError, OutputError."""
    with console.status(f"identifying: {job.experiment.description}"):
        if job.experiment.needs_files and not job.files:
            raise result.IdentificationError(f"no files were given; {job.experiment.name} needs "
                                             f"{job.experiment.required_files}")
        try:
            outcomes = job.experiment.identify(job)
        except result.IdentificationError as error:
            files = ", ".join(map(str, job.files[:3]))
            raise result.IdentificationError(f"{files}: {error}" if files else str(error)) from None
        outcomes = tuple(replace(outcome, warnings=(*outcome.warnings, *filter(None, (
            result.compare_with_file(job.vehicle, estimate) for estimate in outcome.estimates))))
                      for outcome in outcomes)
    now = datetime.now(UTC)
    updated_vehicle = result.apply_to_vehicle(job.vehicle, outcomes, f"{now:%Y-%m-%d}")
    warnings = (*outcomes[0].warnings, *find_implausible_values(updated_vehicle, job.vehicle))
    outcomes = (replace(outcomes[0], warnings=warnings), *outcomes[1:])
    with console.status("writing"):
        paths = write_results(job, outcomes, updated_vehicle, now)
    print_results(outcomes, job.vehicle, result.describe_stale_lambda(job.vehicle, outcomes))
    list_files({paths["identification.json"]: "values, uncertainties, verdicts",
                paths["vehicle.yaml"]: "vehicle file with the identified values",
                paths["report.html"]: "figures, correlations, lists of used and rejected data"})
    return 0 if any(e.status != "unidentifiable" for outcome in outcomes for e in outcome.estimates) else 1


def print_results(outcomes: Sequence[result.Identification], vehicle: VehicleParameters,
                  lambda_warnings: Sequence[str]) -> None:
    """Print the findings of the checks, and the table, verdicts and warnings of each result."""
    print_findings(collect_findings_by_drive(outcomes))
    for outcome in outcomes:
        console.print(make_table([
            {"parameter": escape(f"{name}{'' if unit == '1' else f', {unit}'}"), "value": value,
             "95 % interval": interval, "in the file": file_value, "status": f"[{STATUS_STYLE[status]}]{status}[/]"}
            for name, value, _, interval, unit, file_value, status in make_estimate_rows(outcome, vehicle)],
            outcome.experiment))
        for style, texts in (("default", [f"{e.parameter}: {e.verdict}" for e in outcome.estimates]),
                             ("dim", [coverage.describe() for coverage in outcome.coverage]),
                             ("dim", [f"{name}: left out: {reason}" for name, reason in outcome.rejected_data]),
                             ("yellow", [text for text in outcome.warnings if text not in logged_warnings])):
            for text in texts:
                print_line(f"  [{style}]{escape(text)}[/]")
    for sentence in lambda_warnings:
        print_line(f"  [yellow]{escape(sentence)}[/yellow]")


def collect_findings_by_drive(outcomes: Sequence[result.Identification]) -> dict[str, tuple[Finding, ...]]:
    return {name: findings for outcome in outcomes for name, findings in outcome.findings.items()}


def write_results(job: IdentificationJob, outcomes: Sequence[result.Identification], updated_vehicle: VehicleParameters,
                  now: datetime) -> dict[str, Path]:
    """Write figures, values, vehicle file and report; returns the paths by file name, without the figures."""
    data = list(job.files)
    if job.experiment.uses_recordings:  # the recordings instead of their folders
        data = [file for source in find_runs(job.files) for file in (*source.files, *source.can)
                if os.access(file, os.R_OK)]
    provenance = {"created": now.isoformat(timespec="seconds"), "experiment": job.experiment.name,
                  "vehicle": {"name": job.vehicle.name, "file": job.vehicle_file, "hash": job.vehicle.hash},
                  "files": hash_files(data), "versions": collect_versions()}
    output = FigureOutput(new_folder(job.folder, ""), ("png", "pdf"))
    figures = [draw(outcome, output) if (draw := EXPERIMENTS[outcome.experiment].draw) else None
               for outcome in outcomes]
    keys = [e.parameter for outcome in outcomes for e in outcome.estimates
            if e.parameter in FILE_QUANTITIES and e.status != "unidentifiable"]
    texts = {
        "identification.json": json_text({name: entry for outcome in outcomes
                                          for name, entry in outcome.to_document().items()}),
        "details.json": json_text(provenance | {"experiments": list(map(make_experiment_details, outcomes))}),
        "vehicle.yaml": edit_vehicle_text(Path(job.vehicle_file).read_text(encoding="utf-8"), keys, updated_vehicle),
        "report.html": render_page(outcomes, figures, job.vehicle, provenance),
    }
    for name, text in texts.items():
        (job.folder / name).write_text(text, encoding="utf-8")
    return {name: job.folder / name for name in texts}


def make_experiment_details(outcome: result.Identification) -> dict[str, Any]:
    """Entry of one experiment in details.json."""
    return {
        "experiment": outcome.experiment, "used": outcome.used_data,
        "rejected": [{"data": name, "reason": reason} for name, reason in outcome.rejected_data],
        "parameters": [e.parameter for e in outcome.estimates],
        "status": {e.parameter: e.status for e in outcome.estimates},
        "correlation": None if outcome.correlation is None else np.round(outcome.correlation, 6),
        "warnings": outcome.warnings,
        "findings": {name: findings_as_json(findings) for name, findings in outcome.findings.items()},
        "coverage": outcome.coverage,
    }


def render_page(outcomes: Sequence[result.Identification], figures: Sequence[PageFigure | None],
                vehicle: VehicleParameters, provenance: dict[str, Any]) -> str:
    """Content of report.html."""
    values = [f"{name} "
              + (status if status == "unidentifiable" else f"{value} {unit}".removesuffix(" 1") + f" ({status})")
              for outcome in outcomes for name, value, _, _, unit, _, status in make_estimate_rows(outcome, vehicle)]

    def make_excitation_table(c: result.Coverage) -> tuple[list[str], list[list[str]]]:
        return [f"from, {c.unit}", *(f"{edge:.4g}" for edge in c.edges[:-1])], [["samples", *map(str, c.counts)]]

    def make_correlation_table(outcome: result.Identification) -> tuple[list[str], list[list[str]]]:
        names = [estimate.parameter for estimate in outcome.estimates]
        assert outcome.correlation is not None  # the template calls this only if there is one
        return ["correlation", *names], [[name, *(f"{x:+.2f}" for x in row[:len(names)])]
                                         for name, row in zip(names, outcome.correlation, strict=False)]

    return load_template("identification/page.html.jinja").render(
        title=f"{vehicle.name}: {', '.join(values)}", provenance=provenance,
        outcomes=list(zip(outcomes, figures, strict=True)), heads=COLUMN_NAMES,
        findings=collect_findings_by_drive(outcomes), correlation=make_correlation_table,
        rows=lambda outcome: make_estimate_rows(outcome, vehicle), excitation=make_excitation_table)
