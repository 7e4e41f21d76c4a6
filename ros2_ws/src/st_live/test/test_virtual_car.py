"""The virtual Leaf and the nodes may use different vehicle files."""

import pytest
from st_live.configuration import VirtualCar
from st_live.suite import SuiteError
from support import ROOT

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
OPTIONS = ["--duration", "6"]


def test_nodes_take_their_file_and_the_car_another(tmp_path):
    believed = tmp_path / "believed.yaml"
    believed.write_text(LEAF.read_text().replace("value: 17.3", "value: 18.7"))
    parameters = VirtualCar(believed, OPTIONS, LEAF).make_bridge_parameters()
    assert {values["vehicle_file"] for values in parameters.values() if "vehicle_file" in values} == {str(believed)}


def test_a_broken_file_of_the_car_is_refused_by_name(tmp_path):
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: nothing else")
    with pytest.raises(SuiteError, match=r"broken\.yaml"):
        VirtualCar(LEAF, OPTIONS, broken)
