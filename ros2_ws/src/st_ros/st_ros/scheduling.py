"""Reads and lowers the priority of this process: policy, priority, nice value, and nice value of its autogroup.

With autogroups (the default of Debian and Ubuntu), Linux compares the nice values of processes only within a session;
between sessions those of the autogroups apply. Each process of `st` is a session.
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
_TRIES, _PAUSE = 5, 0.11  # number, and s between them; the kernel accepts one change per 0.1 s from an ordinary user


@dataclass(frozen=True)
class Scheduling:
    """Scheduling parameters of a process.

    policy: name. priority: of a real-time policy, else 0. autogroup: nice value of the autogroup, None without one.
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


def read_scheduling() -> Scheduling:
    """Present scheduling of this process."""
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    priority = os.sched_getparam(0).sched_priority if policy in _REALTIME else 0
    return Scheduling(_POLICIES.get(policy, f"policy {policy}"), priority, os.getpriority(os.PRIO_PROCESS, 0),
                      _read_autogroup())


def lower_priority(nice: int) -> None:
    """Set a nice value of at least `nice` for this process, and for its autogroup if it leads the session.

    nice: 5 leaves a third of an equal share of CPU time, 10 a tenth, 15 a thirtieth. Failures are ignored;
    `read_scheduling` shows the result.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
    if os.getsid(0) != os.getpid():
        return  # the autogroup contains other processes, such as those of a launch file
    for _ in range(_TRIES):
        try:
            _GROUP.write_text(str(nice))
            return
        except BlockingIOError:
            time.sleep(_PAUSE)
        except OSError:  # no autogroups in this kernel
            return


def _read_autogroup() -> int | None:
    try:
        if Path("/proc/sys/kernel/sched_autogroup_enabled").read_text().strip() != "1":
            return None
        match = re.search(r"nice (-?\d+)", _GROUP.read_text())
    except OSError:
        return None
    return int(match[1]) if match else None
