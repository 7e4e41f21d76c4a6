"""The live path needs numpy and yaml only, and no file or clock: shown in a fresh interpreter."""

import subprocess
import sys

CODE = """
import sys
import st_core.prediction, st_core.evaluation, st_core.models, st_core.vehicle
heavy = {"rclpy", "numba", "casadi", "scipy", "matplotlib", "pandas"} & {name.partition(".")[0] for name in sys.modules}
print(sorted(heavy))
"""


def test_live_path_imports_nothing_heavy():
    out = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True,
                         env={"PYTHONPATH": ":".join(sys.path)})
    assert out.stdout.strip() == "[]"
