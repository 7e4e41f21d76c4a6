"""Plays a recording through predictor, evaluator and recorder, on the clock of the recording."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from st_recordings.results import find_configuration
from st_recordings.runs import ReadSettings
from st_recordings.runs.bag import read_bag, was_interrupted
from st_recordings.runs.bag_storage import find_file_text
from st_recordings.runs.cdr import ODOMETRY, STEERING
from st_recordings.runs.errors import RunError
from st_recordings.runs.reconstruct import RECONSTRUCTED_SUFFIX

from . import session
from .configuration import REPLAY_NODES, TRUNCATION_WARNING, make_replay_parameters, set_bands_and_course
from .page import LiveView
from .suite import Suite


def replay_bag(bag: Path, folder: Path, vehicle: Path | None, rate: float, console: Console,
               view: LiveView = LiveView(False), bands: Path | None = None, course: Path | None = None,
               adaptive: bool | None = None, settings: ReadSettings = ReadSettings()) -> tuple[session.Outcome, str]:
    """Replay a bag with its recorded configuration; returns the outcome and the name of the vehicle.

    The nodes record into folder/bag and folder/errors. vehicle, course: files to use instead of the recorded ones.
    rate: playback speed relative to the recording; 0: as fast as the nodes can follow. bands, adaptive: as for
    `set_bands_and_course`. settings: topics of external recordings. Raises RunError, SuiteError and ConfigurationError.
    """
    steering = settings.steering
    drive = read_bag(bag, steering=steering, odometry=settings.odometry)
    missing = [name for name in (ODOMETRY, STEERING) if drive.topics[name].endswith(RECONSTRUCTED_SUFFIX)]
    if missing:
        raise RunError(bag, f"cannot be played: no {' and no '.join(missing)}",
                       "use st evaluate, which reconstructs them from raw packets and frames")
    if drive.conversions:
        raise RunError(bag, f"cannot be played as recorded: {drive.conversions[0]}",
                       "st check, st evaluate and st discover convert it")
    for line in describe_omissions(bag, drive.unknown_topics):
        console.out(line, style="yellow", highlight=False)
    car, recorded, _ = find_configuration(drive.records, vehicle)
    recorded_predictor = recorded.nodes.get("predictor", {})
    files = {"vehicle": folder / "vehicle.yaml"}
    files["vehicle"].write_text(car.to_yaml())
    for name in ("model", "course"):  # the files named in the recording may have moved or changed
        if text := find_file_text(drive.records, recorded_predictor.get(f"{name}_file", "")):
            files[name] = folder / f"{name}.yaml"
            files[name].write_text(text)
    parameters = make_replay_parameters(folder, files["vehicle"], recorded, files.get("model"))
    parameters = set_bands_and_course(parameters, bands, course or files.get("course"), adaptive)
    if "map_frame" not in recorded_predictor:
        for node in ("predictor", "evaluator"):  # external recordings may use a different frame
            parameters[node]["map_frame"] = drive.frame
    predictor = parameters["predictor"]
    player = {"bag": str(bag.absolute()), "rate": rate, "odometry": drive.topics[ODOMETRY],
              "steering": drive.topics[STEERING], "steering_field": steering and asdict(steering),
              "steering_ratio": car.steering_ratio, "steering_wheel_offset": car.steering_wheel_offset,
              "horizon": predictor["horizon"], "tick_rate": predictor["rate"], "models": predictor["models"]}
    nodes = [("st_predictor", name) for name in REPLAY_NODES]
    outcome = session.run(folder, parameters, bag.name, console, view, lambda suite: _play(suite, player), nodes)
    status = _read_last_status(folder / "logs" / "player.log")
    if status.get("wall") and not outcome.interrupted:
        speed = status["duration"] / status["wall"]
        console.out(f"{status['duration']:.1f} s played in {status['wall']:.1f} s ({speed:.1f} x)", highlight=False)
    return outcome, car.name


def describe_omissions(bag: Path, unknown: Sequence[str]) -> list[str]:
    """Lines about content that a replay omits: topics of unknown type, and the missing end of a truncated recording."""
    topics = [f"topics of unknown type, not played: {', '.join(unknown)}"] if unknown else []
    return topics + ([TRUNCATION_WARNING.format(bag, "played")] if was_interrupted(bag) else [])


def _play(suite: Suite, settings: Mapping[str, Any]) -> session.Progress:
    """Start the player; returns its progress, in recording time."""
    command = [sys.executable, "-m", "st_live.nodes.player", json.dumps(settings)]
    player = suite.start("player", command, may_end=True)

    def read_progress() -> tuple[float, float | None, bool]:
        is_over, status = player.process.poll() == 0, _read_last_status(player.log)
        return status.get("played", 0.0), status.get("duration"), is_over

    return read_progress


def _read_last_status(log: Path) -> dict[str, Any]:
    """The newest status that the player has printed; empty before its first one."""
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    return next((json.loads(line) for line in reversed(lines) if line.startswith("{")), {})
