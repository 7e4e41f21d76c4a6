from collections.abc import Iterator
from pathlib import Path

import pytest
from ros_processes import Processes


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    running = Processes(tmp_path)
    yield running
    running.close()
