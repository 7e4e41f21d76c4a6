"""Starts the nodes of a run, shows its progress, stops them in order; a supervisor restarts nodes that end or hang."""

import itertools
import math
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text
from st_ros.diagnostics import ERROR, WARN
from st_ros.spin import catch_stop_signals

from .nodes.monitor import Monitor, Status, SuiteState, render_counts, render_health, render_progress
from .page import LiveView
from .suite import REALTIME_PERMISSION, Parameters, Suite, SuiteError, claim_domain, read_domain_id

SILENCE_TIMEOUT = 8.0  # s without /diagnostics (published once a second) after which a running node counts as hung
FIRST_STATUS_TIMEOUT = 30.0  # s from the start of a node to its first /diagnostics
MIN_BACK_OFF, MAX_BACK_OFF = 0.5, 10.0  # s between a failure and the restart
BACK_OFF_RESET_TIME = 60.0  # s without a failure after which the back-off restarts at MIN_BACK_OFF
MAX_OWN_DELAY = 2.0  # s; after a longer delay of this process, messages of the nodes may still be unread
NODES = (  # package, executable; subscribers start first, so that they miss no message
    ("st_predictor", "recorder"),
    ("st_predictor", "evaluator"),
    ("st_predictor", "predictor"),
    ("oxts_bridge", "oxts_bridge"),
    ("canedge_bridge", "canedge_bridge"),
)
# Except in a replay, the predictor ends while data still arrive, so that its last tick has inputs.
STOP_ORDER = ("player", "predictor", "evaluator", "virtual_leaf", "oxts_bridge", "canedge_bridge", "recorder")
END_MARGIN = 0.5  # s; the run is stopped this long before its data end
START_TIMEOUT = 180.0  # s within which all nodes must publish diagnostics
DISCOVERY_TIME = 1.5  # s until already running nodes appear in the graph; they announce themselves every second
UPDATE_PERIOD = 0.25  # s between checks of the nodes and updates of the terminal
LOG_PERIOD = 10.0  # s between lines if the output is not a terminal

Progress = Callable[[], tuple[float, float | None, bool]]
"""Returns the elapsed and the total duration of the run [s], None if unknown, and whether the run is over."""


@dataclass
class _SupervisedNode:
    """State of one node; times are monotonic [s]. restart_at: None while it runs. failure: the most recent."""

    package: str
    name: str
    started_at: float
    has_responded: bool = False
    restart_at: float | None = None
    back_off: float = MIN_BACK_OFF
    restarts: int = 0
    failure: str = ""


class Supervisor:
    """Restarts nodes that end or hang; call `update` several times a second. nodes: (package, executable)."""

    def __init__(self, suite: Suite, monitor: Monitor, nodes: Sequence[tuple[str, str]]):
        self._suite, self._monitor = suite, monitor
        now = time.monotonic()
        self._nodes = [_SupervisedNode(package, name, now, has_responded=True) for package, name in nodes]
        self._updated_at = now

    @property
    def restarts(self) -> dict[str, int]:
        """Number of restarts, including one that is still due, of each node that failed."""
        return {node.name: node.restarts for node in self._nodes if node.restarts}

    def update(self) -> None:
        now = time.monotonic()
        is_delayed, self._updated_at = now - self._updated_at > MAX_OWN_DELAY, now
        for node in self._nodes:
            if is_delayed:
                node.started_at = now
            try:
                if node.restart_at is None:
                    self._check_node(node, now)
                elif now >= node.restart_at:
                    self._suite.start_node(node.package, node.name)
                    node.started_at, node.has_responded, node.restart_at = now, False, None
            except OSError as error:  # its log cannot be read or written, as on a removed disk
                self._schedule_restart(node, now, str(error))
            if node.failure:
                times = "once:" if node.restarts == 1 else f"{node.restarts} times, most recently:"
                is_running = node.restart_at is None and node.has_responded
                text = f"failed {times} {node.failure}"
                level, text = (WARN, text) if is_running else (ERROR, f"not ready; {text}")
                self._monitor.add_statuses([Status(f"suite: {node.name}", level, text, now)])

    def _check_node(self, node: _SupervisedNode, now: float) -> None:
        if (child := self._suite.reap(node.name)) is not None:
            failure = f"ended with status {child.process.returncode} ({child.read_reason(1) or 'no output'})"
            self._schedule_restart(node, now, failure)
            return
        statuses = self._monitor.state.health.values()
        last = max((s.received_at for s in statuses if s.name.startswith(f"{node.name}: ")), default=-math.inf)
        node.has_responded = node.has_responded or last > node.started_at
        silence = now - max(last, node.started_at)
        if silence > (SILENCE_TIMEOUT if node.has_responded else FIRST_STATUS_TIMEOUT):
            self._suite.stop(node.name, timeout=0.0)
            self._schedule_restart(node, now, f"was silent for {silence:.0f} s and was killed")

    def _schedule_restart(self, node: _SupervisedNode, now: float, failure: str) -> None:
        if now - node.started_at > BACK_OFF_RESET_TIME:
            node.back_off = MIN_BACK_OFF
        node.failure, node.restart_at = failure, now + node.back_off
        node.back_off = min(2 * node.back_off, MAX_BACK_OFF)
        node.restarts += 1


