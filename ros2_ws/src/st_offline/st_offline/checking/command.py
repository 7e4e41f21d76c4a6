"""What `st check` does: read, check, say it, write it down."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from st_core.checks import Severity
from st_core.errors import StCoreError
from st_core.vehicle import VehicleParameters
from st_recordings.output import new_folder
from st_recordings.recorded import configuration_of
from st_recordings.runs import ReadSettings, RunError, RunSource, find_runs, read
from st_recordings.runs.bag import records_of

from .document import CheckedRun, document
from .gate import checked_log
from .page import write_page
from .proposal import check_name, proposal
from .shown import show, show_together

MODELS = ("linear", "nonlinear")


class CommandError(RuntimeError):
    """Nothing can be started; one line for the user."""


@dataclass(frozen=True)
class Job:
    """Arguments of the verb. vehicle: of vehicle_file; given: whether the user named it. output: None for
    runs/check-<time>. json: file for check.json, None for the folder. cure: file for a run.yaml, None for none.
    """

    paths: Sequence[Path]
    vehicle: VehicleParameters
    vehicle_file: str
    given: bool
    read: ReadSettings
    output: Path | None = None
    json: Path | None = None
    cure: Path | None = None


def run_command(job: Job, console: Console, told: Callable[[str], None] | None = None) -> int:
    """Exit status: 0 no error was found, 1 one was, or a run could not be read. Raises CommandError, OutputError.

    told: hears, where nobody named a vehicle file, of each that was used.
    """
    sources = find_runs(job.paths)
    if job.cure is not None:
        check_name(job.cure)
        if len(sources) != 1:
            raise CommandError(f"--propose-cure: {len(sources)} runs were given, and a run.yaml describes one: name it")
    folder = new_folder(job.output, "check", create=False)
    runs = check_all(sources, job, console)
    if all(run.problem for run in runs):
        raise CommandError("no run can be read: " + "; ".join(run.problem for run in runs))
    new_folder(folder, "")
    for run in runs:
        show(run, console)
    show_together([run.checked for run in runs if not run.problem], console)
    if told and not job.given:
        for file in sorted({run.vehicle_from for run in runs if not run.problem}):
            told(file)
    for file, what in write(runs, job, folder, console).items():
        console.print(f"  {escape(str(file))}  [dim]{what}[/dim]", highlight=False, soft_wrap=True)
    return int(any(run.problem or run.checked.of(Severity.ERROR) for run in runs))


def check_all(sources: Sequence[RunSource], job: Job, console: Console) -> list[CheckedRun]:
    """Every run, in the order of the sources."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("", total=len(sources))
        return [_watched(source, job, lambda: progress.advance(bar),
                         lambda text: progress.update(bar, description=escape(text))) for source in sources]


def _watched(source: RunSource, job: Job, done: Callable[[], None], say: Callable[[str], None]) -> CheckedRun:
    say(source.name)
    run = check_run(source, job)
    done()
    return run


def check_run(source: RunSource, job: Job) -> CheckedRun:
    """Read and check one run. What is wrong with its files becomes its `problem`, never an exception."""
    try:
        car, car_from = job.vehicle, job.vehicle_file
        if source.kind == "bag" and not job.given:
            car, _, car_from = configuration_of(records_of(source.where), None)
        run = read(source, car, job.read)
        checked = checked_log(run.log, car, run.extras, MODELS)
    except (RunError, StCoreError) as error:
        return CheckedRun(source, " ".join(str(error).split()))
    except MemoryError:
        return CheckedRun(source, f"{source.where}: too large for the memory of this machine")
    except OSError as error:
        return CheckedRun(source, f"{error.filename or source.where}: {error.strerror or error}")
    return CheckedRun(source, "", checked, car, car_from, run.log.duration, run.warnings, run.provenance["files"])


def write(runs: Sequence[CheckedRun], job: Job, folder: Path, console: Console) -> dict[Path, str]:
    """All files, with what they are."""
    content = document(runs)
    page, numbers = folder / "report.html", job.json or folder / "check.json"
    with console.status("drawing, writing the page"):
        write_page(page, runs, content)
        numbers.parent.mkdir(parents=True, exist_ok=True)
        numbers.write_text(json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
    files = {page: "one page, with all comparisons", numbers: "every number, docs/manual/checks.md"}
    if job.cure is not None:
        text = proposal(runs[0].source, runs[0].checked.findings, job.cure, job.read)
        job.cure.parent.mkdir(parents=True, exist_ok=True)
        job.cure.write_text(text, encoding="utf-8")
        files[job.cure] = "the run with its cures, for every verb"
    return files
