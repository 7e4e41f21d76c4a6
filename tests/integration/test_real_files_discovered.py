"""st discover on files as a user has them: real drives as they are and edited, and drives of the base model itself.

What is known here is the edit: a value must move by just that, and a fault that begins in the middle is no constant.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from discovery_drives import recorded
from raw_drives import LEAF
from st_cli.cli import app
from st_core.discovery import DiscoverySettings, discover
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_offline.discovery.discover_command import sensor_estimates
from st_offline.discovery.drives import read_drives
from st_recordings.runs import ReadSettings, find_runs
from support import ROOT, shared
from typer.testing import CliRunner

pytestmark = pytest.mark.slow
GENESIS = ROOT / "config" / "vehicle" / "hyundai_genesis.yaml"
RUNS = ("cpg_lap_medium", "cpg_lap_slow", "cpg_low_speed_a", "rfs_turn_a")
SETTINGS = DiscoverySettings(where=False, windows=160)
SCALED, OFFSET = 0.9, 0.02  # of the steering; rad at the road wheels
Row = dict[str, str]


def written(folder: Path, edit: Callable[[Row, float], None]) -> list[Path]:
    """The drives with each row edited. edit(row, share of the run that has passed)."""
    files = []
    for name in RUNS:
        with shared(f"data/hyundai_genesis_oxts/{name}.csv").open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        for number, row in enumerate(rows):
            edit(row, number / len(rows))
        files.append(folder / f"{name}.csv")
        with files[-1].open("w", newline="") as out:
            writer = csv.DictWriter(out, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    return files


def discovered(files: list[Path]) -> dict[str, Any]:
    """The content of discovery.json, with fewer predictions than the command makes."""
    car = VehicleParameters.from_yaml(GENESIS.read_text(), str(GENESIS))
    drives = read_drives(find_runs(files), car, ReadSettings(), 1, lambda: None)
    assert not [d.problem for d in drives if d.problem]
    return discover([d.log for d in drives if d.log is not None], car, settings=SETTINGS,
                    sensor_estimates=sensor_estimates(drives)).document()


def stated(content: dict[str, Any], effect: str, parameter: str) -> dict[str, Any]:
    (found,) = [e for e in content["effects"] if e["name"] == effect]
    return found["parameters"][parameter]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return discovered(written(tmp_path_factory.mktemp("plain"), lambda row, share: None))


def test_steering_that_was_scaled_moves_the_ratio_by_just_that(plain, tmp_path):
    def scaled(row: Row, share: float) -> None:
        row["delta"] = str(SCALED * float(row["delta"]))

    content = discovered(written(tmp_path, scaled))
    before, after = (stated(c, "steering_ratio", "factor") for c in (plain, content))
    low, high = after["interval"]
    assert low <= SCALED * before["value"] <= high < before["value"]
    for effect in ("heading_misalignment", "lateral_acceleration_bias"):
        for parameter in plain_parameters(plain, effect):
            a, b = (stated(c, effect, parameter) for c in (plain, content))
            assert a["interval"][0] <= b["value"] <= a["interval"][1]


def plain_parameters(content: dict[str, Any], effect: str) -> list[str]:
    (found,) = [e for e in content["effects"] if e["name"] == effect]
    return list(found["parameters"])


def test_offset_that_begins_in_the_middle_is_told_and_not_named(plain, tmp_path):
    def begun(row: Row, share: float) -> None:
        row["delta"] = str(float(row["delta"]) + OFFSET * (share > 0.5))

    content = discovered(written(tmp_path, begun))
    assert "steering_offset" not in {e["name"] for e in content["effects"]}
    (varying,) = [b for b in content["varying"] if b["resembles"] == "steering_offset"]
    shares = {value["where"]: value["ratio"] for value in varying["values"]}
    # Four runs are divided into halves: the offset is in the second ones.
    halves = [[shares.get(f"{run}, part {k}") for k in (1, 2)] for run in RUNS]
    both = [pair for pair in halves if None not in pair]
    assert len(both) >= 2 and all(second > first + 0.5 for first, second in both), shares


def test_base_model_itself_lacks_nothing(tmp_path):
    car = VehicleParameters.from_yaml(LEAF.read_text())
    files = [as_csv(log, tmp_path / f"{log.name.replace(' ', '_')}.csv") for log in recorded(car, {}, 3)]
    out = tmp_path / "out"
    words = ["discover", *files, "--vehicle", LEAF, "--output", out, "--no-report", "--fresh"]
    result = CliRunner().invoke(app, [str(w) for w in words], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    content = json.loads((out / "discovery.json").read_text())
    assert content["outcome"] in ("none", "not_testable") and not content["effects"] and not content["varying"]
    assert not (out / "model.yaml").exists() and not (out / "vehicle.yaml").exists()


def as_csv(log: DriveLog, file: Path) -> Path:
    columns = {"t": (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9, "x": log.x, "y": log.y, "yaw": log.yaw,
               "vx": log.velocity_x, "vy": log.velocity_y, "yaw_rate": log.yaw_rate, "ay": log.acceleration_y,
               "delta": log.road_wheel_angle}
    with file.open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return file
