"""The supervised suite with a simulated car whose data can be altered, and the diagnostics that a user would see."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from st_live.configuration import make_bridge_parameters, make_live_parameters
from st_live.nodes.monitor import Monitor
from st_live.session import NODES, STOP_ORDER, Supervisor
from st_live.suite import Suite, claim_domain, find_free_udp_port
from st_recordings.paths import config

from .car import Car, Circle, Drive
from .wires import LOOPBACK, Wire, can_wire

POLL_PERIOD = 0.1
START_TIMEOUT = 60.0
LOAD_CHECKS = ("predictor: timing",)  # report that other programs use the processor


@dataclass(frozen=True)
class Seen:
    """A change of a check on /diagnostics, or a line of the supervisor, with the time of reception."""

    time_ns: int
    name: str
    level: int
    message: str


@dataclass
class Rig:
    folder: Path
    domain: int
    suite: Suite
    monitor: Monitor
    supervisor: Supervisor
    car: Car
    seen: list[Seen] = field(default_factory=list)
    names: tuple[str, ...] = tuple(executable for _, executable in NODES)
    statuses: dict[str, int] = field(default_factory=dict)  # exit statuses
    _known: dict[str, tuple[int, str]] = field(default_factory=dict)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Supervises the nodes for a time, or until a condition holds; returns whether it holds."""
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() >= end:
                return until()
            self.supervisor.update()
            self._listen()
            time.sleep(POLL_PERIOD)
        return True

    def pid(self, name: str) -> int:
        """PID of a node. The program that starts it replaces itself by the node."""
        return next(c.process.pid for c in self.suite.children if c.name == name)

    def reports(self, name: str, words: str) -> bool:
        """Whether the last message of a check is a warning or error with these words."""
        level, message = self._known.get(name, (0, ""))
        return bool(level) and words in message

    def problems(self) -> list[str]:
        """Checks that report a problem or are silent."""
        now = time.monotonic()
        return [f"{s.name}: {s.message}" for s in self.monitor.state.health.values()
                if (s.level or s.is_silent(now)) and not s.name.startswith("suite: ") and s.name not in LOAD_CHECKS]

    def is_healthy(self) -> bool:
        """Whether all checks are received and OK."""
        return bool(self.monitor.state.health) and not self.problems()

    def _listen(self) -> None:
        now = time.time_ns()
        for status in list(self.monitor.state.health.values()):
            state = (status.level, status.message)
            if self._known.get(status.name) != state:
                self._known[status.name] = state
                self.seen.append(Seen(now, status.name, *state))


@contextmanager
def running(folder: Path, ncom_rate: int = 100, full_bus: bool = False, drive: Drive | None = None) -> Iterator[Rig]:
    """All nodes run and predict within the block; at its end they are stopped in the order of a real run.

    drive: by default a circle.
    """
    with ExitStack() as stack:
        port = find_free_udp_port()
        channel = f"239.74.163.3:{port}"
        car = Car(Wire((LOOPBACK, port)), can_wire(channel), drive or Circle(), ncom_rate, full_bus)
        stack.callback(car.close)
        domain = stack.enter_context(claim_domain())
        monitor = stack.enter_context(Monitor(domain))
        vehicle = folder / "leaf.yaml"
        shutil.copy(config("vehicle/leaf.yaml"), vehicle)
        bridges = make_bridge_parameters(vehicle, {"udp_port": port, "bind_address": LOOPBACK},
                                         {"interface": "udp_multicast", "channel": channel})
        suite = stack.enter_context(Suite(folder, make_live_parameters(folder, vehicle, bridges), domain))
        for package, executable in NODES:
            suite.start_node(package, executable)
        missing = monitor.wait_for_nodes({executable for _, executable in NODES}, START_TIMEOUT)
        if missing:
            raise RuntimeError(f"nodes have not started: {missing}; logs in {folder / 'logs'}")
        car.start()
        rig = Rig(folder, domain, suite, monitor, Supervisor(suite, monitor, NODES), car)
        if not rig.run(START_TIMEOUT, rig.is_healthy):
            raise RuntimeError(f"problems after {START_TIMEOUT:g} s: {rig.problems()}")
        yield rig
        for name in STOP_ORDER:
            rig.statuses.update(suite.stop(name))
