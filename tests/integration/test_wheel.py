"""The offline package as a wheel in an empty virtual environment: no ROS, no checkout, no build tools."""

import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a virtual environment with only the wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, ROOT], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    (wheel,) = folder.glob("*.whl")
    # No compilation: Python compiles modules on import, and most are not imported.
    subprocess.run([*pip, "--python", folder / "venv", "install", "--no-compile", wheel, "-c",
                    ROOT / "requirements.txt"], check=True)
    return folder


def run(bare: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs `st` of the wheel in an empty folder and an environment without the checkout."""
    work = bare / "work"
    work.mkdir(exist_ok=True)
    return subprocess.run([bare / "venv/bin/st", *arguments], cwd=work, capture_output=True, text=True, check=False,
                          env={"PATH": "/usr/bin:/bin", "HOME": str(bare)})


def test_recording_is_checked_and_evaluated(bare: Path) -> None:
    drive = next((bare / "venv").rglob("share/examples/data/rfs_turn_a.csv"))
    checked = run(bare, "check", str(drive), "--car", "hyundai_genesis", "--output", "check")
    assert checked.returncode == 0, checked.stderr
    assert "heading_misaligned" in checked.stdout
    evaluated = run(bare, "evaluate", str(drive), "--car", "hyundai_genesis", "--output", "evaluate")
    assert evaluated.returncode == 0, evaluated.stderr
    assert (bare / "work/evaluate/report.html").stat().st_size > 100_000


def test_car_folder_is_written_and_effects_are_listed(bare: Path) -> None:
    created = run(bare, "car", "new", "own_car")
    assert created.returncode == 0, created.stderr
    assert (bare / "work/own_car/vehicle.yaml").exists()
    assert "steering_ratio" in run(bare, "effects").stdout


def test_command_that_needs_ros_refers_to_the_checkout(bare: Path) -> None:
    live = run(bare, "live")
    assert live.returncode == 2
    assert "part of a checkout (./st), not of the offline package" in live.stderr
