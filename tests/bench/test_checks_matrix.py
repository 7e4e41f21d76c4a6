"""A part of the corruption matrix: a few faults in a short real drive and in a virtual one; all of it is `st bench`."""

import json

import pytest
from support import EXAMPLES

from bench.checks import score, tables
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
    record = score.score(drive, kind, larger)
    assert record["right"], record


def test_a_drive_that_cannot_show_it_is_no_case(drive):
    assert score.score(drive, KINDS["velocity at standstill"], KINDS["velocity at standstill"].sizes[0]) is None


def test_records_become_a_table(drive):
    kind = KINDS["yaw rate sign"]
    records = [score.score(drive, kind, size) for size in kind.sizes]
    document = json.loads(json.dumps({"set": "development", "version": "1", "date": "today", **tables.scores(records)}))
    assert document["total"][-1]["cases"] == 2
    assert "| yaw rate sign | 2 | 2 | 0 | 2 | 2 |" in tables.as_markdown(document)
    assert tables.failure(records[0]).startswith(f"{records[0]['drive']}: yaw rate sign whole drive, true ")
