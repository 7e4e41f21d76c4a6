"""Restarts the nodes of a live run that end or hang."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from .node import Monitor, Status
from .suite import Suite

# Every node publishes /diagnostics once a second; a running node that is silent for this long hangs [s].
SILENCE_TIMEOUT = 8.0
# Longest time from a start to the first /diagnostics [s].
START_TIMEOUT = 30.0
BACK_OFF_FIRST, BACK_OFF_LAST = 0.5, 10.0
# After this time without failure the back-off is short again [s].
RESET_BACK_OFF = 60.0
# If this process itself was delayed for longer, the silence of others is not judged [s].
OWN_DELAY = 2.0
WARN, ERROR = 1, 2


@dataclass
class _Supervised:
    """One node. restart_at: monotonic [s]; None while it runs. cause: of the last restart."""

    package: str
    name: str
    started: float
    responded: bool = False
    restart_at: float | None = None
    back_off: float = BACK_OFF_FIRST
    restarts: int = 0
    cause: str = ""


class Supervisor:
    """Call `update` several times a second. nodes: (package, executable), all running already."""

    def __init__(self, suite: Suite, monitor: Monitor, nodes: Sequence[tuple[str, str]]):
        self._suite, self._monitor = suite, monitor
        now = time.monotonic()
        self._nodes = [_Supervised(package, name, now, responded=True) for package, name in nodes]
        self._updated = now

    @property
    def restarts(self) -> dict[str, int]:
        """Number of restarts by node, of those restarted."""
        return {node.name: node.restarts for node in self._nodes if node.restarts}

    def update(self) -> None:
        now = time.monotonic()
        delayed, self._updated = now - self._updated > OWN_DELAY, now
        for node in self._nodes:
            if delayed:
                node.started = now
            if node.restart_at is None:
                self._check(node, now)
            elif now >= node.restart_at:
                self._suite.start_node(node.package, node.name)
                node.started, node.responded, node.restart_at = now, False, None
            if node.cause:
                self._monitor.add_status(self._status(node, now))

    def _check(self, node: _Supervised, now: float) -> None:
        ended = self._suite.reap(node.name)
        if ended is not None:
            output = ended.last_lines(1) or "no output"
            self._schedule_restart(node, now, f"ended with status {ended.process.returncode} ({output})")
            return
        last = self._monitor.last_status(node.name)
        node.responded = node.responded or last > node.started
        silent = now - max(last, node.started)
        if silent > (SILENCE_TIMEOUT if node.responded else START_TIMEOUT):
            self._suite.kill(node.name)
            self._schedule_restart(node, now, f"was silent for {silent:.0f} s and was killed")

    def _schedule_restart(self, node: _Supervised, now: float, cause: str) -> None:
        if now - node.started > RESET_BACK_OFF:
            node.back_off = BACK_OFF_FIRST
        node.cause, node.restart_at = cause, now + node.back_off
        node.back_off = min(2 * node.back_off, BACK_OFF_LAST)
        node.restarts += 1

    def _status(self, node: _Supervised, now: float) -> Status:
        times = "once" if node.restarts == 1 else f"{node.restarts} times"
        running = node.restart_at is None and node.responded
        text = f"restarted {times}; the last time it {node.cause}"
        level, text = (WARN, text) if running else (ERROR, f"not running; {text}")
        return Status(f"suite: {node.name}", level, text, now)
