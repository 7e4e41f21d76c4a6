"""Runs the live suite for a measurement: all nodes and the virtual Leaf, in a separate ROS domain, also with a view."""

import os
import signal
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from rich.console import Console
from st_live.configuration import VirtualCar, make_live_parameters, set_bands_and_course
from st_live.nodes.monitor import Monitor
from st_live.page import LiveView
from st_live.session import NODES
from st_live.suite import Suite, claim_domain

from ._drives import LEAF_FILE, leaf
from .bands.methods import random_bands

VIEW_START_TIME = 3.0  # s from the start of the page until it receives every topic


@contextmanager
def run_suite(duration: float, ncom_rate: int = 250, can_rate: str = "full") -> Iterator[Suite]:
    """Context with the running suite; all processes end and all files are deleted on exit.

    ST_BENCH_REALTIME=1: real-time scheduling of bridges and predictor. ST_BENCH_WITHOUT: names of nodes that are not
    started, such as recorder,evaluator. ST_BENCH_BUSY: number of background processes in an endless loop.
    ST_BENCH_BANDS=1: bands for every prediction.
    """
    omitted = os.environ.get("ST_BENCH_WITHOUT", "").split(",")
    nodes = [node for node in NODES if node[1] not in omitted]
    with claim_domain() as domain, tempfile.TemporaryDirectory(prefix="st-bench-") as name:
        rates = ["--ncom-rate", str(ncom_rate), "--can-rate", can_rate]
        car = VirtualCar(LEAF_FILE, ["--scenario", "S6", "--duration", str(duration), *rates])
        folder = Path(name)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        parameters = make_live_parameters(folder, car.vehicle, car.make_bridge_parameters())
        if os.environ.get("ST_BENCH_BANDS") == "1":
            file = folder / "bands.yaml"
            file.write_text(random_bands(leaf()).to_yaml(), encoding="utf-8")
            parameters = set_bands_and_course(parameters, file, None)
        with Suite(folder, parameters, domain, "ST_BENCH_REALTIME" in os.environ) as suite:
            for package, executable in nodes:
                suite.start_node(package, executable)
            with Monitor(domain) as monitor:
                missing = monitor.wait_for_nodes({executable for _, executable in nodes}, 30)
            if missing or suite.realtime_denied:
                raise RuntimeError(f"nodes that did not start: {missing}; real-time scheduling denied: "
                                   f"{suite.realtime_denied}")
            for number in range(int(os.environ.get("ST_BENCH_BUSY", "0"))):
                suite.start(f"busy_{number}", [sys.executable, "-c", "while True: pass"])
            car.start(suite)
            yield suite


@contextmanager
def attach_view(suite: Suite, hangs: bool) -> Iterator[None]:
    """Context with an open page. hangs: its process is stopped (SIGSTOP) after VIEW_START_TIME."""
    page = LiveView(page=True)
    folder = Path(suite.folder, f"view-{time.monotonic_ns()}")
    predictor = {"vehicle_file": str(LEAF_FILE), "map_frame": "map"}
    with page.open(folder, int(os.environ["ROS_DOMAIN_ID"]), predictor, "bench", Console(quiet=True)) as url:
        (process,) = (p for p in psutil.Process().children(recursive=True) if "st_live.nodes.passenger" in p.cmdline())
        threading.Thread(target=_read, args=(url,), daemon=True).start()
        try:
            time.sleep(VIEW_START_TIME)
            if hangs:
                process.send_signal(signal.SIGSTOP)
            yield
        finally:
            process.send_signal(signal.SIGCONT)


def _read(url: str) -> None:
    with urllib.request.urlopen(f"{url}frames") as stream:
        while stream.readline():
            pass
