"""Range and rate checks of a signal, and when it is withheld."""

import math

import pytest
from canedge_bridge.plausibility import Plausibility
from canedge_bridge.signals import load_table

STEP = 10_000_000


@pytest.fixture
def plausibility(dbc_file, signals_file):
    message, signal = load_table(dbc_file, signals_file).find_source("steering_wheel_angle")
    return Plausibility(signal, message)


def judge(plausibility, degrees, step=STEP):
    return [plausibility.accepts(math.radians(d), i * step) for i, d in enumerate(degrees)]


def test_range(plausibility):
    assert judge(plausibility, [900, 901, 900]) == [True, False, True]


def test_rate(plausibility):
    # 2000 deg/s is 20 deg per frame; a jump is judged against the frame before it.
    assert judge(plausibility, [0, 19, 39.5, 39.5, 14]) == [True, True, False, True, False]


@pytest.mark.parametrize("bad", [[500], [1000], [1000] * 100, [500, -500]])
def test_only_the_bad_frames_are_refused(plausibility, bad):
    assert judge(plausibility, [0, 0, *bad, *[0] * 10]) == [True] * 2 + [False] * len(bad) + [True] * 10
    assert plausibility.fault == ""


def test_a_step_within_the_range_costs_one_frame(plausibility):
    assert judge(plausibility, [0, 0, *[500] * 50, *[0] * 50]) == [True] * 2 + ([False] + [True] * 49) * 2


def test_frames_that_arrive_together_may_differ_as_much_as_when_they_were_sent(plausibility):
    assert judge(plausibility, [0, 15, 30], step=1000) == [True, True, True]


def test_after_a_gap_any_angle_is_possible(plausibility):
    assert judge(plausibility, [0, 500], step=300_000_000) == [True, True]


def test_stray_frames_do_not_condemn_a_signal(plausibility):
    verdicts = judge(plausibility, [0, 0, 0, 0, 1000, 0, 0, 0, 0, 1000, 0, 0])
    assert verdicts.count(False) == 2 and plausibility.fault == ""


def test_nonsense_and_its_end(plausibility):
    judge(plausibility, [0, 1000] * 20)
    assert "decodes to implausible values: 20 of the last 40 frames" in plausibility.fault
    judge(plausibility, [0.0] * 100)
    assert plausibility.fault == ""
