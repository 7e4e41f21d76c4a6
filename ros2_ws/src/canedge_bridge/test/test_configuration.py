"""Invalid parameters of the node process."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs.msg", reason="needs the built workspace")

from node_rig import launch
from ros_processes import free_domain

pytestmark = pytest.mark.ros


@pytest.mark.slow
@pytest.mark.parametrize(("parameters", "message"), [
    ({"steering_rato": 17.3}, "unknown parameter steering_rato"),
    ({"steering_sign": 0}, "steering_sign: 0 is not one of 1, -1"),
    ({"steering_ratio": ".nan"}, "steering_ratio: not set; set it or vehicle_file"),
    ({"vehicle_file": "/none.yaml"}, "vehicle_file: /none.yaml: cannot be read: No such file"),
    ({"dbc_file": "/none.dbc"}, "/none.dbc: cannot be read: No such file"),
    ({"interface": "sockcan"}, "interface 'sockcan' is not one of"),
    ({"checks": "['Leaf_Steering']"}, "checks: 'Leaf_Steering' is not MESSAGE=off|warn|drop"),
])
def test_invalid_configuration_is_refused_in_one_line(parameters, message, node_parameters, tmp_path):
    process = launch("canedge_bridge", node_parameters | parameters, tmp_path, free_domain())
    output, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    assert message in errors and len(errors.strip().splitlines()) == 1 and output == ""
