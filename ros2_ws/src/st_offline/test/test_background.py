"""Work in a forked child process: its result, its exceptions, and work without a child."""

import multiprocessing
import os
import signal

import pytest
from st_offline.evaluation.background import run_in_background

PARENT = os.getpid()


def test_work_runs_in_a_child_process_with_the_data_of_its_parent():
    content = [1, 2, 3]
    with run_in_background(lambda: (os.getpid(), sum(content))) as result:
        pid, total = result()
    assert (pid != PARENT, total) == (True, 6)
    assert not multiprocessing.active_children()


def test_work_of_a_killed_child_is_repeated_in_its_parent():
    def work():
        if os.getpid() != PARENT:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    with run_in_background(work) as result:
        assert result() == PARENT


def test_exception_of_the_work_is_raised_in_the_parent(capfd):
    def work():
        raise ValueError("no room")

    with pytest.raises(ValueError, match="no room"), run_in_background(work) as result:
        result()


def test_daemon_process_does_the_work_itself():
    def worker(queue):
        with run_in_background(os.getpid) as result:
            queue.put((os.getpid(), result()))

    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=worker, args=(queue,), daemon=True)
    child.start()
    worker_pid, work_pid = queue.get(timeout=60)
    child.join()
    assert worker_pid == work_pid
