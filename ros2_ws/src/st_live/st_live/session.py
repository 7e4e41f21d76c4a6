"""One run of the live suite, with the virtual Leaf or the real car at the other end of the wires."""

import os
import select
import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.text import Text
from st_predictor.params import ALL_TOPICS
from st_recordings.paths import config

from . import live_view
from .importance import HOW_TO_ALLOW
from .node import Monitor
from .suite import Parameters, Suite, SuiteError, chosen_domain_id, claimed_domain, merge
from .supervision import Supervisor
from .view.window import Window

NODES = (  # package, executable: in the order they start; the listeners come first so that nothing is missed
    ("st_predictor", "recorder"),
    ("st_predictor", "evaluator"),
    ("st_predictor", "predictor"),
    ("oxts_bridge", "oxts_bridge"),
    ("canedge_bridge", "canedge_bridge"),
)
# The predictor ends while data still flow, so that its last tick is as good as any; what records the last word of all
# the others ends last.
STOP_ORDER = ("predictor", "evaluator", "virtual_leaf", "oxts_bridge", "canedge_bridge", "recorder")
BEFORE_THE_END = 0.5  # s before a source runs dry the run ends
START_TIMEOUT = 60.0  # s for all nodes to appear in the graph
DISCOVERY_TIME = 1.5  # s until nodes that run already are in the graph; they announce themselves every second
QUIET_REFRESH = 10.0  # s between lines where the output is no terminal


@dataclass(frozen=True)
class Outcome:
    """statuses: of the processes that ran to the end. health: what was not well when the run ended, for a reader."""

    statuses: dict[str, int]
    interrupted: bool
    problem: str = ""
    health: str = ""
    restarts: dict[str, int] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return not (self.problem or self.restarts or any(self.statuses.values()))


def node_parameters(folder: Path, vehicle: Path, bridges: Parameters, model: Parameters | None = None,
                    everything: bool = False) -> Parameters:
    """config/nodes.yaml with what this run decides on top.

    model: of `fourth_model`, for one beside the three. everything: whether all topics are recorded, those too that can
    be made again.
    """
    fourth = model or {}
    files = [values["model_file"] for values in list(fourth.values())[:1]]
    # With them the raw frames can be decoded wherever the recording is taken.
    bus = [bridges["canedge_bridge"][name] for name in ("dbc_file", "signals_file")]
    return merge(
        config("nodes.yaml"),
        {
            **bridges,
            "predictor": {"vehicle_file": str(vehicle), **fourth.get("predictor", {})},
            "evaluator": {"vehicle_file": str(vehicle), "output_directory": str(folder / "errors"),
                          "number_when_taken": True, **fourth.get("evaluator", {})},
            "recorder": {
                "output_directory": str(folder / "bag"),
                "number_when_taken": True,
                "configuration_files": [str(vehicle), str(folder / "parameters.yaml"), *bus, *files],
                **({"topics": ALL_TOPICS} if everything else {}),
            },
        },
    )