@dataclass(frozen=True)
class Outcome:
    """Result of a run."""

    statuses: dict[str, int]  # exit status by process; empty if the user stopped the run before all nodes were up
    interrupted: bool
    problem: str = ""
    health: str = ""  # the result of `render_health` before the stop, as text
    restarts: dict[str, int] = field(default_factory=dict)  # see `Supervisor.restarts`
    state: SuiteState = field(default_factory=SuiteState)  # after the stop, with the last summary of the evaluator

    @property
    def ok(self) -> bool:
        return not (self.problem or self.restarts or any(self.statuses.values()))


def run(folder: Path, parameters: Parameters, title: str, console: Console, view: LiveView,
        source: Callable[[Suite], Progress], nodes: Sequence[tuple[str, str]] = NODES,
        default_domain: int | None = None, supervised: bool = False, realtime: bool = False) -> Outcome:
    """Start the nodes and the source, show progress until the run is over or Ctrl-C, and stop everything in order.

    source: function that starts the source of the data, if it is not the real car, and returns its `Progress`.
    default_domain: ROS domain unless ROS_DOMAIN_ID is set; None: an unused one, isolated from other runs. supervised:
    restart nodes that end or hang, instead of ending the run. realtime: real-time scheduling for bridges and predictor.
    Raises SuiteError if a node or the page does not start, or if a node is already running.
    """
    requested_domain = default_domain if (own_domain := read_domain_id()) is None else own_domain
    with _catch_signals() as stop_requested, claim_domain(requested_domain) as domain, Monitor(domain) as monitor:
        if requested_domain is not None:
            time.sleep(DISCOVERY_TIME)
            _check_instances(monitor, domain, max_instances=0)
        with set_aside_on_failure(folder), Suite(folder, parameters, domain, realtime) as suite:
            with console.status(f"starting {len(nodes)} nodes; the first start compiles the models"):
                if not _start_nodes(suite, monitor, nodes, stop_requested):
                    return Outcome({}, interrupted=True)
            _check_instances(monitor, domain, max_instances=1)
            console.out(f"{len(nodes)} nodes up in ROS domain {domain}; output in {folder}", highlight=False)
            if suite.realtime_denied:
                names = ", ".join(sorted(suite.realtime_denied))
                console.out(f"real-time scheduling is not permitted for {names}; to permit it: {REALTIME_PERMISSION}",
                            style="yellow", highlight=False)
            supervisor = Supervisor(suite, monitor, nodes) if supervised else None
            with view.open(folder, domain, parameters["predictor"], title, console):
                problem = _watch(suite, monitor, supervisor, console, title, source(suite), stop_requested)
            health_text = render_health(monitor.state).plain
            statuses = {}
            with console.status("stopping the nodes"):
                for name in STOP_ORDER:
                    statuses.update(suite.stop(name))
        restarts = supervisor.restarts if supervisor else {}
        return Outcome(statuses, stop_requested(), problem, health_text, restarts, monitor.state)


