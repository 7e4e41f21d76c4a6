"""st discover on CSV files: real drives, unchanged and edited, and drives of the base model.

The known quantity is the edit: a parameter must change by its size, and a fault that starts in the middle of the runs
must not be identified as constant.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from discovery_drives import recorded
from st_cli.cli import app
from st_core.discovery import DiscoverySettings, discover
from st_core.log import DriveLog
from st_offline.discovery.drives import pool_sensor_estimates, read_drives
from st_recordings.runs import ReadSettings, find_runs
from support import LEAF, read_car, shared
from typer.testing import CliRunner

pytestmark = pytest.mark.slow
RUNS = ("cpg_lap_medium", "cpg_lap_slow", "cpg_low_speed_a", "rfs_turn_a")
SETTINGS = DiscoverySettings(locate_errors=False, windows=160)
SCALE, OFFSET = 0.9, 0.02  # of the steering [1]; of the road wheel angle [rad]
Row = dict[str, str]


def write_edited(folder: Path, edit: Callable[[Row, float], None]) -> list[Path]:
    """Writes the drives with each row edited in place. edit(row, elapsed share of the run)."""
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


def discover_in_files(files: list[Path]) -> dict[str, Any]:
    """The content of discovery.json, from fewer predictions than the command uses."""
    car = read_car("hyundai_genesis")
    drives = read_drives(find_runs(files), car, ReadSettings(), 1, lambda: None)
    assert not [d.problem for d in drives if d.problem]
    return discover([d.log for d in drives if d.log is not None], car, settings=SETTINGS,
                    sensor_estimates=pool_sensor_estimates(drives)).document()


def parameters_of(content: dict[str, Any], effect: str) -> dict[str, dict[str, Any]]:
    (found,) = [e for e in content["effects"] if e["name"] == effect]
    return found["parameters"]


@pytest.fixture(scope="module")
def unedited(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return discover_in_files(write_edited(tmp_path_factory.mktemp("unedited"), lambda row, share: None))


def test_scaled_steering_changes_only_the_steering_ratio(unedited, tmp_path):
    def scale(row: Row, share: float) -> None:
        row["delta"] = str(SCALE * float(row["delta"]))

    content = discover_in_files(write_edited(tmp_path, scale))
    before, after = (parameters_of(c, "steering_ratio")["factor"] for c in (unedited, content))
    low, high = after["interval"]
    assert low <= SCALE * before["value"] <= high < before["value"]
    for effect in ("heading_misalignment", "lateral_acceleration_bias"):
        for name, expected in parameters_of(unedited, effect).items():
            low, high = expected["interval"]
            assert low <= parameters_of(content, effect)[name]["value"] <= high


def test_offset_that_starts_in_the_middle_of_runs_is_reported_as_varying(tmp_path):
    def add_offset(row: Row, share: float) -> None:
        row["delta"] = str(float(row["delta"]) + OFFSET * (share > 0.5))

    content = discover_in_files(write_edited(tmp_path, add_offset))
    assert "steering_offset" not in {e["name"] for e in content["effects"]}
    (varying,) = [b for b in content["varying"] if b["resembles"] == "steering_offset"]
    shares = {value["subset"]: value["ratio"] for value in varying["values"]}
    # The four runs are divided into halves; the offset is in the second ones.
    halves = [[shares.get(f"{run}, part {k}") for k in (1, 2)] for run in RUNS]
    both = [pair for pair in halves if None not in pair]
    assert len(both) >= 2 and all(second > first + 0.5 for first, second in both), shares


def test_no_effect_is_found_in_drives_of_the_base_model(tmp_path):
    car = read_car("leaf")
    files = [write_csv(log, tmp_path / f"{log.name.replace(' ', '_')}.csv") for log in recorded(car, {}, 3)]
    out = tmp_path / "out"
    words = ["discover", *files, "--vehicle", LEAF, "--output", out, "--no-report", "--fresh"]
    result = CliRunner().invoke(app, [str(w) for w in words], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    content = json.loads((out / "discovery.json").read_text())
    assert content["outcome"] in ("none", "not_testable") and not content["effects"] and not content["varying"]
    assert not (out / "model.yaml").exists() and not (out / "vehicle.yaml").exists()


def write_csv(log: DriveLog, file: Path) -> Path:
    columns = {"t": (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9, "x": log.x, "y": log.y, "yaw": log.yaw,
               "vx": log.velocity_x, "vy": log.velocity_y, "yaw_rate": log.yaw_rate, "ay": log.acceleration_y,
               "delta": log.road_wheel_angle}
    with file.open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return file
