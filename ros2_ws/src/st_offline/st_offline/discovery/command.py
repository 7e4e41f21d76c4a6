"""What `st discover` does: read, discover with a progress bar, write and show the results."""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from st_core.discovery import Discovery, DiscoverySettings, discover
from st_core.discovery.where import survey
from st_core.effects import load_folder
from st_core.log import DriveLog
from st_core.model_file import ModelFile
from st_core.models import MODELS, Model, get_model
from st_core.vehicle import VehicleParameters

from ..checking.document import findings_in
from ..checking.shown import say
from ..evaluation.command import FORMATS
from ..evaluation.drawing import Drawn, Place
from ..output import new_folder
from ..runs import ReadSettings, find_runs
from . import words
from .document import Question, document, model_file, write_json
from .drive_figures import maps, over_time, paths
from .drives import Drive, cache_folder, read_drives
from .figures import Scene, candidates, conditions, gap
from .page import write_page


class CommandError(RuntimeError):
    """Nothing can be started; one line for the user."""


@dataclass(frozen=True)
class Job:
    """Arguments of the verb. output: None for runs/discover-<time>."""

    runs: Sequence[Path]
    reference: Sequence[Path]
    base: str
    vehicle: VehicleParameters
    vehicle_file: str
    settings: DiscoverySettings
    read: ReadSettings
    effects: Path | None
    output: Path | None
    jobs: int
    formats: tuple[str, ...]
    report: bool = True
    cached: bool = True
    force: bool = False


def run_command(job: Job, console: Console) -> int:
    """Exit status: 0 answered from all runs, 1 some runs could not be used. Raises CommandError, StCoreError."""
    unknown = [form for form in job.formats if form not in FORMATS]
    if unknown:
        raise CommandError(f"--figures: {unknown[0]} is not one of {', '.join(FORMATS)}")
    own = own_effects(job.effects)
    base = base_model(job.base, job.vehicle, job.vehicle_file)
    folder = new_folder(job.output, "discover")
    marks = [time.perf_counter()]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        runs, reference = _read(job, progress)
        marks.append(time.perf_counter())
        found = _discover(job, base, _logs(runs), _logs(reference), progress)
    marks.append(time.perf_counter())
    question = Question(runs, reference, job.base, job.vehicle, job.vehicle_file, job.settings, own)
    seconds = {"read": marks[1] - marks[0], "discover": marks[2] - marks[1]}
    with console.status("drawing, writing the report"):
        drawn = draw(found, question, Place(folder / "figures", job.formats)) if job.report else None
        files = write_results(found, question, folder, drawn, seconds)
    for drive in (*runs, *reference):
        say(drive.name, findings_in(drive.about), console)
    show(found, [d for d in (*runs, *reference) if d.problem], files, console)
    return 1 if any(d.problem for d in (*runs, *reference)) else 0


def own_effects(folder: Path | None) -> dict[str, str]:
    """Load a folder of effects; sha256 of its files by name. Raises ConfigurationError."""
    if folder is None:
        return {}
    load_folder(str(folder.absolute()))
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in sorted(folder.glob("*.py"))}


def base_model(name: str, vehicle: VehicleParameters, vehicle_file: str) -> Model:
    """The base model of a name or a model file. Raises CommandError or ConfigurationError, one line."""
    if not name.endswith((".yaml", ".yml")):
        if name not in MODELS:
            raise CommandError(f"--base {name}: there are {', '.join(MODELS)}, or a model file (.yaml)")
        return get_model(name)
    try:
        text = Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"--base {name}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    file = ModelFile.from_yaml(text, name)
    file.check_vehicle(vehicle, vehicle_file)
    return file.model()


