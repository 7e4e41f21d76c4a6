"""A process that started a node as the launch files do, and is ended by SIGTERM or killed, takes it with it: no port
stays taken."""

import re
import signal
import socket
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
# As ros2 launch starts a process, and as it ends itself: without a word to it.
SCRIPT = "import subprocess, sys; subprocess.run(sys.argv[1].split() + sys.argv[2:])"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nodes_end_with_their_launch(tmp_path: Path, number: int) -> None:
    (prefix,) = re.findall(r'^ENDS_WITH_US = "(.*)"', CAR_LAUNCH.read_text(), re.MULTILINE)
    processes, port = Processes(tmp_path), free_port()
    try:
        node = [executable("oxts_bridge", "oxts_bridge"), "--ros-args", "-p", f"udp_port:={port}"]
        launch = processes.start([sys.executable, "-c", SCRIPT, prefix, *node], "launch")
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
