"""Reads the scheduling of this process (policy, priority, nice values), and lowers its priority.

With autogroups (the default of Debian and Ubuntu), Linux compares the nice values of processes only within a session;
between sessions, the nice values of the autogroups apply. Each process that `st` starts has its own session.
"""

import contextlib
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

BACKGROUND_NICE = 5
"""Nice value of recorder, evaluator and browser views. They get a third of the CPU time of a process at nice 0."""
_POLICIES = {os.SCHED_OTHER: "normal", os.SCHED_BATCH: "batch", os.SCHED_IDLE: "idle", os.SCHED_FIFO: "FIFO",
             os.SCHED_RR: "round robin"}
_REALTIME = (os.SCHED_FIFO, os.SCHED_RR)
_AUTOGROUP_FILE = Path("/proc/self/autogroup")
_MAX_ATTEMPTS, _PAUSE = 5, 0.11  # count, s; the kernel accepts one change every 0.1 s, for all autogroups together


def read_scheduling() -> dict[str, Any]:
    """Policy, priority (0 unless real time) and nice value of this process, and nice value of its autogroup, if any."""
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    values = {"policy": _POLICIES.get(policy, f"policy {policy}"),
              "priority": os.sched_getparam(0).sched_priority if policy in _REALTIME else 0,
              "nice": os.getpriority(os.PRIO_PROCESS, 0), "autogroup": _read_autogroup()}
    return {key: value for key, value in values.items() if value is not None}


def describe_scheduling(values: Mapping[str, Any]) -> str:
    """The values of `read_scheduling` as text."""
    if values["priority"]:
        return f"real time, {values['policy']}, priority {values['priority']}"
    group = f", autogroup {values['autogroup']}" if "autogroup" in values else ""
    return f"{values['policy']}, nice {values['nice']}{group}"


def lower_priority(nice: int) -> None:
    """Raise the nice value of this process to at least `nice`, and set its autogroup to `nice` if it leads the session.
    nice: 5 gives a third of the CPU time of a process at 0, 10 a tenth. `read_scheduling` shows the result."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
    if os.getsid(0) != os.getpid():
        return  # the autogroup contains other processes, for example of a launch file
    for _ in range(_MAX_ATTEMPTS):
        try:
            _AUTOGROUP_FILE.write_text(str(nice))
            return
        except BlockingIOError:
            time.sleep(_PAUSE)
        except OSError:  # no autogroups in this kernel
            return


def _read_autogroup() -> int | None:
    with contextlib.suppress(OSError):
        is_enabled = Path("/proc/sys/kernel/sched_autogroup_enabled").read_text().strip() == "1"
        if is_enabled and (match := re.search(r"nice (-?\d+)", _AUTOGROUP_FILE.read_text())):
            return int(match[1])
    return None
