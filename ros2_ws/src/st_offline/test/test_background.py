"""Work in a forked child: its result, its end, and what happens without it."""

import multiprocessing
import os
import signal

import pytest
from st_offline.evaluation.background import in_background

HERE = os.getpid()


def test_it_is_done_in_another_process_that_sees_what_is_here():
    content = [1, 2, 3]
    with in_background(lambda: (os.getpid(), sum(content))) as result:
        pid, total = result()
    assert (pid != HERE, total) == (True, 6)
    assert not multiprocessing.active_children()


def test_a_child_that_is_killed_leaves_the_work_to_its_parent():
    def work():
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    with in_background(work) as result:
        assert result() == HERE


def test_what_it_raises_is_raised_here(capfd):
    def work():
        raise ValueError("no room")

    with pytest.raises(ValueError, match="no room"), in_background(work) as result:
        result()


def test_a_process_that_may_have_no_child_works_itself():
    def worker(queue):
        with in_background(os.getpid) as result:
            queue.put((os.getpid(), result()))

    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=worker, args=(queue,), daemon=True)
    child.start()
    own, found = queue.get(timeout=60)
    child.join()
    assert own == found
