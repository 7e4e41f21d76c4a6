"""The command `st check`: checks runs, prints and writes the findings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from st_core.checks import Severity, compare_runs
from st_core.errors import ConfigurationError
from st_core.vehicle import VehicleParameters
from st_recordings.paths import json_text, new_folder
from st_recordings.recorded_results import find_configuration
from st_recordings.runs import ReadSettings, RunSource, find_runs, read
from st_recordings.runs.bag import read_metadata_records
from st_recordings.runs.errors import join_problems
from st_recordings.runs.raw import summarise_alignment

from ..terminal import list_files, make_progress_bars, print_line, report_problem
from .check_page import write_page
from .check_report import CheckedRun, document, print_runs
from .gate import RUN_ERRORS, check_log, describe_problem
from .run_corrections import check_file_name, run_yaml

MODELS = ("linear", "nonlinear")  # checked for stable integration


@dataclass(frozen=True)
class CheckJob:
    """Options of `st check`. vehicle: read from vehicle_file; vehicle_is_given: whether the user named that file.
    output: folder, None for runs/check-<time>. json: file instead of check.json in that folder. correction_file:
    run.yaml to write."""

    paths: Sequence[Path]
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_is_given: bool
    read: ReadSettings
    output: Path | None = None
    json: Path | None = None
    correction_file: Path | None = None


def run_command(job: CheckJob, console: Console, report_vehicle: Callable[[str], None] | None = None) -> int:
    """Run the command; returns the exit status: 1 if a run has an error or could not be read, else 0. report_vehicle:
    called with each vehicle file in use, if none was given. Raises ConfigurationError, OutputError."""
    sources = find_runs(job.paths)
    if job.correction_file is not None:
        check_file_name(job.correction_file)
        if len(sources) != 1:
            raise ConfigurationError(f"--propose-correction: {len(sources)} runs were given, but a run.yaml describes "
                                     "one: give one run")
    folder = new_folder(job.output, "check", create=False)
    checked_runs: list[CheckedRun] = []
    unreadable: dict[str, str] = {}
    with make_progress_bars(console) as progress:
        for source in progress.track(sources, description="checking"):
            try:
                checked_runs.append(check_run(source, job))
            except RUN_ERRORS as error:
                unreadable[source.name] = describe_problem(error, source)
    if not checked_runs:
        raise ConfigurationError("no run can be read: " + join_problems(unreadable.values()))
    new_folder(folder, "")
    print_runs(checked_runs, console)
    for name, problem in unreadable.items():
        report_problem(name, problem, console)
    for number, quantity in enumerate(compare_runs([run.checked for run in checked_runs])):
        print_line(f"{'' if number else '[bold]all runs together[/bold]' + chr(10)}  {escape(quantity.text)}", console)
    if report_vehicle and not job.vehicle_is_given:
        for file in sorted({run.vehicle_from for run in checked_runs}):
            report_vehicle(file)
    files = write_results(checked_runs, unreadable, folder, job.json, console)
    if target := job.correction_file:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(run_yaml(sources[0], checked_runs[0].checked.findings, target, job.read), encoding="utf-8")
        files[target] = "the run with its corrections, for every command"
    list_files(files, console)
    return int(bool(unreadable) or any(run.checked.with_severity(Severity.ERROR) for run in checked_runs))


def check_run(source: RunSource, job: CheckJob) -> CheckedRun:
    """Read and check one run. Raises one of gate.RUN_ERRORS for a run that cannot be read."""
    car, car_from = job.vehicle, job.vehicle_file
    if source.kind == "bag" and not job.vehicle_is_given:
        car, _, car_from = find_configuration(read_metadata_records(source.where), None)
    run = read(source, car, job.read)
    checked = check_log(run.log, car, run.auxiliary, MODELS)
    return CheckedRun(source.name, checked, car, car_from, run.log.duration, run.warnings, run.provenance["files"],
                      summarise_alignment(run.alignment), source.arguments)


def write_results(checked_runs: Sequence[CheckedRun], unreadable: Mapping[str, str], folder: Path, json: Path | None,
                  console: Console) -> dict[Path, str]:
    """Write page and JSON file; returns their descriptions by path."""
    content = document(checked_runs, unreadable)
    page, numbers = folder / "report.html", json or folder / "check.json"
    with console.status("drawing, writing the page"):
        write_page(page, checked_runs, unreadable, content)
        numbers.parent.mkdir(parents=True, exist_ok=True)
        numbers.write_text(json_text(content), encoding="utf-8")
    return {page: "one page, with the findings and figures", numbers: "all numbers; keys in docs/manual/checks.md"}
