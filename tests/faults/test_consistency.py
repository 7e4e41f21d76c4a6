"""Contradictory signals of a car on a winding road are reported live, and the reports end after the fault.

The late yaw rate and the flipped steering angle are in st_predictor/test/test_consistency.py and `st bench faults`.
"""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from st_live.nodes.monitor import render_health

from faults.car import WindingRoad
from faults.catalogue import CONSISTENCY, DRIVING
from faults.measure import Recorded, Row, evaluate, inject
from faults.rig import running

pytestmark = [
    pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600),
    pytest.mark.timing("nodes run in real time and skip ticks on a busy machine"),
]
SHORT = tuple(fault for fault in DRIVING if fault.short)
ROAD_DURATION = 900.0  # s
HEALTHY_DURATION = 60.0  # s, within which the healthy car is judged consistent


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Row]:
    folder = tmp_path_factory.mktemp("consistency")
    with running(folder, drive=WindingRoad(ROAD_DURATION)) as rig:
        assert rig.run(HEALTHY_DURATION, lambda: CONSISTENCY in rig.monitor.state.health
                       and "no fault found" in rig.monitor.state.health[CONSISTENCY].message
               and render_health(rig.monitor.state).plain == "all nodes OK")
        windows = [inject(rig, fault, until_reported=True) for fault in SHORT]
    assert set(rig.statuses.values()) == {0}
    recorded = Recorded(folder)
    return {window.fault.name: evaluate(window, rig, recorded) for window in windows}


@pytest.mark.parametrize("name", [fault.name for fault in SHORT])
def test_it_is_reported_within_a_minute_and_clears(rows: dict[str, Row], name: str) -> None:
    found = rows[name]
    assert not found.problems
    assert 0.0 < found.notice <= 60.0
    assert 0.0 < found.clear <= 90.0
