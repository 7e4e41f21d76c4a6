"""Which model is good enough for which horizon and speed, on the real drives of the Genesis.

What `st evaluate --advise` says of them, written into docs/measurements/mpc.md.
"""

import os
from pathlib import Path

from _markers import renew, table
from st_core.log_evaluation import EvaluationSettings
from st_core.vehicle import VehicleParameters
from st_offline.evaluation import advice as advice_report
from st_offline.evaluation.advice import cheapest, measure
from st_offline.evaluation.drawing import Place
from st_offline.evaluation.work import Task
from st_recordings.paths import config, project_root
from st_recordings.runs import find_runs

TOLERANCE = 0.3
"""m across."""
MODELS = ("kinematic", "linear", "nonlinear")
OTHERS = ("wrong_projection", "rear_ref")
"""Genesis drives of another projection, and of another point of the car."""
PAGE = project_root() / "docs" / "measurements" / "mpc.md"


def run() -> dict:
    """Rows by model and step, and the choice; nothing where the shared drives are not at hand."""
    data = Path(os.environ.get("ST_SHARED", project_root().parent / "shared")) / "data"
    folders = [data / name for name in ("hyundai_genesis_oxts", "hyundai_genesis_more")]
    if not all(folder.exists() for folder in folders):
        return {"Genesis": "the shared drives are not here"}
    sources = [one for one in find_runs(folders) if not one.name.startswith(OTHERS)]
    file = config("vehicle/hyundai_genesis.yaml")
    task = Task(VehicleParameters.from_yaml(file.read_text(), str(file)), MODELS, EvaluationSettings())
    advice = measure(sources, task, TOLERANCE)
    advice_report.figure(advice.costs, advice.accuracies, TOLERANCE,
                         Place(project_root() / "docs" / "images", ("png",)))
    rows = advice_report.rows(advice.costs, advice.accuracies)
    choice = advice_report.choice_rows(cheapest(advice.costs, advice.accuracies, TOLERANCE))
    title, caption = advice_report.choice_title(TOLERANCE), advice_report.caption(advice.accuracies)
    renew(PAGE, "advice", "\n".join([
        f"Genesis, {len(sources)} real drives. {caption[0].upper()}{caption[1:]}.", "", *table(rows), "",
        f"{title}:", "", *table(choice), "", "![Error and band against cost](../images/advice.png)"]) + "\n")
    return {"Genesis": {f"{row['model']}, {row['step, s']} s": row for row in rows},
            title: {row["speed"]: row for row in choice}}
