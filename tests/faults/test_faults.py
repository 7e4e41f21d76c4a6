"""Faults in a running, supervised suite, one after another. `st bench faults` injects all of them.

A second publisher is in st_predictor/test/test_publishers.py, a clock that jumps back in test_trouble.py there.
"""

from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from support import ROOT

from faults.catalogue import FAULTS
from faults.measure import Recorded, Row, evaluate, inject_all
from faults.rig import running

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time and skip ticks on a busy machine"),
]
SHORT = tuple(fault for fault in FAULTS if fault.short)


class Run(NamedTuple):
    """graph: node -> (topics it publishes, topics it subscribes), before the first fault."""

    rows: dict[str, Row]
    graph: dict[str, tuple[set[str], set[str]]]
    statuses: dict[str, int]


def read_graph(node, names) -> dict[str, tuple[set[str], set[str]]]:
    return {n: ({topic for topic, _ in node.get_publisher_names_and_types_by_node(n, "/")},
                {topic for topic, _ in node.get_subscriber_names_and_types_by_node(n, "/")}) for n in names}


def list_policies(graph) -> Iterator[tuple[str, set[str], set[str]]]:
    """(node, topics used, patterns allowed), once for publications and once for subscriptions of each node."""
    tree = ElementTree.parse(ROOT / "config" / "sros2" / "policies.xml")
    for node, topics in graph.items():
        profile = tree.find(f".//profile[@node='{node}']")
        for kind, used in zip(("publish", "subscribe"), topics, strict=True):
            yield node, used, {topic.text for topic in profile.findall(f"./topics[@{kind}='ALLOW']/topic")}


def unneeded(graph) -> list[tuple[str, str]]:
    """(node, pattern) of permissions that no topic needs."""
    return [(node, pattern) for node, used, allowed in list_policies(graph) for pattern in allowed
            if not any(fnmatchcase(topic, pattern) for topic in used)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder: Path = tmp_path_factory.mktemp("faults")
    with running(folder) as rig:
        # The recorder subscribes to the topics that it finds, shortly after all nodes have started.
        rig.run(30.0, lambda: not unneeded(read_graph(rig.monitor._node, rig.names)))
        graph = read_graph(rig.monitor._node, rig.names)
        windows = inject_all(rig, SHORT)
    recorded = Recorded(folder)
    return Run({window.fault.name: evaluate(window, rig, recorded) for window in windows}, graph, rig.statuses)


@pytest.mark.parametrize("name", [fault.name for fault in SHORT])
def test_a_fault_is_reported_and_survived(finished: Run, name: str) -> None:
    assert not finished.rows[name].problems


def test_nodes_exit_without_error(finished: Run) -> None:
    assert finished.statuses.keys() == {"oxts_bridge", "canedge_bridge", "predictor", "evaluator", "recorder"}
    # The recording is incomplete, since the disk was full once.
    assert {name for name, status in finished.statuses.items() if status} == {"recorder"}


def test_policies_allow_only_what_the_nodes_need(finished: Run) -> None:
    forbidden = [(node, topic) for node, used, allowed in list_policies(finished.graph) for topic in used
                 if not any(fnmatchcase(topic, pattern) for pattern in allowed)]
    assert forbidden == [] and unneeded(finished.graph) == []
