"""Work for a second core while this process continues: in a forked child, which shares all memory without copies."""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import TypeVar

T = TypeVar("T")


@contextmanager
def in_background(work: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """Start the work; what is yielded waits for its result, which has to be picklable.

    A worker of Dask may have no child, and a child may be killed for its memory: then the work is done here.
    """
    if multiprocessing.current_process().daemon:
        yield work
        return
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_do, args=(work, sender), daemon=True)
    child.start()
    sender.close()

    def result() -> T:
        try:
            return receiver.recv()
        except EOFError:
            return work()

    try:
        yield result
    finally:
        receiver.close()
        child.terminate()  # if its result is not needed any more
        child.join()


def _do(work: Callable[[], T], sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends this
    with contextlib.suppress(Exception):  # what fails here fails in the parent again, which reports it
        sender.send(work())
