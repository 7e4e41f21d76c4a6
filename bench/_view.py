"""A view attached to the running suite, as `--view` does it, without a browser; it runs, or it hangs."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from rich.console import Console
from st_live.suite import Suite
from st_live.view.window import Window
from st_recordings.paths import config

SETTLE = 3.0  # s from its start until it hears everything


@contextmanager
def view(suite: Suite, hangs: bool) -> Iterator[None]:
    """hangs: server and all are stopped (SIGSTOP) with their subscriptions made."""
    window = Window(page=True)
    folder = Path(suite.folder, f"view-{time.monotonic_ns()}")
    window.open(folder, int(os.environ["ROS_DOMAIN_ID"]), str(config("vehicle/leaf.yaml")), "map", "bench",
                Console(quiet=True))
    try:
        time.sleep(SETTLE)
        if hangs:
            for process in _family(window.pids):
                process.send_signal(signal.SIGSTOP)
        yield
    finally:
        for process in _family(window.pids):
            process.send_signal(signal.SIGCONT)
        window.close()


def _family(pids: list[int]) -> list[psutil.Process]:
    found = [psutil.Process(pid) for pid in pids]
    return found + [child for process in found for child in process.children(recursive=True)]
