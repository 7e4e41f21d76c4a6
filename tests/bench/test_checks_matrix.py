"""A part of the corruption matrix: a few faults in a short real drive and in a virtual one; all of it is `st bench`."""

import pytest
from support import EXAMPLES

from bench.checks import score
from bench.checks.corruptions import KINDS
from bench.checks.drives import real_drive
from bench.checks.score import Drive
from bench.checks.virtual import virtual_drive

SEEN = ("gaps", "x scaled", "positions late", "yaw in other units", "yaw rate sign", "yaw rate late",
        "velocities in other units", "steering sign")


@pytest.fixture(scope="module", params=["real", "virtual"])
def drive(request):
    return Drive(real_drive(EXAMPLES / "rfs_turn_a.csv") if request.param == "real" else virtual_drive("S6", 3, 60.0))


@pytest.mark.parametrize("name", SEEN)
def test_the_fault_is_named_and_its_value_is_inside(drive, name):
    kind = KINDS[name]
    larger = kind.sizes[1]
    record = score.score_case(drive, kind, larger)
    assert record["right"], record
