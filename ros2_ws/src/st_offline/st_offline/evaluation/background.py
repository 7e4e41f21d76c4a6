"""Runs a function on a second core in a forked child process, without copying its data."""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")


@contextmanager
def run_in_background(work: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """Start `work` in a child process; the yielded function waits for its result, which must be picklable. This process
    does the work itself if it is a Dask worker, which cannot have children, or if the child fails."""
    if multiprocessing.current_process().daemon:
        yield work
        return
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def send_result() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which terminates this process
        with contextlib.suppress(Exception):  # the parent repeats the work and reports its error
            sender.send(work())

    child = context.Process(target=send_result, daemon=True)
    child.start()
    sender.close()

    def wait_for_result() -> T:
        try:
            return receiver.recv()
        except EOFError:
            return work()

    try:
        yield wait_for_result
    finally:
        receiver.close()
        child.terminate()  # if its result was not fetched
        child.join()
