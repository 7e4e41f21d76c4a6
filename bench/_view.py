"""Opens the passenger's page of a running suite, with one client that reads it."""

import os
import signal
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from rich.console import Console
from st_live.page import LiveView
from st_live.suite import Suite

from ._drives import LEAF_FILE

START_TIME = 3.0  # s from the start of the page until it receives every topic


@contextmanager
def attach_view(suite: Suite, hangs: bool) -> Iterator[None]:
    """Context with an open page. hangs: its process is stopped (SIGSTOP) after START_TIME."""
    page = LiveView(page=True)
    folder = Path(suite.folder, f"view-{time.monotonic_ns()}")
    predictor = {"vehicle_file": str(LEAF_FILE), "map_frame": "map"}
    with page.open(folder, int(os.environ["ROS_DOMAIN_ID"]), predictor, "bench", Console(quiet=True)) as url:
        (process,) = (p for p in psutil.Process().children(recursive=True) if "st_live.nodes.passenger" in p.cmdline())
        threading.Thread(target=_read, args=(url,), daemon=True).start()
        try:
            time.sleep(START_TIME)
            if hangs:
                process.send_signal(signal.SIGSTOP)
            yield
        finally:
            process.send_signal(signal.SIGCONT)


def _read(url: str) -> None:
    with urllib.request.urlopen(f"{url}frames") as stream:
        while stream.readline():
            pass
