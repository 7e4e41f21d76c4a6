"""Real-time scheduling of the most important nodes, read from the kernel for running processes."""

import os
import sys

from st_live.suite import REALTIME_PRIORITIES, Processes

SLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]


def test_default_scheduling_is_normal(tmp_path):
    with Processes(tmp_path) as processes:
        pid = processes.start("predictor", SLEEP).process.pid
        assert os.sched_getscheduler(pid) == os.SCHED_OTHER
        assert not processes.realtime_denied


def test_real_time_priority_is_set_or_its_refusal_reported(tmp_path):
    with Processes(tmp_path, realtime=True) as processes:
        pids = {name: processes.start(name, SLEEP).process.pid for name in (*REALTIME_PRIORITIES, "recorder")}
        for name, pid in pids.items():
            if name in REALTIME_PRIORITIES and name not in processes.realtime_denied:
                assert os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR
                assert os.sched_getparam(pid).sched_priority == REALTIME_PRIORITIES[name]
            else:
                assert os.sched_getscheduler(pid) == os.SCHED_OTHER
        assert processes.realtime_denied <= REALTIME_PRIORITIES.keys()
