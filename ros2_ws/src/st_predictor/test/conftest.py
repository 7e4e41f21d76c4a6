import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros_processes import Processes


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    # Domains 60 to 99, so that tests running at the same time on one machine do not hear each other.
    running = Processes(tmp_path, 60 + os.getpid() % 40)
    yield running
    running.close()
