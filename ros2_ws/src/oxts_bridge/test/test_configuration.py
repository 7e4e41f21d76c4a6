"""Start and end of the node process; invalid parameters."""

import math
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs.msg", reason="needs the built workspace")

from ins_rig import free_port
from node_rig import launch
from oxts_bridge.node import PARAMETERS, OxtsBridge, check_settings
from ros_processes import free_domain, refusing_node
from st_ros.parameters import ConfigurationError

pytestmark = pytest.mark.ros
refuse = pytest.fixture(refusing_node)


def test_sigterm_ends_the_node_with_status_0(tmp_path):
    process = launch("oxts_bridge", {"udp_port": free_port()}, tmp_path, free_domain())
    assert "reading udp" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)
    assert process.returncode == 0


@pytest.mark.parametrize(("parameters", "text"), [
    ({"udp_prot": 3000}, "unknown parameter udp_prot"),
    ({"udp_port": 70000}, "udp_port: 70000 is outside 1 to 65535"),
    ({"origin_source": "given"}, "origin_latitude: is required when"),
    ({"replay_file": __file__}, "no NCOM packet in"),
])
def test_invalid_configuration_is_rejected_in_one_line(refuse, parameters, text):
    line = refuse(OxtsBridge, *(f"{name}:={value}" for name, value in parameters.items()))
    assert text in line and "oxts_bridge" in line


@pytest.mark.slow
def test_process_with_an_invalid_parameter_ends_with_status_2(tmp_path):
    process = launch("oxts_bridge", {"udp_port": 70000}, tmp_path, free_domain())
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 2 and "udp_port: 70000" in errors



@pytest.mark.parametrize(("key", "value", "text"), [
    ("bind_address", "localhost", "bind_address: 'localhost' is not an IP address"),
    ("bind_address", "", "bind_address: '' is not an IP address"),
    ("sender_filter", "300.1.1.1", "sender_filter: '300.1.1.1' is not an IP address"),
    ("base_to_ins", [1.0, 2.0], "base_to_ins: [1.0, 2.0] is not three lengths"),
    ("base_to_ins", [1.0, 2.0, math.nan], "is not three lengths"),
    ("topics", ["odometry", "odo"], "topics: 'odo' is not one of"),
    ("odom_frame", "map", "must differ"),
    ("replay_file", "missing.ncom", "replay_file: missing.ncom is not a file"),
])
def test_inconsistent_parameters_are_rejected_by_name(key, value, text):
    settings = SimpleNamespace(**{parameter.name: parameter.default for parameter in PARAMETERS})
    check_settings(settings, "oxts_bridge")
    setattr(settings, key, value)
    with pytest.raises(ConfigurationError) as error:
        check_settings(settings, "oxts_bridge")
    assert text in str(error.value) and str(error.value).startswith("oxts_bridge.")


def test_parameter_file_lists_every_parameter_with_its_default():
    written = yaml.safe_load((Path(__file__).resolve().parents[4] / "config" / "nodes.yaml").read_text())
    assert {name: repr(value) for name, value in written["oxts_bridge"]["ros__parameters"].items()} == {
        parameter.name: repr(parameter.default) for parameter in PARAMETERS}