def _read(job: Job, progress: Progress) -> tuple[list[Drive], list[Drive]]:
    sources = find_runs(job.runs)
    healthy = find_runs(job.reference) if job.reference else []
    if not sources:
        raise CommandError("no recording found")
    bar = progress.add_task("reading the runs", total=len(sources) + len(healthy))
    cache = cache_folder() if job.cached else None
    drives = read_drives([*sources, *healthy], job.vehicle, job.read, job.jobs, cache, lambda: progress.advance(bar),
                         job.force)
    runs, reference = drives[:len(sources)], drives[len(sources):]
    if not _logs(runs):
        raise CommandError("no run can be used: " + "; ".join(d.problem for d in runs))
    if healthy and not _logs(reference):
        raise CommandError("no --reference run can be used: " + "; ".join(d.problem for d in reference))
    mine = {digest for d in runs if d.log is not None for digest in d.about["files"].values()}
    for drive in reference:
        if drive.log is not None and mine & set(drive.about["files"].values()):
            raise CommandError(f"{drive.name} is given as a run and as --reference: what is suspect cannot be the "
                               "healthy car; take it off one of the lists")
    return _named_apart(runs, reference)


def _named_apart(runs: list[Drive], reference: list[Drive]) -> tuple[list[Drive], list[Drive]]:
    """A healthy drive of the same name as a run gets another: results speak of runs by name."""
    taken = {d.name for d in runs}
    renamed = []
    for drive in reference:
        name = drive.name if drive.name not in taken else f"{drive.name} (reference)"
        log = replace(drive.log, name=name) if drive.log is not None else None
        renamed.append(replace(drive, name=name, log=log))
    return runs, renamed


def _logs(drives: Sequence[Drive]) -> list[DriveLog]:
    return [d.log for d in drives if d.log is not None]


def _discover(job: Job, base: Model, runs: list[DriveLog], reference: list[DriveLog], progress: Progress) -> Discovery:
    bar = progress.add_task("", total=None)

    def stage(name: str, done: int, total: int) -> None:
        progress.update(bar, description=escape(name), completed=done, total=total)

    return discover(runs, job.vehicle, base, reference, job.settings, stage)


def draw(found: Discovery, question: Question, place: Place) -> list[Drawn]:
    """The figures that there are data for, in the order of the page."""
    runs, reference = _logs(question.runs), _logs(question.reference)
    # The channels that were used: one that not every run has was left out.
    channels = tuple(c for c in question.settings.channels if c in found.noise)
    settings = replace(question.settings, channels=channels)

    def look(model):
        return survey(runs, model, question.vehicle, settings, reference, found.noise,
                      found.acceleration_gain)

    scene = Scene(found, runs, question.vehicle, look(found.base), look(found.model) if found.model else None, place)
    return [figure for make in (gap, conditions, maps, over_time, paths, candidates) if (figure := make(scene))]


def write_results(found: Discovery, question: Question, folder: Path, drawn: Sequence[Drawn] | None,
                  seconds: dict[str, float]) -> dict[str, Path]:
    """All files; by what they are. drawn: None for no page."""
    files = {"discovery.json": folder / "discovery.json"}
    model = model_file(found, question)
    if model is not None:
        files["model.yaml"] = folder / "model.yaml"
        files["model.yaml"].write_text(model.to_yaml(), encoding="utf-8")
    content = document(found, question, seconds)
    write_json(files["discovery.json"], content)
    if drawn is not None:
        files = {"report.html": folder / "report.html", **files}
        write_page(files["report.html"], found, content, drawn)
    return files


WHAT = {"report.html": "one page, with all figures", "discovery.json": "every number, docs/discovery.md",
        "model.yaml": "st demo --model, st live --model, st evaluate --model"}


def show(found: Discovery, failed: Sequence[Drive], files: dict[str, Path], console: Console) -> None:
    """The verdict in a few lines."""
    console.print(f"[bold]{escape(words.title(found))}[/bold]", highlight=False)
    for question, answer in words.verdict(found):
        console.print(f"[bold]{question}[/bold]: {escape(answer)}", highlight=False)
    for warning in found.warnings:
        console.print(f"[yellow]{escape(warning)}[/yellow]", highlight=False)
    for drive in failed:
        console.print(f"[red]{escape(drive.name)}[/red]: {escape(drive.problem)}", highlight=False, soft_wrap=True)
    for name, file in files.items():
        console.print(f"  {escape(str(file))}  [dim]{WHAT[name]}[/dim]", highlight=False, soft_wrap=True)