def run(
    folder: Path,
    parameters: Parameters,
    title: str,
    duration: float | None,
    source: Callable[[Suite], float] | None = None,
    console: Console | None = None,
    view: Window | None = None,
    supervised: bool = False,
    realtime: bool = False,
) -> Outcome:
    """Start all nodes, then the source (the virtual Leaf), show the run, stop everything in order.

    duration in s; None: until Ctrl-C, or until the source runs dry: it returns how long it lasts [s]. supervised: a
    node that ends or hangs is started again; else it ends the run. realtime: bridges and predictor above all other
    programs, see importance.py; one line says where that is not allowed. Raises SuiteError when a node does not come
    up, or runs already.
    """
    console = console or Console()
    # A demo must not be heard by, or hear, another suite on this machine; the car uses the user's own domain.
    chosen = chosen_domain_id()
    if chosen is None and not source:
        chosen = 0
    held = claimed_domain() if chosen is None else nullcontext(chosen)
    with _StopRequest() as stop, held as domain, Monitor(domain) as monitor:
        if chosen is not None:
            stop.wait(DISCOVERY_TIME)
            _refuse_company(monitor, domain, allowed=0)
        with Suite(folder, parameters, domain, realtime) as suite:
            if not _all_up(suite, monitor, stop):
                return Outcome({}, True)
            _refuse_company(monitor, domain, allowed=1)
            what = f"{len(NODES)} nodes up in ROS domain {domain}; output in {folder}"
            console.print(escape(what), highlight=False, soft_wrap=True)
            if suite.denied:
                names = ", ".join(sorted(suite.denied))
                console.print(f"[yellow]real-time scheduling is not allowed here for {names}: "
                              f"{escape(HOW_TO_ALLOW)}[/yellow]", highlight=False, soft_wrap=True)
            if view:
                predictor = parameters["predictor"]
                view.open(folder, domain, predictor["vehicle_file"], predictor["map_frame"], title, console)
            if source:
                lasts = source(suite) - BEFORE_THE_END
                duration = min(duration or lasts, lasts)
            supervisor = Supervisor(suite, monitor, NODES) if supervised else None
            problem = _watch(suite, monitor, supervisor, console, title, duration, stop)
            health = live_view.health(monitor.heard).plain
            statuses = {}
            for name in STOP_ORDER:
                statuses.update(suite.stop(name))
        return Outcome(statuses, stop.requested, problem, health, supervisor.restarts if supervisor else {})


def _refuse_company(monitor: Monitor, domain: int, allowed: int) -> None:
    """Two suites in one domain would take each other's INS and steering for their own. Raises SuiteError."""
    counts = Counter(monitor.node_names())
    others = [name for _, name in NODES if counts[name] > allowed]
    if others:
        raise SuiteError(f"{', '.join(others)} of another suite run in ROS domain {domain} already: end that one, or "
                         "set ROS_DOMAIN_ID to another number")


def _all_up(suite: Suite, monitor: Monitor, stop: "_StopRequest") -> bool:
    """Start all nodes and wait for them; False as soon as the run is to stop."""
    for package, executable in NODES:
        suite.start_node(package, executable)
    names = {executable for _, executable in NODES}
    end = time.monotonic() + START_TIMEOUT
    while not stop.requested and (missing := monitor.wait_for_nodes(names, 0.5)):
        suite.check()
        if time.monotonic() > end:
            raise SuiteError(
                f"not up after {START_TIMEOUT:.0f} s: {', '.join(sorted(missing))} (logs in {suite.folder / 'logs'})"
            )
    return not stop.requested


def _watch(
    suite: Suite, monitor: Monitor, supervisor: Supervisor | None, console: Console, title: str,
    duration: float | None, stop: "_StopRequest",
) -> str:
    """Until the time is over or somebody pressed Ctrl-C.

    Without a supervisor a process that dies ends the run, and is what is returned.
    """
    started = time.monotonic()
    last_line = started
    with Live(console=console, refresh_per_second=4, transient=True, auto_refresh=False) as live:
        while not stop.wait(0.25):
            elapsed = time.monotonic() - started
            if duration is not None and elapsed > duration:
                break
            if supervisor:
                supervisor.look()
            else:
                try:
                    suite.check()
                except SuiteError as error:
                    return str(error)
            if console.is_terminal:
                live.update(live_view.view(monitor.heard, elapsed, duration, title), refresh=True)
            elif time.monotonic() - last_line >= QUIET_REFRESH:
                last_line = time.monotonic()
                console.print(Text(f"{title}: {elapsed:.0f} s; {live_view.ticks(monitor.heard)}"), soft_wrap=True)
                if said := live_view.health(monitor.heard).plain.rstrip():
                    console.print(Text(said), soft_wrap=True)
    return ""


class _StopRequest:
    """Ctrl-C or SIGTERM as a flag, so that the run ends in its own order."""

    def __init__(self) -> None:
        self.requested = False
        self._read, self._write = os.pipe()

    def wait(self, seconds: float) -> bool:
        select.select([self._read], [], [], seconds)
        return self.requested

    def _request(self, *_: object) -> None:
        self.requested = True
        os.write(self._write, b"x")

    def __enter__(self) -> "_StopRequest":
        self._before = {s: signal.signal(s, self._request) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._read)
        os.close(self._write)
