"""Nodes listen on loopback only and use no shared memory, segments of which a killed process would leave behind."""

import signal

import psutil
import pytest
from ros_processes import Processes, wait_for
from st_live import suite
from support import LEAF, ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

PROFILE = str(ROOT / "config" / "dds" / "loopback.xml")


@pytest.fixture
def processes(tmp_path):
    running = Processes(tmp_path)
    yield running
    running.close()


def shared_memory_segments(pid: int) -> list[str]:
    return [m.path for m in psutil.Process(pid).memory_maps(grouped=False) if "/dev/shm/fastrtps" in m.path]


def test_loopback_environment_respects_the_settings_of_the_user():
    fast = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT", "FASTRTPS_DEFAULT_PROFILES_FILE": PROFILE}
    local = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert suite.make_loopback_environment({}) == fast
    assert suite.make_loopback_environment(fast) == fast  # already set in the shell
    assert suite.make_loopback_environment({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}) == fast
    assert suite.make_loopback_environment({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}) == local
    assert suite.make_loopback_environment({"FASTRTPS_DEFAULT_PROFILES_FILE": "/other/profile.xml"}) == local


@pytest.mark.slow
@pytest.mark.ros
def test_nodes_use_udp_on_the_loopback_interface_only(processes):
    node = processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
    wait_for(lambda: len(psutil.Process(node.pid).net_connections("udp")) > 3, what="discovery and data ports")
    addresses = {connection.laddr.ip for connection in psutil.Process(node.pid).net_connections("udp")}
    assert "127.0.0.1" in addresses
    assert addresses <= {"127.0.0.1", "239.255.0.1"}, "the second is the multicast group of the discovery"
    assert shared_memory_segments(node.pid) == []
    assert processes.stop(node, signal.SIGINT) == 0


@pytest.mark.ros
def test_discovery_range_alone_does_not_prevent_shared_memory(processes):
    """The reason for the profile: if this fails, the ROS layer has changed and the profile can be removed."""
    processes.environment |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    node = processes.node("st_predictor", "predictor", f"vehicle_file:={LEAF}")
    wait_for(lambda: shared_memory_segments(node.pid), what="a segment")
