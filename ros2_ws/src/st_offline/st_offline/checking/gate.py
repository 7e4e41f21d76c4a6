"""Checks recordings before a command uses them, and rejects recordings with errors."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from st_core.checks import AuxiliaryData, DriveCheck, Finding, Severity, check
from st_core.checks.trial import check_step_length
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.models import MODELS, Model
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_recordings.results import find_configuration
from st_recordings.runs import LoadedRun, ReadSettings, RunError, RunSource, read
from st_recordings.runs.bag import lacks_odometry, may_carry_steering, may_need_can_frames
from st_recordings.runs.bag_storage import ROS1_EXTENSION, open_bag
from st_recordings.runs.cdr import CAN_MSGS_FRAME, ODOMETRY

from . import check_report

STEP = PredictionSettings().step
RUN_ERRORS = (RunError, StCoreError, MemoryError, OSError)  # errors of one run; the other runs are still processed
ADVICE = "follow the advice of `st check`, or use the recording anyway with --force"


class RejectedRunError(RunError):
    """A recording has errors that make an evaluation meaningless. findings: all findings of the run."""

    def __init__(self, source: Path | str, findings: Sequence[Finding]):
        self.findings = tuple(findings)
        errors = "; ".join(f"{finding.name}: {finding.text}" for finding in findings
                           if finding.severity is Severity.ERROR)
        sign = check_report.advise_steering_sign(findings, str(source))
        super().__init__(source, f"{sign}; {errors}" if sign else errors, ADVICE)


def check_log(log: DriveLog, vehicle: VehicleParameters, auxiliary: AuxiliaryData | None,
              models: Sequence[str | Model] = (), step: float = STEP) -> DriveCheck:
    """Check a drive. models: checked for stable integration with `step` [s]; empty if nothing is predicted."""
    result = check(log, vehicle, auxiliary)
    too_long = check_step_length(models, vehicle, log, step) if models else None
    if too_long is None:
        return result
    return replace(result, findings=tuple(sorted((*result.findings, too_long), key=check_report.rank_severity)))


def raise_for_errors(source: Path | str, findings: Sequence[Finding], force: bool) -> None:
    """Raise RejectedRunError if the findings contain an error, unless forced."""
    if not force and any(finding.severity is Severity.ERROR for finding in findings):
        raise RejectedRunError(source, findings)


def check_bag(bag: Path, vehicle: Path | None, force: bool, settings: ReadSettings = ReadSettings()) -> list[Finding]:
    """Check a bag before its replay, with its recorded built-in models and step; returns the findings.

    vehicle: file to use instead of the recorded vehicle (the default vehicle if none is recorded). Raises
    RejectedRunError for errors (unless forced), RunError for an unusable bag, StCoreError for an invalid vehicle file.
    """
    if bag.suffix.lower() == ROS1_EXTENSION:
        raise RunError(bag, "the nodes cannot receive ROS 1 messages",
                       "convert the bag with rosbags-convert; st check, evaluate and discover read it as it is")
    if settings.steering is None and may_need_can_frames(bag):
        has_other = any(map(may_carry_steering, open_bag(bag).topics))
        other = ", or name a topic with --steering-topic" if has_other else ""
        raise RunError(bag, f"its steering is only in CAN frames ({CAN_MSGS_FRAME}), which the nodes do not receive",
                       f"use st check, evaluate or discover, which decode them{other}")
    if settings.odometry is None and lacks_odometry(bag):
        raise RunError(bag, f"it contains no message of type {ODOMETRY}, which the nodes need",
                       "use st check, evaluate or discover, which can read a drive from other messages")
    run = read(RunSource(bag.stem, "bag", (bag,)), settings=settings)
    car, recorded, _ = find_configuration(run.provenance["recorded"], vehicle)
    # The bag is read before its vehicle is known: a steering-wheel angle is read with a ratio of 1 and converted here.
    is_steering_wheel_angle = settings.steering is not None and settings.steering.quantity == "wheel"
    log = run.log.with_steering(car) if is_steering_wheel_angle else run.log
    predictor = recorded.nodes.get("predictor", {})
    models = [model for model in predictor.get("models", MODELS) if model in MODELS]
    findings = check_log(log, car, run.auxiliary, models, predictor.get("step", STEP)).findings
    raise_for_errors(bag, findings, force)
    return list(findings)


def check_before_use(source: Path | str, run: LoadedRun, vehicle: VehicleParameters, force: bool,
                     models: Sequence[str | Model] = (), step: float = STEP) -> tuple[Finding, ...]:
    """Check a drive; returns its findings. Raises RejectedRunError for errors, unless forced."""
    findings = check_log(run.log, vehicle, run.auxiliary, models, step).findings
    raise_for_errors(source, findings, force)
    return findings


def describe_problem(error: Exception, source: RunSource) -> str:
    """One-line text of an exception that is one of RUN_ERRORS."""
    if isinstance(error, MemoryError):
        return f"{source.path}: too large for the memory of this machine"
    if isinstance(error, OSError):
        return f"{error.filename or source.path}: {error.strerror or error}"
    return " ".join(str(error).split())
