"""Hops of a prediction: each between its own stamps, and together the whole way."""

import numpy as np
import pytest

from bench._hops import COMPUTE, HOPS, Made, Stream, hops, marks

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
WAY = [name for name in HOPS if not name.startswith(("CAN", "all"))]


def stream(period: int, first: int, late: int, decode: int, transport: int) -> Stream:
    """Samples `late` in the kernel, `decode` later written, `transport` later heard [ms]."""
    stamp = T0 + (np.arange(300) * period + first) * MS
    return Stream(stamp, stamp + late * MS, stamp + (late + decode) * MS, stamp + (late + decode + transport) * MS)


def predictions(begun: int) -> list[Made]:
    """Three models of 1, 2 and 3 ms, each issued when it is done, written 1 ms and heard 3 ms later."""
    return [Made(issued, issued + MS, issued + 3 * MS, compute)
            for issued, compute in ((begun + 1 * MS, 1 * MS), (begun + 3 * MS, 2 * MS), (begun + 6 * MS, 3 * MS))]


def test_the_hops_of_the_later_input_add_up_to_the_whole_way():
    ins, steering = stream(10, 0, 4, 2, 1), stream(10, 1, 0, 1, 1)
    start = T0 + 1500 * MS
    begun = start + 9 * MS
    tick = marks(start, ins, steering, predictions(begun))
    rows = {name: row["p50"] for name, row in hops([tick]).items()}
    assert rows["INS: kernel -> odometry written"] == pytest.approx(2)
    assert rows["INS: odometry written -> heard"] == pytest.approx(1)
    assert rows["CAN: kernel -> steering written"] == rows["CAN: steering written -> heard"] == pytest.approx(1)
    assert rows["both heard -> first model begins"] == pytest.approx(2)
    assert rows[COMPUTE] == rows["first model begins -> last prediction issued"] == pytest.approx(6)
    assert rows["last prediction issued -> written"] == pytest.approx(1)
    assert rows["last prediction written -> heard"] == pytest.approx(2)
    assert sum(rows[name] for name in WAY) == pytest.approx(
        rows["all: both in the kernel -> last prediction heard"])


def test_the_samples_of_a_tick_are_the_first_at_or_after_its_start():
    ins, steering = stream(10, 0, 0, 1, 1), stream(20, 5, 0, 1, 1)
    tick = marks(T0 + 2030 * MS, ins, steering, predictions(T0 + 2060 * MS))
    assert tick["packet"] == T0 + 2030 * MS and tick["frame"] == T0 + 2045 * MS
    assert tick["known"] == tick["frame"] and tick["complete"] == T0 + 2047 * MS


@pytest.mark.parametrize("start", [2991, 500], ids=["after the last sample", "before the listener had settled"])
def test_a_tick_whose_samples_were_not_heard_is_none(start):
    ins, steering = stream(10, 0, 0, 1, 1), stream(10, 0, 0, 1, 1)
    assert marks(T0 + 2000 * MS, ins, steering, predictions(T0)) is not None
    assert marks(T0 + start * MS, ins, steering, predictions(T0)) is None
