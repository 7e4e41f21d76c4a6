"""`st identify` from driving: steering offset, ratio, INS mounting, cornering stiffness, yaw inertia."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from st_core.checks import Finding
from st_core.errors import StCoreError
from st_core.identification.cornering_stiffness import identify_stiffness
from st_core.identification.driving_prediction import identify_steering, identify_yaw_inertia, predict_stiffness
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import Identification, IdentificationError, contradiction
from st_core.identification.steering_offset import identify_steering_offset
from st_core.log import DriveLog
from st_core.models import MODELS, Model
from st_recordings.runs import RunError, find_runs, read

from ..checking.gate import checked_log, refuse
from . import driving_figures as figures
from .experiment import Experiment, Setup

DISAGREEMENT = 0.15
ADVICE = "Steering ratio or lever arm may be wrong: run `st identify steering` and `st identify ins` first."
RECORDINGS = "recordings of drives, several are better: folders, .ncom with CAN logs, bags, CSV"


@dataclass
class Drives:
    """What was read. failed: (name, why) of what could not be or must not be used. findings: of the checks, by name."""

    logs: list[DriveLog] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    findings: dict[str, tuple[Finding, ...]] = field(default_factory=dict)


def drives(files: Sequence[Path], setup: Setup) -> Drives:
    """Every drive in the files, checked. Raises RunError when none can be used."""
    found = Drives()
    first: Exception | None = None
    for source in find_runs(files):
        try:
            run = read(source, setup.vehicle, setup.read)
            found.findings[source.name] = checked_log(run.log, setup.vehicle, run.auxiliary).findings
            refuse(source.where, found.findings[source.name], setup.force)
        except (RunError, StCoreError) as error:
            first = first or error
            found.failed.append((source.name, str(error)))
            continue
        found.logs.append(run.log)
        found.warnings += [warning for warning in run.warnings if warning not in found.warnings]
    if not found.logs:
        raise first or IdentificationError("no drives were given; name at least one recording")
    return found


def experiment(name: str, what: str, needs: str, compute: Callable[..., Identification], draw,
               predicts: bool = False) -> Experiment:
    """compute(logs, vehicle) -> Identification; predicts: it takes a model, base=..., too."""
    def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
        if not predicts and setup.model is not MODELS["nonlinear"]:
            raise IdentificationError(f"{name} predicts nothing, so it has no use for a --model")
        given = drives(files, setup)
        found = compute(given.logs, setup.vehicle, **({"base": setup.model} if predicts else {}))
        return (replace(found, what=name, rejected=(*given.failed, *found.rejected),
                        warnings=(*found.warnings, *given.warnings), findings=given.findings),)

    return Experiment(name, what, f"{RECORDINGS}; {needs}", identify, draw)


def stiffness(logs: Sequence[DriveLog], vehicle, base: Model) -> Identification:
    """By prediction; the paper's regression of the same drives is in the figure and the warnings."""
    found = predict_stiffness(logs, vehicle, base)
    try:
        paper = identify_stiffness(logs, vehicle)
    except IdentificationError as error:
        return replace(found, warnings=(*found.warnings, f"The paper's regression could not be made: {error}"))
    estimates, comparisons = [], []
    for one in found.estimates:
        other = paper[one.parameter]
        if other.status == "unidentifiable":
            estimates.append(one)
            comparisons.append(f"The paper's regression gives no {one.parameter}: {other.verdict}")
            continue
        words = contradiction(one, other.value, other.standard_uncertainty, "the paper's regression")
        if words and abs(one.value - other.value) > DISAGREEMENT * other.value:
            # A regression averages over the tyre's curve, so a few per cent are expected; more is a fault elsewhere.
            words += f" {ADVICE}"
            estimates.append(replace(one, status="doubtful", verdict=f"{one.verdict} Doubtful: {ADVICE}"))
        else:
            estimates.append(one)
        comparisons.append(words or f"The paper's regression gives {one.parameter} {other.value:.0f} +/- "
                    f"{other.standard_uncertainty:.0f} N/rad, which agrees.")
    return replace(found, estimates=tuple(estimates), warnings=(*found.warnings, *comparisons),
                   figure={**found.figure, "paper": paper})


DRIVING = (
    experiment("steering-offset", "offset of the steering wheel sensor, two ways", "straight on, above 5 m/s",
               identify_steering_offset, figures.offset),
    experiment("steering", "steering ratio and offset, without turntables", "bends and straights at several speeds",
               identify_steering, figures.prediction, predicts=True),
    experiment("ins", "lever arm and misalignment of the INS", "2 to 9 m/s, straights and bends to both sides",
               identify_ins_mounting, figures.mounting),
    experiment("stiffness", "cornering stiffnesses, by prediction", "bends to both sides, up to 4 m/s^2", stiffness,
               figures.stiffness, predicts=True),
    experiment("stiffness-paper", "cornering stiffnesses, the paper's regression", "bends to both sides",
               identify_stiffness, figures.regression),
    experiment("yaw-inertia", "yaw inertia", "steps, lane changes, sweeps", identify_yaw_inertia, figures.prediction,
               predicts=True),
)
