"""Faults in a running, supervised suite, one after another. `st bench faults` puts in all of them."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from faults.catalogue import FAULTS
from faults.measure import Recorded, Row, row, run
from faults.rig import running

pytestmark = [pytest.mark.ros, pytest.mark.slow]
SHORT = tuple(fault for fault in FAULTS if fault.short)


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Row]:
    folder: Path = tmp_path_factory.mktemp("faults")
    with running(folder) as rig:
        windows = run(rig, SHORT)
    recorded = Recorded(folder)
    return {window.fault.name: row(window, rig, recorded) for window in windows}


@pytest.mark.parametrize("name", [fault.name for fault in SHORT])
def test_a_fault_is_told_and_survived(rows: dict[str, Row], name: str) -> None:
    assert not rows[name].problems
