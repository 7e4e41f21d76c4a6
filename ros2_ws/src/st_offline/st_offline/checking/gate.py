"""The one place where recordings are checked: what was found, and whether an evaluation may go on."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from st_core.checks import AuxiliaryData, Checked, Finding, Severity, check
from st_core.checks.trial import step_too_long
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.models import MODELS, Model
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_recordings.recorded import configuration_of
from st_recordings.runs import LoadedRun, ReadSettings, RunError, RunSource, read

from . import check_report as words
from .check_report import documents

STEP = PredictionSettings().step
PROBLEMS = (RunError, StCoreError, MemoryError, OSError)
"""Errors that concern one of many runs; the others are processed."""
ADVICE = "correct it as `st check` proposes, or use it in spite of that with --force"


class Refused(RunError):
    """A recording with signals so wrong that an evaluation would be meaningless. findings: all of the run."""

    def __init__(self, where: Path | str, findings: Sequence[Finding]):
        self.findings = tuple(findings)
        errors = "; ".join(f"{one.name}: {one.text}" for one in findings if one.severity is Severity.ERROR)
        sign = words.opposite_sign(findings, str(where))
        super().__init__(where, f"{sign}; {errors}" if sign else errors, ADVICE)

    def __reduce__(self):  # errors travel between processes by their arguments
        return Refused, (self.path, self.findings)


def checked_log(log: DriveLog, vehicle: VehicleParameters, auxiliary: AuxiliaryData | None,
                models: Sequence[str | Model] = (), step: float = STEP) -> Checked:
    """All findings on a drive. models, step [s]: to be predicted with; none where nothing is predicted at that step."""
    checked = check(log, vehicle, auxiliary)
    too_long = step_too_long(models, vehicle, log, step) if models else None
    if too_long is None:
        return checked
    return replace(checked, findings=tuple(sorted((*checked.findings, too_long), key=words.gravity)))


def refuse(where: Path | str, findings: Sequence[Finding], force: bool) -> None:
    """Raises Refused where an error is among the findings, unless it is forced."""
    if not force and any(one.severity is Severity.ERROR for one in findings):
        raise Refused(where, findings)


def checked_run(where: Path | str, vehicle: VehicleParameters,
                force: bool) -> Callable[[LoadedRun], tuple[Finding, ...]]:
    """Function for `import_run`: returns the findings of a drive, or raises Refused for one that may not be used."""
    def findings_of(run: LoadedRun) -> tuple[Finding, ...]:
        findings = checked_log(run.log, vehicle, run.auxiliary).findings
        refuse(where, findings, force)
        return findings

    return findings_of


def passed_bag(bag: Path, vehicle: Path | None, force: bool, settings: ReadSettings | None = None) -> list[Finding]:
    """Findings of a recording for playing or comparing: with the vehicle, the models and the step stored in it, if any.
    Raises Refused, and RunError for what cannot be read.
    """
    run = read(RunSource(bag.stem, "bag", (bag,)), settings=settings)
    car, recorded, _ = configuration_of(run.provenance["recorded"], vehicle)
    # Until the vehicle is known, the angle of the hand wheel is read as that of the road wheels.
    steering = settings.steering if settings else None
    log = run.log.with_steering(car) if steering is not None and steering.quantity == "wheel" else run.log
    predictor = recorded.nodes.get("predictor", {})
    models = [model for model in predictor.get("models", MODELS) if model in MODELS]
    findings = checked_log(log, car, run.auxiliary, models, predictor.get("step", STEP)).findings
    refuse(bag, findings, force)
    return list(findings)


def passed(where: Path | str, run: LoadedRun, vehicle: VehicleParameters, force: bool,
           models: Sequence[str | Model] = (), step: float = STEP) -> list[dict[str, Any]]:
    """Findings of a drive that may be used, as plain values for a report. Raises Refused for one that may not."""
    findings = checked_log(run.log, vehicle, run.auxiliary, models, step).findings
    refuse(where, findings, force)
    return documents(findings)


def in_words(error: Exception, source: RunSource) -> str:
    """One line on one of PROBLEMS."""
    if isinstance(error, MemoryError):
        return f"{source.where}: too large for the memory of this machine"
    if isinstance(error, OSError):
        return f"{error.filename or source.where}: {error.strerror or error}"
    return " ".join(str(error).split())
