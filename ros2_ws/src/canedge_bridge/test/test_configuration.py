"""Invalid parameters of the node."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs.msg", reason="needs the built workspace")

from canedge_bridge.node import CanedgeBridge
from node_rig import launch
from ros_processes import free_domain, refusing_node

pytestmark = pytest.mark.ros
refuse = pytest.fixture(refusing_node)


@pytest.mark.parametrize(("parameters", "message"), [
    ({"steering_rato": 17.3}, "unknown parameter steering_rato"),
    ({"steering_sign": 0}, "steering_sign: 0 is not one of 1, -1"),
    ({"steering_ratio": ".nan"}, "steering_ratio: not set; set it or vehicle_file"),
    ({"vehicle_file": "/none.yaml"}, "vehicle_file: /none.yaml: cannot be read: No such file"),
    ({"dbc_file": "/none.dbc"}, "/none.dbc: cannot be read: No such file"),
    ({"interface": "sockcan"}, "interface 'sockcan' is not one of"),
    ({"checks": "['Leaf_Steering']"}, "checks: 'Leaf_Steering' is not MESSAGE=off|warn|drop"),
])
def test_invalid_configuration_is_rejected_in_one_line(refuse, parameters, message, node_parameters):
    assert message in refuse(CanedgeBridge, *(f"{n}:={value}" for n, value in (node_parameters | parameters).items()))


@pytest.mark.slow
def test_process_with_an_invalid_parameter_ends_with_status_2(node_parameters, tmp_path):
    process = launch("canedge_bridge", node_parameters | {"steering_sign": 0}, tmp_path, free_domain())
    output, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "steering_sign: 0" in errors and len(errors.strip().splitlines()) == 1 and output == ""
