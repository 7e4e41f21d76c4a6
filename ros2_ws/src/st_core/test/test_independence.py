"""The core imports no ROS and no heavy package until it is needed, shown in a new interpreter."""

import subprocess
import sys

CODE = """
import sys
import st_core.backends, st_core.batch, st_core.effects, st_core.evaluation, st_core.log_evaluation, st_core.models
import st_core.prediction, st_core.vehicle
heavy = {"rclpy", "numba", "llvmlite", "casadi", "scipy", "matplotlib", "pandas"}
print(sorted(heavy & {name.partition(".")[0] for name in sys.modules}))
"""


def test_core_imports_no_heavy_package():
    out = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True,
                         env={"PYTHONPATH": ":".join(sys.path)})
    assert out.stdout.strip() == "[]"
