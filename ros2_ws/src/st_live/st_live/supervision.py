"""Keeps the nodes of a live run alive: one that ended or hangs is started again. All of them are one health topic."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from .node import Monitor, Status
from .suite import Suite

# Every node speaks on /diagnostics each second. One that lives and says nothing for this long hangs [s].
HEARTBEAT = 8.0
# What a start may take until the first word [s].
START_TIMEOUT = 30.0
BACK_OFF_FIRST, BACK_OFF_LAST = 0.5, 10.0
# A node that has lived this long starts with a short back-off again [s].
PROVEN = 60.0
# If this process itself was held up for longer, silence says nothing about the others [s].
HELD_UP = 2.0
HEALTH_PERIOD = 1.0
WARN, ERROR = 1, 2


@dataclass
class _Care:
    """One node. waiting_until: start again then; None while it runs."""

    package: str
    name: str
    started: float
    spoke: bool = False
    waiting_until: float | None = None
    back_off: float = BACK_OFF_FIRST
    restarts: int = 0
    why: str = ""


class Supervisor:
    """Call `look` several times a second. All nodes of `nodes` (package, executable) run when it is made."""

    def __init__(self, suite: Suite, monitor: Monitor, nodes: Sequence[tuple[str, str]]):
        self._suite, self._monitor = suite, monitor
        now = time.monotonic()
        self._cares = [_Care(package, name, now, spoke=True) for package, name in nodes]
        self._looked = now
        self._health_at = float("-inf")

    @property
    def restarts(self) -> dict[str, int]:
        """How often each node was started again; only those that were."""
        return {care.name: care.restarts for care in self._cares if care.restarts}

    def look(self) -> None:
        now = time.monotonic()
        held_up, self._looked = now - self._looked > HELD_UP, now
        for care in self._cares:
            if held_up:
                care.started = now
            if care.waiting_until is None:
                self._check(care, now)
            elif now >= care.waiting_until:
                self._suite.start_node(care.package, care.name)
                care.started, care.spoke, care.waiting_until = now, False, None
            if care.why:
                self._monitor.note(self._status(care, now))
        if now - self._health_at >= HEALTH_PERIOD:
            self._health_at = now
            self._monitor.publish_health()

    def _check(self, care: _Care, now: float) -> None:
        ended = self._suite.reap(care.name)
        if ended is not None:
            words = ended.last_lines(1) or "no output"
            self._wait(care, now, f"ended with status {ended.process.returncode} ({words})")
            return
        heard = self._monitor.heard_from(care.name)
        care.spoke = care.spoke or heard > care.started
        silent = now - max(heard, care.started)
        if silent > (HEARTBEAT if care.spoke else START_TIMEOUT):
            self._suite.kill(care.name)
            self._wait(care, now, f"said nothing for {silent:.0f} s and was killed")

    def _wait(self, care: _Care, now: float, why: str) -> None:
        if now - care.started > PROVEN:
            care.back_off = BACK_OFF_FIRST
        care.why, care.waiting_until = why, now + care.back_off
        care.back_off = min(2 * care.back_off, BACK_OFF_LAST)
        care.restarts += 1

    def _status(self, care: _Care, now: float) -> Status:
        times = "once" if care.restarts == 1 else f"{care.restarts} times"
        up = care.waiting_until is None and care.spoke
        text = f"started again {times}; the last time it {care.why}"
        return Status(f"suite: {care.name}", WARN if up else ERROR, text if up else f"not running; {text}", now)
