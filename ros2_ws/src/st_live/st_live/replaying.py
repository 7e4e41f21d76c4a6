"""Plays a recording through predictor, evaluator and recorder, with the time of the recording."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from st_recordings.recorded_results import find_configuration
from st_recordings.runs import ReadSettings
from st_recordings.runs.bag import read_bag, was_interrupted
from st_recordings.runs.bag_storage import recorded_text
from st_recordings.runs.cdr import ODOMETRY, STEERING
from st_recordings.runs.errors import RunError
from st_recordings.runs.reconstruct import RECONSTRUCTED

from .configuration import REPLAY_NODES, TRUNCATION_WARNING, make_replay_parameters, set_bands_and_course
from .node import Monitor
from .page import LiveView
from .session import Outcome, start_nodes
from .suite import Child, Parameters, Suite, SuiteError, claim_domain, read_domain_id

DRAIN_TIME = 1.0  # s after the last message, for the last predictions to reach evaluator and recorder
PROGRESS_PERIOD = 0.2  # s


def replay_bag(bag: Path, folder: Path, vehicle: Path | None, rate: float, console: Console,
               view: LiveView | None = None, bands: Path | None = None, course: Path | None = None,
               adaptive: bool | None = None, settings: ReadSettings = ReadSettings()) -> tuple[Outcome, str]:
    """Replay a bag with its recorded configuration; returns the outcome and the name of the vehicle.

    The nodes record into folder/bag and folder/errors. vehicle, course: files to use instead of the recorded ones.
    rate: playback speed relative to the recording; 0: as fast as the nodes can follow. bands, adaptive: as for
    `set_bands_and_course`. settings: topics of external recordings. Raises RunError, SuiteError and ConfigurationError.
    """
    steering = settings.steering
    drive = read_bag(bag, steering=steering, odometry=settings.odometry)
    reconstructed = [name for name in (ODOMETRY, STEERING) if drive.topics[name].endswith(RECONSTRUCTED)]
    if reconstructed:
        raise RunError(bag, f"cannot be played: no {' and no '.join(reconstructed)}",
                       "st evaluate and st verify reconstruct them from raw packets and frames")
    for line in describe_omissions(bag, drive.unknown):
        console.out(line, style="yellow", highlight=False)
    car, recorded, _ = find_configuration(drive.records, vehicle)
    file = folder / "vehicle.yaml"
    file.write_text(car.to_yaml())
    course_text = recorded_text(drive.records, str(recorded.nodes.get("predictor", {}).get("course_file", "")))
    if course is None and course_text is not None:
        course = folder / "course.yaml"
        course.write_text(course_text)
    parameters = set_bands_and_course(make_replay_parameters(folder, file, recorded), bands, course, adaptive)
    if "map_frame" not in recorded.nodes.get("predictor", {}):
        for node in ("predictor", "evaluator"):  # external recordings may use another frame
            parameters[node]["map_frame"] = drive.frame
    predictor = parameters["predictor"]
    player = {"bag": str(bag.absolute()), "rate": rate, "odometry": drive.topics[ODOMETRY],
              "steering": drive.topics[STEERING], "steering_field": steering and asdict(steering),
              "steering_ratio": car.steering_ratio, "steering_wheel_offset": car.steering_wheel_offset,
              "horizon": predictor["horizon"], "tick_rate": predictor["rate"], "models": predictor["models"]}
    return _play(player, folder, parameters, console, view), car.name


def describe_omissions(bag: Path, unknown: Sequence[str]) -> list[str]:
    """Lines about content that a replay omits: topics of unknown type, and the missing end of a truncated recording."""
    topics = [f"of unknown type and not played: {', '.join(unknown)}"] if unknown else []
    return topics + ([TRUNCATION_WARNING.format(bag, "played")] if was_interrupted(bag) else [])


def _play(settings: Mapping[str, Any], folder: Path, parameters: Parameters, console: Console,
          view: LiveView | None) -> Outcome:
    """Run nodes and player. settings: of the player."""
    problem, interrupted, name = "", False, Path(settings["bag"]).name
    with (claim_domain(read_domain_id()) as domain, Suite(folder, parameters, domain) as suite,
          Monitor(domain) as monitor):
        start_nodes(suite, monitor, [("st_predictor", name) for name in REPLAY_NODES])
        if view:
            view.open(folder, domain, parameters["predictor"], name, console)
        player = suite.start("player", [sys.executable, "-m", "st_live.nodes.player", json.dumps(settings)])
        try:
            _watch(suite, player, name, settings["rate"], console)
        except SuiteError as error:
            problem = str(error)
        except KeyboardInterrupt:
            interrupted = True
        statuses = suite.stop("player")
        time.sleep(DRAIN_TIME)
        for node in reversed(REPLAY_NODES):
            statuses.update(suite.stop(node))
    return Outcome(statuses, interrupted, problem)


def _watch(suite: Suite, player: Child, name: str, rate: float, console: Console) -> None:
    """Show progress until the player has finished. Raises SuiteError if it fails or another process ends first."""
    speed = f"{rate:g} x" if rate > 0 else "as fast as the nodes can follow"
    columns = (TextColumn("{task.description}"), BarColumn(),
               TextColumn("{task.completed:.0f} s of {task.total} s"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task(f"{name}, {speed}", total=None)
        while player.process.poll() is None:
            time.sleep(PROGRESS_PERIOD)
            if player.process.poll() is None:
                suite.check()
            status = _read_last_status(player)
            progress.update(bar, completed=status.get("played", 0.0), total=status.get("duration", 1.0))
    if player.process.returncode:
        raise SuiteError(f"the player ended with status {player.process.returncode}: {player.read_last_lines()}")
    status = _read_last_status(player)
    if status.get("wall"):
        speed = status["duration"] / status["wall"]
        console.print(f"{status['duration']:.1f} s played in {status['wall']:.1f} s ({speed:.1f} x)", highlight=False)


def _read_last_status(player: Child) -> dict[str, Any]:
    lines = [line for line in player.log.read_text(errors="replace").splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {}
