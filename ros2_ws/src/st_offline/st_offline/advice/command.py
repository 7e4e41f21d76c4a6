"""What `st evaluate --advise` does beyond an evaluation: each model at three steps, on the same runs."""

import csv
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rich.console import Console
from rich.markup import escape
from st_core.bands import NotFiniteError, RunSamples, run_samples
from st_core.errors import ConfigurationError, StCoreError
from st_core.log_evaluation import EvaluationSettings
from st_core.log_signals import LogSignals
from st_core.models import Model
from st_core.stability import StepTooLongWarning
from st_recordings.runs import RunError, RunSource, read

from ..evaluation.drawing import Place
from ..evaluation.work import Task, load_models
from ..terminal import line, tell_files
from . import shown
from .choice import Key, cheapest
from .cost import Cost, costs
from .worth import Worth, worth

MULTIPLES = (1, 2, 4)
"""Of the integration step of the task."""


@dataclass(frozen=True)
class Advice:
    """costs and worths by model and step [s]. unusable: why a model at a step has no worth, by both. tolerance: [m]."""

    costs: Mapping[Key, Cost]
    worths: Mapping[Key, Worth]
    unusable: Mapping[Key, str]
    tolerance: float


def advise(sources: Sequence[RunSource], task: Task, tolerance: float, console: Console) -> None:
    """Tables on the terminal, advice.csv, and advice.* beside the other figures. Runs that cannot be used were named by
    the evaluation before.
    """
    with console.status("cost and worth of each model and step"):
        advice = measure(sources, task, tolerance)
    found = shown.rows(advice.costs, advice.worths)
    console.print(shown.table(found, "Cost, error and band of each model and step", shown.caption(advice.worths)))
    chosen = shown.choice_rows(cheapest(advice.costs, advice.worths, tolerance))
    console.print(shown.table(chosen, shown.choice_title(tolerance), ""))
    for (model, step), why in advice.unusable.items():
        line(f"[yellow]{escape(model)}, {step:g} s: {escape(why)}[/yellow]", console)
    if task.folder is None:
        return
    file = task.folder / "advice.csv"
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(found[0]))
        writer.writeheader()
        writer.writerows(found)
    if advice.worths:
        shown.figure(advice.costs, advice.worths, tolerance, Place(task.folder, task.formats))
    tell_files({file: "cost, error and band of each model and step"}, console)


def measure(sources: Sequence[RunSource], task: Task, tolerance: float) -> Advice:
    """Raises ConfigurationError where no run can be used."""
    settings = {one.prediction.step: one for one in steps(task.settings)}
    models = load_models(task)
    samples: dict[Key, list[RunSamples]] = {}
    unusable: dict[Key, str] = {}
    longest: LogSignals | None = None
    with warnings.catch_warnings():
        # A step that is too long for a model shows as its errors, or as their absence.
        warnings.simplefilter("ignore", StepTooLongWarning)
        for source in sources:
            try:
                log = read(source, task.vehicle, task.read).log
            except (RunError, StCoreError):
                continue
            signals = task.settings.signals(log)
            if log.overlap < task.settings.prediction.horizon:
                continue
            if longest is None or log.overlap > longest.log.overlap:
                longest = signals
            for step, one in settings.items():
                for model in models:
                    _collect(model, signals, one, task, samples.setdefault((model.name, step), []), unusable)
        if longest is None:
            raise ConfigurationError("--advise: no run is as long as the horizon; give longer ones")
        paid = costs(models, task.vehicle, longest, settings)
    worths = {}
    for (name, step), runs in samples.items():
        if not runs or (name, step) in unusable:
            continue
        try:
            worths[name, step] = worth(runs, name, settings[step])
        except StCoreError as error:
            unusable[name, step] = str(error)
    return Advice(paid, worths, unusable, tolerance)


def steps(settings: EvaluationSettings) -> list[EvaluationSettings]:
    """The same with MULTIPLES of the step, as far as a second and the horizon are whole numbers of them."""
    found = []
    for multiple in MULTIPLES:
        step = round(multiple * settings.prediction.step, 9)
        whole = all(math.isclose(span / step, round(span / step), abs_tol=1e-9)
                    for span in (1.0, settings.prediction.horizon))
        if multiple == 1 or whole:
            found.append(replace(settings, prediction=replace(settings.prediction, step=step)))
    return found


def _collect(model: Model, signals: LogSignals, settings: EvaluationSettings, task: Task, found: list[RunSamples],
             unusable: dict[Key, str]) -> None:
    try:
        found.append(run_samples([model], task.vehicle, signals, settings))
    except NotFiniteError as error:
        unusable[model.name, settings.prediction.step] = f"{signals.log.name}: {error}"
    except StCoreError:
        # No start with a whole horizon: true of every model and step.
        return
