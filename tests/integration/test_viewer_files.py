"""Files for RViz, Foxglove and PlotJuggler against the topics, types and fields that the nodes publish."""

import importlib
import json
import re
import time
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from ins_rig import free_port
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from ros_processes import Processes
from st_core.models import MODELS
from st_core.palette import MODEL_COLOUR, rgb
from support import ROOT

from tools.reference import NODES, TOPICS

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
NODES_YAML = ROOT / "config" / "nodes.yaml"
DISPLAY_TYPES = {"rviz_default_plugins/Path": "nav_msgs/msg/Path",
                 "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
                 "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry"}
NUMERIC_TYPES = ("double", "float", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[str, list]]]:
    """topic -> (type, QoS profiles of its publishers) of the running nodes."""
    processes = Processes(tmp_path_factory.mktemp("nodes"))
    port = free_port()
    arguments = ("--params-file", str(NODES_YAML))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(processes.environment["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("observer", context=context)
    try:
        processes.node("oxts_bridge", "oxts_bridge", f"oxts_bridge:udp_port:={port}", arguments=arguments)
        processes.node("canedge_bridge", "canedge_bridge", "canedge_bridge:interface:=udp_multicast",
                       f"canedge_bridge:channel:=239.74.163.{1 + port % 250}", arguments=arguments)
        for name in ("predictor", "evaluator", "identifier", "markers"):
            processes.node("st_predictor", name, arguments=arguments)
        expected = documented_topics().keys()
        end = time.monotonic() + 60
        while not expected <= {t for t, _ in node.get_topic_names_and_types() if node.count_publishers(t)}:
            assert time.monotonic() < end, node.get_topic_names_and_types()
            time.sleep(0.1)
        topics = {}
        for topic, types in node.get_topic_names_and_types():
            publishers = node.get_publishers_info_by_topic(topic)
            if publishers:
                assert len(types) == 1
                topics[topic] = (types[0], [p.qos_profile for p in publishers])
        yield topics
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
        processes.close()


def documented_topics() -> dict[str, str]:
    """topic -> type as published with config/nodes.yaml: without raw frames, with errors of a fourth model."""
    table = {t.replace("<model>", model): kind for t, kind, publisher, _ in TOPICS for model in MODELS
             if publisher in (*NODES, "all")}
    return {t: kind for t, kind in table.items() if t != "/can/frames"} | {
        "/view/augmented/error": table["/view/linear/error"]}


def published_name(topic: str) -> str:
    """The augmented model, published only with a model file, has the same topics as the linear one."""
    return topic.replace("/augmented/", "/linear/")


def is_number(type_name: str, path: list[str]) -> bool:
    """Whether a field path leads to a scalar number of a message type."""
    for name in path:
        package, _, kind = type_name.replace("/msg/", "/").partition("/")
        fields = getattr(importlib.import_module(f"{package}.msg"), kind).get_fields_and_field_types()
        if name not in fields:
            return False
        type_name = fields[name]
    return type_name in NUMERIC_TYPES


def test_topics_of_the_reference_are_those_that_the_nodes_publish(published) -> None:
    topics = {t: kind for t, (kind, _) in published.items()
            if not t.startswith(("/rosout", "/parameter_events")) and not t.endswith("/transition_event")}
    assert topics == documented_topics()


def test_rviz_displays_published_topics_with_compatible_qos(published) -> None:
    document = yaml.safe_load((ROOT / "config/rviz/st.rviz").read_text())["Visualization Manager"]
    displays = [d for d in document["Displays"] if "Topic" in d]
    assert {d["Topic"]["Value"] for d in displays} >= {f"/predictor/{m}/path" for m in MODEL_COLOUR} | {
        "/view/markers", "/view/bands"}
    for display in displays:
        topic = published_name(display["Topic"]["Value"])
        type_name, offered = published[topic]
        assert type_name == DISPLAY_TYPES[display["Class"]], topic
        if display["Topic"]["Reliability Policy"] == "Reliable":
            assert all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered), topic
        if display["Topic"]["Durability Policy"] == "Transient Local":
            assert all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered), topic
    for display in displays:
        model = re.match(r"/predictor/(\w+)/path", display["Topic"]["Value"])
        if model:
            assert display["Color"] == "; ".join(map(str, rgb(MODEL_COLOUR[model.group(1)])))
    nodes = yaml.safe_load(NODES_YAML.read_text())["oxts_bridge"]["ros__parameters"]
    assert document["Global Options"]["Fixed Frame"] == nodes["map_frame"]
    assert document["Views"]["Current"]["Target Frame"] == nodes["base_frame"]


def test_foxglove_layout_uses_published_topics_and_fields(published) -> None:
    layout = json.loads((ROOT / "config/foxglove/st.json").read_text())
    panels = layout["configById"]
    assert set(_leaves(layout["layout"])) == set(panels)
    assert {"/view/markers", "/view/bands"} <= set(panels["3D!map"]["topics"])
    for topic in panels["3D!map"]["topics"]:
        assert published[published_name(topic)][0] in DISPLAY_TYPES.values(), topic
    lines = [line for name, panel in panels.items() if name.startswith("Plot!") for line in panel["paths"]]
    assert len(lines) >= 2 * len(MODEL_COLOUR) + 2
    for line in lines:
        topic, *fields = line["value"].split(".")
        assert is_number(published[published_name(topic)][0], fields), line["value"]
        assert is_number(published[published_name(topic)][0], ["header", "stamp", "sec"])  # timestampMethod headerStamp
        if line["label"] in MODEL_COLOUR:
            assert line["color"] == MODEL_COLOUR[line["label"]] and f"/{line['label']}/" in topic
    assert published[panels["DiagnosticSummary!health"]["topicToRender"]][0] == "diagnostic_msgs/msg/DiagnosticArray"
    assert panels["RawMessages!summary"]["topicPath"] in published


def _leaves(layout: object) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        yield from _leaves(layout["first"])
        yield from _leaves(layout["second"])


def test_plotjuggler_layout_uses_published_fields(published) -> None:
    root = ElementTree.parse(ROOT / "config/plotjuggler/st.xml").getroot()
    subscribed = {published_name(t.get("name")) for t in root.iter("topic")}
    assert subscribed <= published.keys()
    curves = [(c.get("name"), c.get("color")) for c in root.iter("curve")]
    assert len(curves) >= 3 * len(MODEL_COLOUR)
    for name, colour in curves:
        topic = max((t for t in published if published_name(name).startswith(t + "/")), key=len)
        assert topic in subscribed, name
        assert is_number(published[topic][0], published_name(name)[len(topic) + 1:].split("/")), name
        model = re.match(r"/(?:view|predictor)/(\w+)/", name)
        if model and model.group(1) in MODEL_COLOUR:
            assert colour == MODEL_COLOUR[model.group(1)], name


def test_viewer_files_are_ascii_without_tabs() -> None:
    for file in ("config/rviz/st.rviz", "config/foxglove/st.json", "config/plotjuggler/st.xml"):
        text = (ROOT / file).read_text()
        assert text.isascii() and "\t" not in text, file
