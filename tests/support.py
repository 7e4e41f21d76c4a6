"""What several tests share: where the reference data lie, and free ports and ROS domains."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def shared(relative: str) -> Path:
    """A path inside the reference data beside the checkout (or in $ST_SHARED); skips the test where there are none."""
    base = Path(os.environ.get("ST_SHARED", ROOT.parent / "shared"))
    path = base / relative
    if not path.exists():
        folder = relative.partition("/")[0]
        pytest.skip(f"reference data not found: {path} (set ST_SHARED to the folder that holds {folder}/)")
    return path
