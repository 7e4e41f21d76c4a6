"""config/sros2/policies.xml and the topics of optional nodes; the others are in tests/faults/test_faults.py."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
from ros_processes import Processes, wait_for
from support import ROOT

pytestmark = [pytest.mark.ros, pytest.mark.slow]
KINDS = ("publish", "subscribe")


@pytest.mark.parametrize("name", ["identifier", "markers"])
def test_policies_allow_exactly_the_topics_of_a_node(name: str, tmp_path: Path) -> None:
    profile = ElementTree.parse(ROOT / "config/sros2/policies.xml").find(f".//profile[@node='{name}']")
    allowed = {kind: {topic.text for topic in profile.findall(f"./topics[@{kind}='ALLOW']/topic")} for kind in KINDS}
    processes = Processes(tmp_path)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(processes.environment["ROS_DOMAIN_ID"]))
    observer = rclpy.create_node("observer", context=context)
    try:
        processes.node("st_predictor", name, "vehicle_file:=config/vehicle/leaf.yaml")
        wait_for(lambda: all(allowed[kind] <= find_topics(observer, name, kind) for kind in KINDS), what="its topics")
        assert {kind: find_topics(observer, name, kind) for kind in KINDS} == allowed
    finally:
        observer.destroy_node()
        rclpy.try_shutdown(context=context)
        processes.close()


def find_topics(observer, name: str, kind: str) -> set[str]:
    query = {"publish": observer.get_publisher_names_and_types_by_node,
             "subscribe": observer.get_subscriber_names_and_types_by_node}[kind]
    try:
        return {topic for topic, _ in query(name, "/")}
    except rclpy.node.NodeNameNonExistentError:
        return set()
