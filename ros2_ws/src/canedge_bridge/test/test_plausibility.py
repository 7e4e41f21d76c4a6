"""Range and rate checks of a signal."""

import math

import pytest
from canedge_bridge.plausibility import Plausibility
from canedge_bridge.signals import load_table

STEP = 10_000_000  # [ns]


@pytest.fixture
def plausibility(dbc_file, signals_file):
    message, signal = load_table(dbc_file, signals_file).find_steering()
    return Plausibility(signal, message)


def check_angles(plausibility, degrees, step=STEP):
    """Whether each angle is accepted. step: between frames [ns]."""
    return [plausibility.accepts(math.radians(d), i * step) for i, d in enumerate(degrees)]


def test_angle_outside_the_range_is_rejected(plausibility):
    assert check_angles(plausibility, [900, 901, 900]) == [True, False, True]


def test_angle_above_the_maximum_rate_is_rejected(plausibility):
    # 2000 deg/s is 20 deg per frame, relative to the previous frame.
    assert check_angles(plausibility, [0, 19, 39.5, 39.5, 14]) == [True, True, False, True, False]


@pytest.mark.parametrize("implausible", [[500], [1000], [1000] * 100, [500, -500]])
def test_only_implausible_frames_are_rejected(plausibility, implausible):
    expected = [True] * 2 + [False] * len(implausible) + [True] * 10
    assert check_angles(plausibility, [0, 0, *implausible, *[0] * 10]) == expected
    assert plausibility.fault == ""


def test_step_within_the_range_rejects_one_frame(plausibility):
    assert check_angles(plausibility, [0, 0, *[500] * 50, *[0] * 50]) == [True] * 2 + ([False] + [True] * 49) * 2


def test_rate_of_frames_received_together_is_that_of_their_period(plausibility):
    assert check_angles(plausibility, [0, 15, 30], step=1000) == [True, True, True]


def test_any_angle_is_accepted_after_a_gap(plausibility):
    assert check_angles(plausibility, [0, 500], step=300_000_000) == [True, True]


def test_single_implausible_frames_are_not_a_fault(plausibility):
    accepted = check_angles(plausibility, [0, 0, 0, 0, 1000, 0, 0, 0, 0, 1000, 0, 0])
    assert accepted.count(False) == 2 and plausibility.fault == ""


def test_many_implausible_frames_are_a_fault_until_plausible_ones_follow(plausibility):
    check_angles(plausibility, [0, 1000] * 20)
    assert "decodes to implausible values in 20 of the last 40 frames" in plausibility.fault
    check_angles(plausibility, [0.0] * 100)
    assert plausibility.fault == ""
