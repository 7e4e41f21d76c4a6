"""What the nodes listen on, and that they use no shared memory, of which a killed process leaves parts in use."""

import signal

import psutil
import pytest
from ros_processes import Processes, wait_for
from st_live import suite
from support import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

PROFILE = str(ROOT / "config" / "dds" / "loopback.xml")


@pytest.fixture
def processes(tmp_path):
    running = Processes(tmp_path)
    yield running
    running.close()


def segments(pid: int) -> list[str]:
    return [m.path for m in psutil.Process(pid).memory_maps(grouped=False) if "/dev/shm/fastrtps" in m.path]


def test_which_variables():
    fast = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "FASTRTPS_DEFAULT_PROFILES_FILE": PROFILE}
    local = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert suite.make_loopback_environment({}) == fast
    assert suite.make_loopback_environment(fast) == fast  # in a shell that has them already
    assert suite.make_loopback_environment({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}) == fast
    assert suite.make_loopback_environment({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}) == local
    assert suite.make_loopback_environment({"FASTRTPS_DEFAULT_PROFILES_FILE": "/somebody/elses.xml"}) == local


@pytest.mark.ros
def test_nodes_use_udp_on_the_loopback_interface_only(processes):
    node = processes.node("st_predictor", "predictor", f"vehicle_file:={ROOT / 'config/vehicle/leaf.yaml'}")
    wait_for(lambda: len(psutil.Process(node.pid).net_connections("udp")) > 3, what="discovery and data ports")
    addresses = {connection.laddr.ip for connection in psutil.Process(node.pid).net_connections("udp")}
    assert "127.0.0.1" in addresses
    assert addresses <= {"127.0.0.1", "239.255.0.1"}, "the second is the group of the discovery, joined on loopback"
    assert segments(node.pid) == []
    assert processes.stop(node, signal.SIGINT) == 0


@pytest.mark.ros
def test_the_range_alone_would_use_shared_memory(processes):
    """Why the profile is there. Should this fail, the ROS layer has changed and the profile may go."""
    processes.environment |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    node = processes.node("st_predictor", "predictor", f"vehicle_file:={ROOT / 'config/vehicle/leaf.yaml'}")
    wait_for(lambda: segments(node.pid), what="a segment")
