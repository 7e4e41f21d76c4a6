"""Closed loop, live: drives a car with hidden effects, runs `st discover`, and drives a new road with its files.

Two cases: two effects of the library and a wrong value in the vehicle file; and a relation outside the library, which
`st discover` proposes. Everything runs through bridges, nodes and files: `st demo`, `st discover`, `st demo`. The
errors before and after are those of two drives in real time, over the starts that were scored in both.
"""

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from st_recordings.paths import config, project_root
from st_recordings.results import read_results

from ._drives import LEAF_FILE
from ._pages import format_records, replace_part

RATIO_LINE = "steering_ratio: {value: 17.3"
RATIO_ERROR = 1.08  # factor on the steering ratio in the file
HIDDEN = {"steering_lag": 0.14, "ins_misalignment": 0.012}  # s, rad
DRIVES = ("sweep", "slalom", "lane_change", "brake_in_turn", "there_and_back", "weave")
DURATION, NEW_ROAD, NEW_ROAD_DURATION = 30.0, "S6", 60.0  # s
RELATION = {"drive_offset": 0.2}  # m; the yaw moment is proportional to the force of drive and brakes
RELATION_DRIVES = ("sweep", "lane_change", "brake_in_turn", "S6", "slalom.yaml", "stop_and_go.yaml")
RELATION_DURATION, RELATION_NEW_ROAD, RELATION_NEW_ROAD_DURATION = 40.0, "S7", 50.0
PERIOD = 0.1  # s between starts
PAGE = project_root() / "docs" / "measurements" / "closed_loop.md"
IMAGES = project_root() / "docs" / "images"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs both cases, or that of the relation, and prints the results; drives that exist are not repeated."""
    parser = argparse.ArgumentParser(prog="st bench closed_loop", description=__doc__)
    parser.add_argument("--folder", type=Path, help="folder for all runs; existing runs are not repeated")
    parser.add_argument("--relation", action="store_true",
                        help="only the case of the relation that is not in the library")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="st-closed-loop-") as temporary:
        folder = chosen.folder or Path(temporary)
        (folder / "law").mkdir(parents=True, exist_ok=True)
        cases = {"law": lambda: run_relation(folder / "law")} | ({} if chosen.relation else {
            "effects": lambda: run_effects(folder)})
        print(json.dumps({name: case() for name, case in sorted(cases.items())}, indent=1))
    return 0


def run_effects(folder: Path) -> dict:
    """Effects found, and lateral RMSE [m] over 5 s by model before and after; writes its parts of the page."""
    vehicle = _write_wrong_file(folder)
    car = ("--plant-vehicle", LEAF_FILE, *_effect_options(HIDDEN))
    discovery = _discover(folder, DRIVES, DURATION, vehicle, car)
    corrected, model = folder / "found" / "vehicle.yaml", folder / "found" / "model.yaml"
    unseen = ("--scenario", NEW_ROAD, "--duration", NEW_ROAD_DURATION, *car, "--seed", 100)
    drives = [_drive(folder / "before", *unseen, "--vehicle", vehicle),
              _drive(folder / "after", *unseen, "--vehicle", corrected if corrected.exists() else vehicle,
                     "--model", model)]
    before, after = compare_drives(*map(read_scored, drives))
    base, augmented = _position_errors(discovery)
    found = [{"effect": f"`{effect['name']}`", "value, 95 % interval": _describe_values(effect)}
             for effect in discovery["effects"]]
    kept = ", ".join(effect["name"] for effect in discovery["minor"]) or "nothing"
    replace_part(PAGE, "effects found", f"Held-out 5 s position {base:.2f} → {augmented:.2f} m:\n\n"
                 f"{format_records(found)}\n\nIn the model, but not reported as causes: {kept}.")
    known = before["lateral"]
    errors = [{"model": name if name in known else f"{name}, `model.yaml`",
               "before, m": f"{known[name]:.3f}" if name in known else "-", "after, m": f"{now:.3f}"}
              for name, now in after["lateral"].items()]
    replace_part(PAGE, "errors with the effects", _format_errors(after["starts"], errors))
    _draw(IMAGES / "closed_loop.png", {name: (known.get(name), now) for name, now in after["lateral"].items()},
          ("file and model before", "corrected by st discover"))
    return {"found": found, "kept": kept, "corrected": corrected.exists(), "position_5s": [base, augmented],
            "before": before, "after": after}


def run_relation(folder: Path) -> dict:
    """The proposed relation, and lateral RMSE [m] over 5 s; writes its parts of the page.

    Models: nonlinear with the given vehicle file; augmented with the effects of the library, or with the relation.
    """
    vehicle, car = LEAF_FILE, _effect_options(RELATION)
    discovery = _discover(folder, RELATION_DRIVES, RELATION_DURATION, vehicle, car, "--propose")
    written = {name: folder / "found" / name for name in ("vehicle.yaml", "model.yaml", "proposed.yaml", "effects")}
    unseen = ("--scenario", RELATION_NEW_ROAD, "--duration", RELATION_NEW_ROAD_DURATION, *car, "--seed", 100)
    # A model file is valid for one vehicle file: model.yaml for the corrected one, proposed.yaml for the given one.
    corrected = written["vehicle.yaml"] if written["vehicle.yaml"].exists() else vehicle
    model = ("--model", written["model.yaml"]) if written["model.yaml"].exists() else ()
    drives = [_drive(folder / "before", *unseen, "--vehicle", corrected, *model)]
    if written["proposed.yaml"].exists():
        drives.append(_drive(folder / "after", *unseen, "--vehicle", vehicle, "--model", written["proposed.yaml"],
                             "--effects", written["effects"]))
    library, *proposed = compare_drives(*map(read_scored, drives))
    known = library["lateral"].get("augmented", library["lateral"]["nonlinear"])
    rows = {"augmented, `model.yaml`: the library": known}
    for drive in proposed:
        rows = {"nonlinear, vehicle file as given": drive["lateral"]["nonlinear"], **rows,
                "augmented, `proposed.yaml`: with the relation": drive["lateral"]["augmented"]}
    replace_part(PAGE, "relation found", _describe_relation(discovery))
    replace_part(PAGE, "errors with the relation", _format_errors(
        library["starts"], [{"model": name, "m": f"{error:.3f}"} for name, error in rows.items()]))
    if proposed:
        given, _, relation = rows.values()
        _draw(IMAGES / "closed_loop_law.png", {"library": (given, known), "with the relation": (given, relation)},
              ("nonlinear model", "augmented model"))
        shutil.copy(folder / "found" / "figures" / "relation.png", IMAGES / "closed_loop_law_curve.png")
    return {"relation": discovery["relation"], "errors": rows, "starts": library["starts"]}


def _discover(folder: Path, drives: Sequence[str], seconds: float, vehicle: Path, car: Sequence[object],
              *options: str) -> dict:
    """Records the drives live and runs `st discover` on them; returns the content of discovery.json."""
    for number, name in enumerate(drives):
        road = config(f"manoeuvres/{name}") if name.endswith(".yaml") else name
        _drive(folder / Path(name).stem, "--scenario", road, "--duration", seconds, "--vehicle", vehicle, *car,
                "--seed", number)
    if not (folder / "found").exists():
        _st("discover", *(folder / Path(name).stem / "bag" for name in drives), "--vehicle", vehicle, *options,
            "--output", folder / "found")
    return json.loads((folder / "found" / "discovery.json").read_text())


@dataclass(frozen=True, eq=False)
class Scored:
    """Starts of a live drive at which every model was scored in hindsight.

    time: (n,) since the start of the drive [s]. lateral: horizon means of the error [m], (n,) by model.
    """

    time: np.ndarray
    lateral: Mapping[str, np.ndarray]


def _drive(folder: Path, *options: object) -> Path:
    """Records a live drive, unless its folder exists; returns the folder."""
    if not folder.exists():
        _st("demo", *options, "--output", folder)
    return folder


def read_scored(folder: Path) -> Scored:
    scores = {model: errors for (model, mode), errors in read_results(folder).scores.items() if mode == "hindsight"}
    starts = np.array(sorted(set.intersection(*(set(s.start_ns[s.complete].tolist()) for s in scores.values()))), int)
    with (folder / "truth" / "truth.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise RuntimeError(f"{folder}: its truth.mcap is truncated, so that the start of the drive is unknown")
    return Scored((starts - summary.statistics.message_start_time) * 1e-9,
                  {model: errors.lateral[np.isin(errors.start_ns, starts)] for model, errors in scores.items()})


def compare_drives(*drives: Scored) -> list[dict]:
    """Number of starts and lateral RMSE [m] by model for each repetition of a drive, over the starts common to all.

    A start is common if every repetition has one within half a period of it. On a busy computer, measurements
    may be lost, each with 5 s of starts; scores of different parts of the road are not comparable.
    """
    first = drives[0].time
    rows = [np.abs(drive.time - first[:, None]).argmin(axis=1) for drive in drives]
    offsets = [np.abs(drive.time[row] - first) for drive, row in zip(drives, rows, strict=True)]
    common = np.max(offsets, axis=0) <= PERIOD / 2
    return [{"starts": int(common.sum()), "lateral": {model: float(np.sqrt(np.mean(np.square(errors[row[common]]))))
                                                      for model, errors in drive.lateral.items()}}
            for drive, row in zip(drives, rows, strict=True)]


def _effect_options(effects: Mapping[str, float]) -> list[str]:
    return [part for name, value in effects.items() for part in ("--effect", f"{name}={value}")]


def _position_errors(found: dict) -> list[float]:
    return [found["errors"]["position_5s"][k] for k in ("base", "augmented")]


def _write_wrong_file(folder: Path) -> Path:
    text = LEAF_FILE.read_text()
    if RATIO_LINE not in text:
        raise RuntimeError(f"{LEAF_FILE} does not have the steering ratio that this benchmark expects")
    file = folder / "car.yaml"
    file.write_text(text.replace(RATIO_LINE, f"steering_ratio: {{value: {17.3 * RATIO_ERROR:.4f}"))
    return file


def _st(*arguments: object) -> None:
    # Not in the ROS domain of a suite that may be running.
    clean = {k: v for k, v in os.environ.items() if k != "ROS_DOMAIN_ID"}
    subprocess.run([str(project_root() / "st"), *map(str, arguments)], check=True, env=clean)


def _describe_values(effect: dict) -> str:
    values = ", ".join(f"{name} {p['value']:.4g} [{p['interval'][0]:.4g}, {p['interval'][1]:.4g}] {p['unit']}"
                       for name, p in effect["parameters"].items())
    also = f"; not excluded: {', '.join(effect['alternatives'])}" if effect["alternatives"] else ""
    return values + also


def _describe_relation(discovery: dict) -> str:
    """Effects of the library, the proposal, and their held-out errors."""
    stated, kept = (", ".join(f"`{e['name']}`" for e in discovery[key]) or "nothing" for key in ("effects", "minor"))
    text = f"Effects of the library: reported {stated}, in the model only {kept}.\n"
    relation, (base, library) = discovery["relation"]["proposal"], _position_errors(discovery)
    if not relation:
        return f"{text}Nothing is proposed: {discovery['relation']['reason']}."
    place, quantity = (relation[key].replace("_", " ") for key in ("term", "quantity"))
    formulas = "; ".join(f"`{r['text']}` ({r['shape']}, {100 * r['retained_fraction']:.0f} %)"
                         for r in relation["formulas"])
    others = "; ".join(f"{name.replace('_', ' ')} (cosine {cosine:.2f})" for name, cosine in relation["rivals"].items())
    return (f"{text}**Proposed: {place} as a function of {quantity}.** Formulas: {formulas or 'no simple shape'}.\n"
            f"Not distinguishable from it: {others or 'none'}.\n"
            f"Held-out position error after 5 s of the recorded drives: "
            f"{base:.3f} (file as given), {library:.3f} (library), {relation['position_5s'][1]:.3f} m "
            "(with the relation).")


def _format_errors(starts: int, rows: Sequence[Mapping[str, str]]) -> str:
    return (f"Live, lateral error over 5 s in hindsight, RMSE over {starts} starts of both drives:\n\n"
            f"{format_records(rows)}")


def _draw(file: Path, rows: Mapping[str, tuple[float | None, float]], labels: tuple[str, str]) -> None:
    """Plots errors by name, before (None: not measured) and after [m]."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from st_core.palette import FIGURE_STYLE, MODEL_COLOUR

    with plt.rc_context(FIGURE_STYLE):
        figure, axis = plt.subplots(figsize=(6.5, 2.4))
        for row, (name, (start, now)) in enumerate(rows.items()):
            colour = MODEL_COLOUR.get(name, MODEL_COLOUR["augmented"])
            if start is not None:
                axis.plot([start, now], [row, row], color=colour, linewidth=1)
                axis.plot(start, row, "o", markerfacecolor="white", color=colour)
            axis.plot(now, row, "o", color=colour)
            axis.annotate(f"{now:.2f} m", (now, row), (0, 6), textcoords="offset points", ha="center")
        axis.plot([], [], "o", color="0.3", markerfacecolor="white", label=labels[0])
        axis.plot([], [], "o", color="0.3", label=labels[1])
        axis.set(xlabel="lateral error over 5 s, RMSE, live, hindsight [m]", xlim=(0.0, None), yticks=range(len(rows)),
                 yticklabels=list(rows), ylim=(len(rows) - 0.3, -0.7))
        axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
        figure.savefig(file)
        plt.close(figure)
