"""Paths of the project and of the reference data, and the vehicle files, shared by the tests."""

import os
from pathlib import Path

import pytest
from st_core.vehicle import VehicleParameters

ROOT = Path(__file__).resolve().parents[1]
GOLDEN_DATA = ROOT / "tests" / "golden" / "data"
LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
EXAMPLES = ROOT / "examples" / "data"
SETS = ("excerpt", "complete")


def read_car(name: str) -> VehicleParameters:
    path = ROOT / "config" / "vehicle" / f"{name}.yaml"
    return VehicleParameters.from_yaml(path.read_text(), str(path))


def shared(relative: str) -> Path:
    """A path in the reference data next to the checkout or in $ST_SHARED; skips the test if it does not exist."""
    base = Path(os.environ.get("ST_SHARED", ROOT.parent / "shared"))
    path = base / relative
    if not path.exists():
        folder = relative.partition("/")[0]
        pytest.skip(f"reference data not found: {path} (set ST_SHARED to the folder that contains {folder}/)")
    return path


def vectors(which: str, relative: str) -> Path:
    """A path in the NCOM and CAN vectors. which: "excerpt" in tests/golden/data, "complete" in the reference data."""
    return GOLDEN_DATA / relative if which == "excerpt" else shared(f"vectors/{relative}")
