"""Time from the start of Python to first predictions: live in scalar Python; a batch with new and cached kernels."""

import os
import subprocess
import sys
import tempfile

from ._drives import LEAF_FILE

LIVE = """
from pathlib import Path
import sys, time
from st_core.vehicle import VehicleParameters
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState
car = VehicleParameters.from_yaml(Path(sys.argv[1]).read_text())
for model in ("kinematic", "linear", "nonlinear"):
    predict(model, car, VehicleState(0, 0, 10, 0, 0, 0), ControlInput(0.05, 0.0))
print(time.process_time())
"""
BATCH = """
from pathlib import Path
import sys, time
sys.path.insert(0, sys.argv[2])
from ._drives import leaf
from ._processor_time import start_times, weaving_drive
from st_core.batch import LogBatch
log = weaving_drive(20.0)
batch = LogBatch(log, start_times(log), backend=sys.argv[3])
for model in ("kinematic", "linear", "nonlinear"):
    batch.predict(model, leaf())
print(time.process_time())
"""


def run() -> dict:
    """Processor time [s] of the whole process, including the start of Python and the import of numpy."""
    here, car = os.path.dirname(os.path.abspath(__file__)), str(LEAF_FILE)
    with tempfile.TemporaryDirectory(prefix="st-bench-") as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}

        def seconds(code: str, backend: str = "") -> float:
            result = subprocess.run([sys.executable, "-c", code, car, here, backend], env=environment, check=True,
                                    capture_output=True, text=True)
            return float(result.stdout)

        return {"live_floats_s": seconds(LIVE), "batch_numpy_s": seconds(BATCH, "numpy"),
                "batch_lanes_cold_s": seconds(BATCH, "lanes"), "batch_lanes_cached_s": seconds(BATCH, "lanes")}
