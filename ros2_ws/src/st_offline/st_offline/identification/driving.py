"""`st identify` from driving: steering offset, ratio, INS mounting, cornering stiffness, yaw inertia."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from st_core.errors import StCoreError
from st_core.identification.cornering_stiffness import identify_stiffness
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import Identification, IdentificationError, contradiction
from st_core.identification.steering_driving import identify_steering
from st_core.identification.steering_offset import identify_steering_offset
from st_core.identification.stiffness_prediction import predict_stiffness
from st_core.identification.yaw_inertia import identify_yaw_inertia
from st_core.log import DriveLog

from ..runs import RunError, find_runs, read
from . import driving_figures as figures
from .experiment import Experiment, Setup

DISAGREEMENT = 0.15
ADVICE = "Steering ratio or lever arm may be wrong: run `st identify steering` and `st identify ins` first."
RECORDINGS = "recordings of drives, several are better: folders, .ncom with CAN logs, bags, CSV"


def drives(files: Sequence[Path], setup: Setup) -> tuple[list[DriveLog], list[tuple[str, str]], list[str]]:
    """(logs, (name, why) of what could not be read, warnings). Raises RunError when nothing could be read."""
    logs, failed, warnings = [], [], []
    first: Exception | None = None
    for source in find_runs(files):
        try:
            run = read(source, setup.vehicle, setup.read)
        except (RunError, StCoreError) as error:
            first = first or error
            failed.append((source.name, str(error)))
            continue
        logs.append(run.log)
        warnings += [warning for warning in run.warnings if warning not in warnings]
    if not logs:
        raise first or IdentificationError("no drives were given; name at least one recording")
    return logs, failed, warnings


def experiment(name: str, what: str, needs: str, compute: Callable[..., Identification], draw) -> Experiment:
    """compute(logs, vehicle, seed=...) -> Identification."""
    def identify(files: Sequence[Path], setup: Setup) -> tuple[Identification, ...]:
        logs, failed, warnings = drives(files, setup)
        found = compute(logs, setup.vehicle, seed=setup.seed)
        return (replace(found, what=name, rejected=(*failed, *found.rejected),
                        warnings=(*found.warnings, *warnings)),)

    return Experiment(name, what, f"{RECORDINGS}; {needs}", identify, draw)


def stiffness(logs: Sequence[DriveLog], vehicle, seed: int) -> Identification:
    """By prediction; the paper's regression of the same drives stands beside it in the figure and in words."""
    found = predict_stiffness(logs, vehicle, seed=seed, profiles=True)
    try:
        paper = identify_stiffness(logs, vehicle, seed=seed)
    except IdentificationError as error:
        return replace(found, warnings=(*found.warnings, f"The paper's regression could not be made: {error}"))
    estimates, said = [], []
    for one in found.estimates:
        other = paper[one.parameter]
        words = contradiction(one, other.value, other.standard_uncertainty, "the paper's regression")
        if words and abs(one.value - other.value) > DISAGREEMENT * other.value:
            # A regression averages over the tyre's curve, so a few per cent are expected; more is a fault elsewhere.
            words += f" {ADVICE}"
            estimates.append(replace(one, status="doubtful", verdict=f"{one.verdict} Doubtful: {ADVICE}"))
        else:
            estimates.append(one)
        said.append(words or f"The paper's regression gives {one.parameter} {other.value:.0f} +/- "
                    f"{other.standard_uncertainty:.0f} N/rad, which agrees.")
    return replace(found, estimates=tuple(estimates), warnings=(*found.warnings, *said),
                   figure={**found.figure, "paper": paper})


DRIVING = (
    experiment("steering-offset", "offset of the steering wheel sensor, two ways", "straight on, above 5 m/s",
               identify_steering_offset, figures.offset),
    experiment("steering", "steering ratio and offset, without turntables", "bends and straights at several speeds",
               identify_steering, figures.prediction),
    experiment("ins", "lever arm and misalignment of the INS", "2 to 9 m/s, straights and bends to both sides",
               identify_ins_mounting, figures.mounting),
    experiment("stiffness", "cornering stiffnesses, by prediction", "bends to both sides, up to 4 m/s^2", stiffness,
               figures.stiffness),
    experiment("stiffness-paper", "cornering stiffnesses, the paper's regression", "bends to both sides",
               identify_stiffness, figures.regression),
    experiment("yaw-inertia", "yaw inertia", "steps, lane changes, sweeps", identify_yaw_inertia, figures.prediction),
)
