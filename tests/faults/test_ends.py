"""End of a launched suite: nodes end with the process that launched them, however it ends, and release their ports.

This also holds if SIGINT was ignored when the launch was started.
"""

import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from ros_processes import Processes, executable
from support import ROOT

pytest.importorskip("rclpy")

pytestmark = pytest.mark.ros
CAR_LAUNCH = ROOT / "ros2_ws" / "src" / "st_predictor" / "launch" / "car.launch.py"
# Starts a process as ros2 launch does, and does not inform it at its own end.
SCRIPT = "import subprocess, sys; subprocess.run(sys.argv[1].split() + sys.argv[2:])"
# Ignores SIGINT, as a shell does for background processes of a script.
IGNORING = ("import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); "
            "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])")
# Prints whether SIGINT is handled after the launch file has been evaluated.
PRINT_HANDLER = ("import runpy, signal, sys; runpy.run_path(sys.argv[1])['generate_launch_description'](); "
                 "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)")


def find_free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow
@pytest.mark.parametrize("ignoring", [False, True], ids=["in front", "in the background"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nodes_end_with_their_launch(tmp_path: Path, number: int, ignoring: bool) -> None:
    (prefix,) = re.findall(r'^PARENT_DEATH = "(.*)"', CAR_LAUNCH.read_text(), re.MULTILINE)
    processes, port = Processes(tmp_path), find_free_port()
    try:
        node = [executable("oxts_bridge", "oxts_bridge"), "--ros-args", "-p", f"udp_port:={port}"]
        begin = [sys.executable, *(["-c", IGNORING] if ignoring else [])]
        launch = processes.start([*begin, "-c", SCRIPT, prefix, *node], "launch")
        end = time.monotonic() + 60
        while "reading udp" not in processes.log("launch"):
            assert time.monotonic() < end and launch.poll() is None, processes.log("launch")
            time.sleep(0.1)
        (child,) = psutil.Process(launch.pid).children(recursive=True)
        launch.send_signal(number)
        launch.wait(60)
        _, alive = psutil.wait_procs([child], 60)
        assert not alive
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", port))
    finally:
        processes.close()


def test_a_launch_in_the_background_can_be_interrupted() -> None:
    """Otherwise Ctrl-C would end the nodes, and launch would restart them."""
    pytest.importorskip("launch_ros")
    command = [sys.executable, "-c", IGNORING, "-c", PRINT_HANDLER, str(CAR_LAUNCH)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