@contextmanager
def set_aside_on_failure(folder: Path) -> Iterator[None]:
    """Context of a run; after a SuiteError, `set_aside` renames the folder of the run, also in the error message."""
    try:
        yield
    except SuiteError as error:
        raise SuiteError(str(error).replace(f"{folder}/", f"{set_aside(folder)}/")) from None


def set_aside(folder: Path) -> Path:
    """Rename the folder of a run that did not start, so that its name can be used again; returns its path."""
    names = (f"{folder.name}_failed_{number}" for number in itertools.count(1))
    unused = next(path for path in map(folder.with_name, names) if not path.exists())
    try:
        return folder.rename(unused)
    except OSError:  # a mount point, or no permission in the parent folder
        return folder


def _check_instances(monitor: Monitor, domain: int, max_instances: int) -> None:
    """Raises SuiteError for more than `max_instances` instances of a node: measurements of two runs would be mixed."""
    counts = Counter(monitor.find_node_names())
    others = [name for _, name in NODES if counts[name] > max_instances]
    if others:
        raise SuiteError(f"ROS domain {domain} already contains running nodes of the suite ({', '.join(others)}): stop "
                         "them, or set ROS_DOMAIN_ID to a different number")


def make_timer(*durations: float | None) -> Progress:
    """Progress of a run that is over after the shortest of these durations [s]; None: unlimited."""
    started, duration = time.monotonic(), min((d for d in durations if d is not None), default=None)

    def read_progress() -> tuple[float, float | None, bool]:
        elapsed = time.monotonic() - started
        return elapsed, duration, duration is not None and elapsed > duration

    return read_progress


def _start_nodes(suite: Suite, monitor: Monitor, nodes: Sequence[tuple[str, str]],
                 stop_requested: Callable[[], bool]) -> bool:
    """Start nodes and wait until they are ready; False after a stop request. Raises SuiteError if one fails."""
    for package, executable in nodes:
        suite.start_node(package, executable)
    end = time.monotonic() + START_TIMEOUT
    while not stop_requested() and (missing := monitor.wait_for_nodes({executable for _, executable in nodes}, 0.5)):
        suite.check()
        if time.monotonic() > end:
            raise SuiteError(f"no diagnostics after {START_TIMEOUT:.0f} s from {', '.join(sorted(missing))}; see the "
                             f"logs in {suite.folder / 'logs'}")
    return not stop_requested()


def _watch(suite: Suite, monitor: Monitor, supervisor: Supervisor | None, console: Console, title: str,
           progress: Progress, stop_requested: Callable[[], bool]) -> str:
    """Show the progress of the run until it is over or Ctrl-C is pressed. Without a supervisor, the run also ends when
    a process ends; the result is then the problem, else empty."""
    last_line = time.monotonic()
    with Live(console=console, refresh_per_second=4, transient=True, auto_refresh=False) as live:
        while not stop_requested():
            time.sleep(UPDATE_PERIOD)
            elapsed, duration, is_over = progress()
            if is_over:
                break
            if supervisor:
                supervisor.update()
            else:
                try:
                    suite.check()
                except SuiteError as error:
                    return str(error)
            if console.is_terminal:
                live.update(render_progress(monitor.state, elapsed, duration, title), refresh=True)
            elif time.monotonic() - last_line >= LOG_PERIOD:
                state, last_line = monitor.state, time.monotonic()
                console.out(f"{title}: {elapsed:.0f} s; {render_counts(state.predictor_status)}", highlight=False)
                if problems := render_health(state).plain.rstrip():
                    console.print(Text(problems), soft_wrap=True)
    return ""


@contextmanager
def _catch_signals() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether SIGINT or SIGTERM has arrived; neither interrupts the program."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield catch_stop_signals()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
