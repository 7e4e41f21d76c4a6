"""A recording through the real nodes: predictor, evaluator and recorder on the recording's own clock."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from st_recordings.paths import config
from st_recordings.recorded import RecordedConfiguration
from st_recordings.runs.messages import ODOMETRY, STEERING

from .node import Monitor
from .session import START_TIMEOUT, Outcome
from .suite import Child, Suite, SuiteError, chosen_domain_id, claimed_domain, merge
from .view.window import Window

NODES = ("recorder", "evaluator", "predictor")  # the listeners first, so that nothing is missed
SETTLE = 1.0  # s after the last message: the newest predictions are on their way to evaluator and recorder
LOOK_EVERY = 0.2  # s


def node_parameters(folder: Path, vehicle: Path, recorded: RecordedConfiguration) -> dict[str, dict[str, Any]]:
    """Parameters of the three nodes: as recorded where the recording says, else config/nodes.yaml."""
    ours = {"vehicle_file": str(vehicle), "use_sim_time": True}
    before = {node: recorded.nodes.get(node, {}) for node in ("predictor", "evaluator")}
    merged = merge(config("nodes.yaml"), {
        # Bands are asked for anew: the file of the recorded run may be elsewhere by now, or another.
        "predictor": {**before["predictor"], **ours, "bands_file": ""},
        "evaluator": {**before["evaluator"], **ours, "output_directory": str(folder / "errors")},
        "recorder": {"use_sim_time": True, "output_directory": str(folder / "bag"),
                     "configuration_files": [str(vehicle), str(folder / "parameters.yaml")]},
    })
    return {node: merged[node] for node in NODES}


def replay(bag: Path, topics: Mapping[str, str], folder: Path, parameters: Mapping[str, Mapping[str, Any]], rate: float,
           console: Console, view: Window | None = None, options: Sequence[str] = ()) -> Outcome:
    """Play the bag through the nodes; their recordings go to folder/bag and folder/errors.

    topics: type -> topic that is played as the nodes' input (bag.BagDrive). rate: times as fast as it was
    recorded; 0: as fast as the nodes follow. options: further ones of the player. Raises SuiteError.
    """
    chosen = chosen_domain_id()
    held = claimed_domain() if chosen is None else nullcontext(chosen)
    problem, interrupted = "", False
    predictor = parameters["predictor"]
    with held as domain, Suite(folder, parameters, domain) as suite, Monitor(domain) as monitor:
        for name in NODES:
            suite.start_node("st_predictor", name)
        _wait(suite, monitor)
        if view:
            view.open(folder, domain, predictor["vehicle_file"], predictor["map_frame"], bag.name, console)
        player = suite.start("player", [
            sys.executable, "-m", "st_live.nodes.player", str(bag.absolute()), "--rate", str(rate),
            "--odometry", topics[ODOMETRY], "--steering", topics[STEERING], "--horizon", str(predictor["horizon"]),
            "--tick-rate", str(predictor["rate"]), "--models", *predictor["models"], *options])
        try:
            _watch(suite, player, bag.name, rate, console)
        except SuiteError as error:
            problem = str(error)
        except KeyboardInterrupt:
            interrupted = True
        statuses = suite.stop("player")
        time.sleep(SETTLE)
        for name in reversed(NODES):
            statuses.update(suite.stop(name))
    return Outcome(statuses, interrupted, problem)


def _wait(suite: Suite, monitor: Monitor) -> None:
    end = time.monotonic() + START_TIMEOUT
    while missing := monitor.wait_for_nodes(set(NODES), 0.5):
        suite.check()
        if time.monotonic() > end:
            raise SuiteError(f"not up after {START_TIMEOUT:.0f} s: {', '.join(sorted(missing))} "
                             f"(logs in {suite.folder / 'logs'})")


def _watch(suite: Suite, player: Child, name: str, rate: float, console: Console) -> None:
    """Until the player is done; a process that dies before that ends the replay."""
    speed = f"{rate:g} x" if rate > 0 else "as fast as it goes"
    columns = (TextColumn("{task.description}"), BarColumn(),
               TextColumn("{task.completed:.0f} s of {task.total} s"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task(f"{name}, {speed}", total=None)
        while player.process.poll() is None:
            time.sleep(LOOK_EVERY)
            if player.process.poll() is None:
                suite.check()
            word = _last_word(player)
            progress.update(bar, completed=word.get("done", 0.0), total=word.get("duration", 1.0))
    if player.process.returncode:
        raise SuiteError(f"the player ended with status {player.process.returncode}: {player.last_lines()}")
    word = _last_word(player)
    if word.get("wall"):
        speed = word["duration"] / word["wall"]
        console.print(f"{word['duration']:.1f} s played in {word['wall']:.1f} s ({speed:.1f} x)", highlight=False)


def _last_word(player: Child) -> dict[str, Any]:
    lines = [line for line in player.log.read_text(errors="replace").splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else {}
