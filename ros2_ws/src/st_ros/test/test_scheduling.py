"""How a process is scheduled, as it says itself."""

import os
import subprocess
import sys

from st_ros import scheduling

SAY = [sys.executable, "-c", "from st_ros import scheduling; print(scheduling.read_scheduling().text)"]


def test_a_nice_process_says_so():
    said = subprocess.run(["nice", "-n", "3", *SAY], capture_output=True, text=True, check=True).stdout
    assert said.startswith(f"normal, nice {min(os.getpriority(os.PRIO_PROCESS, 0) + 3, 19)}")


def test_an_idle_process_says_so():
    """The one other policy everybody may take."""
    say = "import os; os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)); " + SAY[-1]
    said = subprocess.run([sys.executable, "-c", say], capture_output=True, text=True, check=True).stdout
    assert said.startswith("idle, nice ")


def test_real_time_has_a_priority():
    assert scheduling.Scheduling("round robin", 21, 0, 0).text == "real time, round robin, priority 21"
    assert scheduling.Scheduling("normal", 0, 5, None).text == "normal, nice 5"


LOWER = [sys.executable, "-c",
         "from st_ros import scheduling; scheduling.lower_priority(7); print(scheduling.read_scheduling())"]


def test_lowering_reaches_the_group_of_an_own_session_only():
    nice = max(7, os.getpriority(os.PRIO_PROCESS, 0))
    # The system's first session has no group: whether there are groups, a session of its own says.
    say = [sys.executable, "-c", "from st_ros import scheduling; print(scheduling.read_scheduling().autogroup_nice)"]
    groups = subprocess.run(say, capture_output=True, text=True, check=True, start_new_session=True).stdout != "None\n"
    for own_session, group in ((True, 7 if groups else None), (False, scheduling.read_scheduling().autogroup_nice)):
        said = subprocess.run(LOWER, capture_output=True, text=True, check=True, start_new_session=own_session).stdout
        assert said == f"{scheduling.Scheduling('normal', 0, nice, group)}\n"
