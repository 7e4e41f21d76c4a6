"""A part of the corruption matrix of `st bench`: some faults in a short real drive and in a virtual one."""

import pytest
from support import EXAMPLES

from bench.checks import score
from bench.checks.corruptions import FAULTS
from bench.checks.drives import real_drive, virtual_drive
from bench.checks.score import Drive

NAMES = ("gaps", "x scaled", "positions late", "yaw in other units", "yaw rate sign", "yaw rate late",
         "velocities in other units", "steering sign")


@pytest.fixture(scope="module", params=["real", "virtual"])
def drive(request):
    return Drive(real_drive(EXAMPLES / "rfs_turn_a.csv") if request.param == "real" else virtual_drive("S6", 3, 60.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_fault_is_identified_and_its_interval_contains_the_true_size(drive, name):
    fault = FAULTS[name]
    record = score.score_case(drive, fault, fault.sizes[1])
    assert record["right"], record
