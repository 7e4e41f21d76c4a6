"""Scheduling of this process: policy, priority, nice value, and nice value of its autogroup.

Between sessions, Linux with autogroups (the default of Debian and Ubuntu) compares the nice values of the session
groups, not of the processes. Each process of `st` is a separate session.
"""

import contextlib
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path

_POLICIES = {os.SCHED_OTHER: "normal", os.SCHED_BATCH: "batch", os.SCHED_IDLE: "idle", os.SCHED_FIFO: "FIFO",
             os.SCHED_RR: "round robin"}
_REALTIME = (os.SCHED_FIFO, os.SCHED_RR)
_GROUP = Path("/proc/self/autogroup")
# The kernel accepts one change of a group per 0.1 s from an ordinary user [1, s].
_TRIES, _PAUSE = 5, 0.11


@dataclass(frozen=True)
class Scheduling:
    """Scheduling parameters of a process.

    policy: name. priority: of a real-time policy, else 0. autogroup: nice value of the session's group, None without
    autogroups; with them it applies between sessions, `nice` within a session.
    """

    policy: str
    priority: int
    nice: int
    autogroup: int | None

    @property
    def text(self) -> str:
        if self.priority:
            return f"real time, {self.policy}, priority {self.priority}"
        group = "" if self.autogroup is None else f", autogroup {self.autogroup}"
        return f"{self.policy}, nice {self.nice}{group}"


def current() -> Scheduling:
    """Scheduling of this process at present."""
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    priority = os.sched_getparam(0).sched_priority if policy in _REALTIME else 0
    return Scheduling(_POLICIES.get(policy, f"policy {policy}"), priority, os.getpriority(os.PRIO_PROCESS, 0),
                      _autogroup())


def lower_priority(nice: int) -> None:
    """Lower the priority: a nice value of at least `nice` for the process, and for its session if it leads one.

    nice: 5 leaves a third of an equal share of CPU time, 10 a tenth, 15 a thirtieth. Never raises; `current` reports
    the result.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
    if os.getsid(0) != os.getpid():
        return  # it would also lower the other processes of the session, such as those of a launch file
    for _ in range(_TRIES):
        try:
            _GROUP.write_text(str(nice))
            return
        except BlockingIOError:
            time.sleep(_PAUSE)
        except OSError:  # no autogroups in this kernel
            return


def _autogroup() -> int | None:
    try:
        if Path("/proc/sys/kernel/sched_autogroup_enabled").read_text().strip() != "1":
            return None
        found = re.search(r"nice (-?\d+)", _GROUP.read_text())
    except OSError:
        return None
    return int(found[1]) if found else None
