"""Scheduling policy and priority of a process, as it reads them itself."""

import os
import subprocess
import sys
from typing import Any

from st_ros import scheduling


def run_python(statements: str, *prefix: str, **options: Any) -> str:
    """Output of statements in a new process with `st_ros.scheduling` imported, started by the command `prefix`."""
    command = [*prefix, sys.executable, "-c", f"import os; from st_ros import scheduling; {statements}"]
    return subprocess.run(command, capture_output=True, text=True, check=True, **options).stdout


def test_nice_value_is_reported():
    text = run_python("print(scheduling.describe_scheduling(scheduling.read_scheduling()))", "nice", "-n", "3")
    assert text.startswith(f"normal, nice {min(os.getpriority(os.PRIO_PROCESS, 0) + 3, 19)}")


def test_idle_policy_is_reported():
    """The only other policy that needs no privilege."""
    text = run_python("os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)); "
                      "print(scheduling.describe_scheduling(scheduling.read_scheduling()))")
    assert text.startswith("idle, nice ")


def test_real_time_priority_is_reported():
    values = {"policy": "round robin", "priority": 21, "nice": 0, "autogroup": 0}
    assert scheduling.describe_scheduling(values) == "real time, round robin, priority 21"
    assert scheduling.describe_scheduling({"policy": "normal", "priority": 0, "nice": 5}) == "normal, nice 5"


def test_lower_priority_changes_the_autogroup_of_its_own_session_only():
    nice = max(7, os.getpriority(os.PRIO_PROCESS, 0))
    # The first session of the system has no autogroup; a new session shows whether the kernel has autogroups.
    autogroup = run_python("print(scheduling.read_scheduling().get('autogroup'))", start_new_session=True)
    expected = None if autogroup == "None\n" else 7
    for own_session, group in ((True, expected), (False, scheduling.read_scheduling().get("autogroup"))):
        output = run_python("scheduling.lower_priority(7); print(scheduling.read_scheduling())",
                            start_new_session=own_session)
        values = {"policy": "normal", "priority": 0, "nice": nice}
        assert output == f"{values if group is None else values | {'autogroup': group}}\n"
