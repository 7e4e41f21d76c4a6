"""What several tests share: where the reference data lie, and free ports and ROS domains."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "tests" / "golden" / "data"
EXAMPLES = ROOT / "examples" / "data"
SETS = ("kept", "whole")


def shared(relative: str) -> Path:
    """A path inside the reference data beside the checkout (or in $ST_SHARED); skips the test where there are none."""
    base = Path(os.environ.get("ST_SHARED", ROOT.parent / "shared"))
    path = base / relative
    if not path.exists():
        folder = relative.partition("/")[0]
        pytest.skip(f"reference data not found: {path} (set ST_SHARED to the folder that holds {folder}/)")
    return path


def vectors(which: str, relative: str) -> Path:
    """A path inside the NCOM and CAN vectors: the part "kept" in tests/golden/data, or the "whole" set by `shared`."""
    return KEPT / relative if which == "kept" else shared(f"vectors/{relative}")
