"""Signals that contradict each other, on the wires of a car on a winding road: told live, and gone by themselves.

The late yaw rate is in st_predictor/test/test_consistency.py and `st bench faults`.
"""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_live.node import render_health

from faults.car import WindingRoad
from faults.catalogue import CONSISTENCY, DRIVING
from faults.measure import Recorded, Row, put, row
from faults.rig import running

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600),
    pytest.mark.timing("nodes run in real time; one that waits for its turn skips ticks"),
]
SHORT = tuple(fault for fault in DRIVING if fault.short)
ROAD = 900.0  # s
FIRST = 60.0  # s in which a right car is judged


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Row]:
    folder = tmp_path_factory.mktemp("consistency")
    with running(folder, drive=WindingRoad(ROAD)) as rig:
        assert rig.run(FIRST, lambda: CONSISTENCY in rig.monitor.state.health
                       and "agree" in rig.monitor.state.health[CONSISTENCY].message and rig.is_well())
        assert render_health(rig.monitor.state).plain == "all nodes OK"
        windows = [put(rig, fault, until_told=True) for fault in SHORT]
    assert set(rig.statuses.values()) == {0}
    recorded = Recorded(folder)
    return {window.fault.name: row(window, rig, recorded) for window in windows}


@pytest.mark.parametrize("name", [fault.name for fault in SHORT])
def test_it_is_told_within_a_minute_and_clears_by_itself(rows: dict[str, Row], name: str) -> None:
    found = rows[name]
    assert not found.problems
    assert 0.0 < found.notice <= 60.0
    assert 0.0 < found.clear <= 90.0
