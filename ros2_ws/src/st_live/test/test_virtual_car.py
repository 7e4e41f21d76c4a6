"""Different vehicle files of the virtual Leaf and the nodes."""

import pytest
from st_core.errors import ConfigurationError
from st_live.configuration import VirtualCar
from support import LEAF

OPTIONS = ["--duration", "6"]


def test_nodes_use_their_own_vehicle_file(tmp_path):
    file_of_nodes = tmp_path / "nodes.yaml"
    file_of_nodes.write_text(LEAF.read_text().replace("value: 17.3", "value: 18.7"))
    parameters = VirtualCar(file_of_nodes, OPTIONS, LEAF).make_bridge_parameters()
    files = {values["vehicle_file"] for values in parameters.values() if "vehicle_file" in values}
    assert files == {str(file_of_nodes)}


def test_invalid_vehicle_file_of_the_virtual_car_is_rejected_with_its_name(tmp_path):
    invalid = tmp_path / "invalid.yaml"
    invalid.write_text("name: nothing else")
    with pytest.raises(ConfigurationError, match=r"invalid\.yaml"):
        VirtualCar(LEAF, OPTIONS, invalid)
