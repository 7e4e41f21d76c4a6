"""`colcon test` runs the tests of the packages; a run of zero tests is a failure."""

import os
import re
import subprocess

import pytest
from support import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.ros]
pytest.importorskip("colcon_core", reason="colcon is not installed")
PACKAGES = ("st_ros", "oxts_bridge")


def test_colcon_test_runs_more_than_ten_tests_per_package(tmp_path) -> None:
    """Two packages, without the tests of live nodes, which the whole suite runs."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    workspace = os.environ["ST_WORKSPACE"]
    run = subprocess.run(
        ["colcon", "--log-base", str(tmp_path / "log"), "test", "--base-paths", str(ROOT / "ros2_ws" / "src"),
         "--build-base", f"{workspace}/build", "--install-base", f"{workspace}/install", "--packages-select", *PACKAGES,
         "--test-result-base", str(tmp_path / "results"), "--return-code-on-test-failure", "--event-handlers",
         "console_direct+", "--pytest-args", " -m", "not timing"],
        cwd=ROOT / "ros2_ws", check=False, env=environment, capture_output=True, text=True, timeout=280)
    assert run.returncode == 0, run.stdout[-3000:]
    counts = [int(n) for n in re.findall(r"(\d+) passed", run.stdout)]
    assert len(counts) == len(PACKAGES) and min(counts) > 10, run.stdout[-2000:]
