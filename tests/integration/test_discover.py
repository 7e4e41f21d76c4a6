"""st discover from raw files, .ncom and CAN logs of the virtual Leaf, to discovery.json: hidden effects, healthy ones.

The plant of the virtual car has its own equations; what is hidden is a setting of it, and the answer must be the effect
of the models that means the same, with its size. The healthy car is the realistic one: its lag, compliance, roll steer
and load transfer are in every drive, and none of them may be named.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from raw_drives import LEAF, write_drives
from st_core.discovery import DiscoverySettings, discover
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.cli import app
from st_offline.discovery.command import write_results
from st_offline.discovery.document import Question
from st_offline.discovery.drives import Drive, read_drives
from st_offline.runs import ReadSettings, find_runs
from typer.testing import CliRunner

pytestmark = pytest.mark.slow
CAR = VehicleParameters.from_yaml(LEAF.read_text(), str(LEAF))
SHORT = (("sweep", 26.0), ("brake_in_turn", 20.0))

# settings of the plant, effect of the models, parameter, change against the healthy car (None: only the name counts)
HIDDEN = [
    ({"steering_lag": 0.14}, "steering_lag", "time_constant", 0.1),
    ({"steering_delay": 0.08}, "steering_delay", "time", 0.08),
    ({"steering_offset": 0.008}, "steering_offset", "angle", 0.008),
    ({"steering_ratio_factor": 1.08}, "steering_ratio", "factor", 1.08),
    ({"rear_stiffness_factor": 0.8}, "rear_stiffness", "factor", None),
    ({"velocity_scale": 1.03}, "speed_scale", "factor", None),
    ({"ins_misalignment": 0.02}, "heading_misalignment", "angle", None),
    ({"yaw_rate_scale": 1.06}, "yaw_rate_scale", "factor", None),
]


def drives(folder: Path) -> list[Drive]:
    # By force: some of the hidden effects are faults of a sensor, which the checks refuse and discovery must name too.
    read = read_drives(find_runs([folder]), CAR, ReadSettings(), 1, None, lambda: None, force=True)
    assert not [d.problem for d in read if d.problem]
    return read


def logs(read: list[Drive]) -> list[DriveLog]:
    return [d.log for d in read if d.log is not None]


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Drive], list[DriveLog]]:
    """Read once: what the reference teaches is kept for the same logs."""
    read = drives(write_drives(tmp_path_factory.mktemp("healthy"), {}, 1, SHORT))
    return read, logs(read)


def answer(folder: Path, effects: Mapping[str, float], seed: int, healthy, settings=None) -> dict[str, Any]:
    """discovery.json of drives with these settings of the plant."""
    read = drives(write_drives(folder / "raw", effects, seed, SHORT))
    settings = settings or DiscoverySettings(where=False)
    found = discover(logs(read), CAR, "nonlinear", healthy[1], settings)
    out = folder / "out"
    out.mkdir()
    write_results(found, Question(read, healthy[0], "nonlinear", CAR, str(LEAF), settings, {}), out, None, {})
    return json.loads((out / "discovery.json").read_text())


@pytest.mark.parametrize(("effects", "name", "parameter", "value"), HIDDEN, ids=[h[1] for h in HIDDEN])
def test_hidden_effect_is_named_with_its_size(tmp_path, healthy, effects, name, parameter, value):
    content = answer(tmp_path, effects, 100, healthy)
    assert content["outcome"] in ("named", "ambiguous")
    (found,) = content["effects"]
    assert name in (found["name"], *found["alternatives"])
    if found["name"] == name and value is not None:
        low, high = found["parameters"][parameter]["interval"]
        assert low <= value <= high
    assert any(gap["interval"][0] > 0.0 for gap in content["gap"].values())
    # A turned INS does not touch the yaw rate.
    gap = content["gap"]["velocity_y" if name == "heading_misalignment" else "yaw_rate"]
    assert gap["augmented"] < gap["base"] or "scale" in name


@pytest.mark.parametrize("seed", [200, 300])
def test_healthy_car_has_nothing_missing(tmp_path, healthy, seed):
    content = answer(tmp_path, {}, seed, healthy)
    assert content["outcome"] == "none" and not content["effects"]
    assert not (tmp_path / "out" / "model.yaml").exists()
    assert {"drag", "grade"} <= {n["name"] for n in content["not_testable"]}


def test_twins_are_never_one_wrong_name(tmp_path, healthy):
    """Slow driving hardly tells a lag from a dead time: one name only if it is the right one, else the set and a drive.
    """
    read = drives(write_drives(tmp_path / "raw", {"steering_lag": 0.1}, 400, (("S2", 14.0), ("S6", 14.0))))
    found = discover(logs(read), CAR, "nonlinear", healthy[1], DiscoverySettings(where=False))
    names = {n for e in found.effects for n in (e.name, *e.alternatives)}
    assert found.outcome != "named" or names == {"steering_lag"}
    if found.outcome == "ambiguous":
        assert "steering_lag" in names and found.separability and found.next_manoeuvre is not None


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory):
    """The whole verb: a lag, from files to the page."""
    base = tmp_path_factory.mktemp("verb")
    write_drives(base / "suspect", {"steering_lag": 0.14}, 500, SHORT)
    write_drives(base / "healthy", {}, 600, SHORT)
    (base / "suspect" / "nothing").mkdir()
    (base / "suspect" / "nothing" / "run.ncom").write_bytes(b"no packets")
    words = ["discover", base / "suspect", "--reference", base / "healthy", "--output", base / "out", "--figures",
             "png"]
    return base, CliRunner().invoke(app, [str(w) for w in words], env={"XDG_CACHE_HOME": str(base / "cache")})


def test_verb_names_the_lag_and_the_run_it_could_not_use(command):
    base, result = command
    assert result.exit_code == 1, result.output
    assert "Missing: steering lag" in result.output and "nothing" in result.output
    content = json.loads((base / "out" / "discovery.json").read_text())
    assert content["schema"] == 1 and content["outcome"] == "named"
    assert [e["name"] for e in content["effects"]] == ["steering_lag"]
    assert set(content["gap"]) >= {"velocity_y", "yaw_rate", "yaw", "position", "position_5s"}
    for entry in content["gap"].values():
        assert entry["augmented"] < entry["base"] and entry["interval"][0] <= entry["base"] - entry["augmented"]
    assert any("steering" in w["condition"] and w["excess"] > 2.0 for w in content["where"])
    about = content["provenance"]
    assert len(about["runs"]) == 2 and len(about["reference"]) == 2 and len(about["not_used"]) == 1
    files = [digest for run in (*about["runs"].values(), *about["reference"].values()) for digest in
             run["files"].values()]
    assert len(files) == 8 and all(re.fullmatch("[0-9a-f]{64}", digest) for digest in files)


def test_page_loads_nothing(command):
    base, _ = command
    text = (base / "out" / "report.html").read_text()
    assert len(text.encode()) < 5_000_000 and text.count("<figure>") >= 5 and "<script" not in text
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]+"|url\((?!#)|@import', text)
    assert "prefers-color-scheme: dark" in text and "Missing: steering lag" in text
    for name in ("gap", "conditions", "time", "paths", "candidates"):
        assert (base / "out" / "figures" / f"{name}.png").stat().st_size > 1000


def test_model_file_is_what_was_found_and_predicts_better(command):
    from st_core.model_file import ModelFile

    base, _ = command
    file = ModelFile.from_yaml((base / "out" / "model.yaml").read_text())
    lag = file.effects["steering_lag"]["time_constant"]
    low, high = lag.interval
    assert low <= 0.14 <= high and len(file.provenance.data) == 8
    file.check_vehicle(CAR, "leaf")
    words = ["evaluate", base / "suspect" / "sweep", "--model", "nonlinear", "--model", base / "out" / "model.yaml",
             "--figures", "", "--output", base / "evaluated"]
    result = CliRunner().invoke(app, [str(w) for w in words])
    assert result.exit_code == 0, result.output
    (models,) = json.loads((base / "evaluated" / "evaluation.json").read_text())["runs"].values()
    rmse = {m: modes["hindsight"]["lateral"]["rmse"] for m, modes in models.items()}
    assert rmse["augmented"] < 0.3 * rmse["nonlinear"]
