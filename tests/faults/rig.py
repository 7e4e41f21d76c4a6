"""The supervised suite with a car on wires that can be changed, and what a person at the terminal would see."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from st_live.configuration import bridge_parameters, live_parameters
from st_live.node import Monitor
from st_live.session import NODES, STOP_ORDER, Supervisor
from st_live.suite import Suite, claim_domain, free_udp_port
from st_recordings.paths import config

from .car import Car, Circle, Drive
from .wires import LOOPBACK, Wire, can_wire

LOOK_PERIOD = 0.1
START_TIMEOUT = 60.0
OF_THE_MACHINE = ("predictor: timing",)  # tells that others use the processor too


@dataclass(frozen=True)
class Seen:
    """A check that changed on /diagnostics, or a line of the supervisor, when it was heard here."""

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
    statuses: dict[str, int] = field(default_factory=dict)  # at the end
    _known: dict[str, tuple[int, str]] = field(default_factory=dict)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Look after the nodes for so long, or until something is so; returns whether it became so."""
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() >= end:
                return until()
            self.supervisor.update()
            self._listen()
            time.sleep(LOOK_PERIOD)
        return True

    def pid(self, name: str) -> int:
        """Of the node itself: its child is started through a helper that becomes it."""
        return next(c.process.pid for c in self.suite.children if c.name == name)

    def says(self, name: str, words: str) -> bool:
        """Whether a check is not well and has these words, as last heard."""
        level, message = self._known.get(name, (0, ""))
        return bool(level) and words in message

    def ill(self) -> list[str]:
        now = time.monotonic()
        return [f"{s.name}: {s.message}" for s in self.monitor.state.health.values()
                if (s.level or s.is_silent(now)) and not s.name.startswith("suite: ") and s.name not in OF_THE_MACHINE]

    def is_well(self) -> bool:
        """All that is heard is well, and it is heard from all."""
        return bool(self.monitor.state.health) and not self.ill()

    def _listen(self) -> None:
        now = time.time_ns()
        for status in list(self.monitor.state.health.values()):
            state = (status.level, status.message)
            if self._known.get(status.name) != state:
                self._known[status.name] = state
                self.seen.append(Seen(now, status.name, *state))


@contextmanager
def running(folder: Path, ncom_rate: int = 100, full_bus: bool = False, drive: Drive | None = None) -> Iterator[Rig]:
    """All nodes up and predicting; drive: a circle unless another is given.

    Leave the block and everything has ended, in the order of a real run.
    """
    with ExitStack() as stack:
        port = free_udp_port()
        channel = f"239.74.163.3:{port}"
        car = Car(Wire((LOOPBACK, port)), can_wire(channel), drive or Circle(), ncom_rate, full_bus)
        stack.callback(car.close)
        domain = stack.enter_context(claim_domain())
        monitor = stack.enter_context(Monitor(domain))
        vehicle = folder / "leaf.yaml"
        shutil.copy(config("vehicle/leaf.yaml"), vehicle)
        bridges = bridge_parameters(vehicle, {"udp_port": port, "bind_address": LOOPBACK},
                                    {"interface": "udp_multicast", "channel": channel})
        suite = stack.enter_context(Suite(folder, live_parameters(folder, vehicle, bridges), domain))
        for package, executable in NODES:
            suite.start_node(package, executable)
        missing = monitor.wait_for_nodes({executable for _, executable in NODES}, START_TIMEOUT)
        if missing:
            raise RuntimeError(f"nodes not up: {missing}; logs in {folder / 'logs'}")
        car.start()
        rig = Rig(folder, domain, suite, monitor, Supervisor(suite, monitor, NODES), car)
        if not rig.run(START_TIMEOUT, rig.is_well):
            raise RuntimeError(f"not well after {START_TIMEOUT:g} s: {rig.ill()}")
        yield rig
        for name in STOP_ORDER:
            rig.statuses.update(suite.stop(name))
