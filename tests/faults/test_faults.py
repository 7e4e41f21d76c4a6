"""Faults in a running, supervised suite, one after another. `st bench faults` puts in all of them.

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
from faults.measure import Recorded, Row, row, run
from faults.rig import running

pytestmark = [
    pytest.mark.ros, pytest.mark.slow,
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
SHORT = tuple(fault for fault in FAULTS if fault.short)


class Run(NamedTuple):
    """graph: node -> (topics it publishes, topics it subscribes), before the first fault."""

    rows: dict[str, Row]
    graph: dict[str, tuple[set[str], set[str]]]
    statuses: dict[str, int]


def graph_of(node, names) -> dict[str, tuple[set[str], set[str]]]:
    return {n: ({topic for topic, _ in node.get_publisher_names_and_types_by_node(n, "/")},
                {topic for topic, _ in node.get_subscriber_names_and_types_by_node(n, "/")}) for n in names}


def policies(graph) -> Iterator[tuple[str, set[str], set[str]]]:
    """(node, topics used, patterns allowed), of what each node publishes and of what it subscribes."""
    tree = ElementTree.parse(ROOT / "config" / "sros2" / "policies.xml")
    for node, both in graph.items():
        profile = tree.find(f".//profile[@node='{node}']")
        for kind, used in zip(("publish", "subscribe"), both, strict=True):
            yield node, used, {topic.text for topic in profile.findall(f"./topics[@{kind}='ALLOW']/topic")}


def unused(graph) -> list[tuple[str, str]]:
    """(node, pattern) that is allowed without need."""
    return [(node, a) for node, used, allowed in policies(graph) for a in allowed
            if not any(fnmatchcase(topic, a) for topic in used)]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder: Path = tmp_path_factory.mktemp("faults")
    with running(folder) as rig:
        # The recorder subscribes to what it finds, a moment after all nodes are well.
        rig.run(30.0, lambda: not unused(graph_of(rig.monitor._node, rig.names)))
        graph = graph_of(rig.monitor._node, rig.names)
        windows = run(rig, SHORT)
    recorded = Recorded(folder)
    return Run({window.fault.name: row(window, rig, recorded) for window in windows}, graph, rig.statuses)


@pytest.mark.parametrize("name", [fault.name for fault in SHORT])
def test_a_fault_is_told_and_survived(done: Run, name: str) -> None:
    assert not done.rows[name].problems


def test_all_end_well_afterwards(done: Run) -> None:
    assert done.statuses.keys() == {"oxts_bridge", "canedge_bridge", "predictor", "evaluator", "recorder"}
    # The recording was not whole: the disk was full once.
    assert {name for name, status in done.statuses.items() if status} == {"recorder"}


def test_policies_allow_what_the_nodes_do_and_no_more(done: Run) -> None:
    forbidden = [(node, topic) for node, used, allowed in policies(done.graph) for topic in used
                 if not any(fnmatchcase(topic, a) for a in allowed)]
    assert forbidden == [] and unused(done.graph) == []
