"""The same measurements and configuration give identical bytes of predictions and errors."""

import os
import subprocess
import sys

import pytest
from support import ROOT

LIVE = """
import hashlib
import numpy as np
from drives import weave
from st_core.evaluation import Evaluator
from st_core.prediction import PredictionSettings, Predictor, Start
from st_core.types import InsSample
from support import read_car

vehicle, settings = read_car("leaf"), PredictionSettings()
predictor = Predictor(vehicle, ["kinematic", "linear", "nonlinear"], settings)
evaluator = Evaluator(vehicle, settings, 65.0)
predictions, errors, count = hashlib.sha256(), hashlib.sha256(), 0
for k, (t, x, y, yaw, vx, vy, yaw_rate, _, _, delta) in enumerate(weave(9.0).tolist()):
    time_ns = 10**18 + round(t * 1e9)
    sample = InsSample(time_ns=time_ns, x=x, y=y, yaw=yaw, velocity_x=vx, velocity_y=vy, yaw_rate=yaw_rate)
    for consumer in (predictor, evaluator):
        consumer.add_ins(sample)
        consumer.add_steering(time_ns, delta)
    start = predictor.find_start(time_ns) if k % 5 == 4 else None
    if isinstance(start, Start):
        for model in predictor.models:
            trajectory = predictor.run(start, model)
            predictions.update(trajectory.states.tobytes())
            evaluator.add_prediction(model, start.time_ns, trajectory)
    for score in (*evaluator.poll(), *(evaluator.flush() if k == 449 else ())):
        count += score.complete
        errors.update(np.stack([score.longitudinal, score.lateral, score.yaw]).tobytes())
print(predictions.hexdigest(), errors.hexdigest(), count)
"""

BATCH = """
import hashlib
from drives import read_csv, weave, write_drive
from pathlib import Path
import tempfile
from st_core.log_evaluation import evaluate_log
from support import read_car

vehicle = read_car("leaf")
with tempfile.TemporaryDirectory() as name:
    log = read_csv(write_drive(Path(name) / "drive.csv", weave(14.0))).log
found = evaluate_log(["kinematic", "linear", "nonlinear"], vehicle, log)
content = hashlib.sha256()
for key in sorted(found.errors):
    for values in vars(found.errors[key]).values():
        content.update(values.tobytes())
print(content.hexdigest(), len(found.starts_ns))
"""


def run_twice(program: str) -> list[str]:
    """Outputs of two processes with different order of sets and number of threads."""
    outputs = []
    for seed, threads in (("1", "1"), ("2", "2")):
        environment = os.environ | {"PYTHONHASHSEED": seed, "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads,
                                    "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), *sys.path])}
        run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True,
                             check=False)
        assert run.returncode == 0, run.stderr
        outputs.append(run.stdout)
    return outputs


@pytest.mark.slow
@pytest.mark.parametrize("program", [LIVE, BATCH], ids=["live classes", "batch over a log"])
def test_results_do_not_depend_on_hash_seed_and_threads(program):
    first, second = run_twice(program)
    assert first == second
    assert int(first.split()[-1]) > 20
