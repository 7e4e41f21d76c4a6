"""Steering and stiffness tracked while driving: found with their spread, only after enough driving, and reset."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.identification.moments import Moments
from st_core.identification.recursive import NAMES, RecursiveIdentifier
from st_core.types import InsSample
from winding_road import Truth, winding_road

TRUTH = Truth(math.radians(-4.0), 16.6, 0.85)


def moments_of(times_ns, rows, car):
    """Of a whole drive; rows: v_x, v_y, r at the INS point, hand wheel."""
    moments = Moments(car)
    for time, (v_x, v_y, r, hand) in zip(times_ns.tolist(), rows.tolist(), strict=True):
        moments.add_ins(InsSample(time, math.nan, math.nan, math.nan, v_x, v_y, r))
        moments.add_steering(time, hand)
        yield from moments.take()


def track(car, rows, tracker=None):
    tracker = tracker or RecursiveIdentifier(car)
    for moment in moments_of(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 4:8], car):
        tracker.add(moment)
    return tracker


@pytest.fixture(scope="module")
def drive(leaf):
    return winding_road(leaf, TRUTH, 100.0, seed=1)


def test_all_three_are_found_with_their_spread(leaf, drive):
    found = dict(zip(NAMES, track(leaf, drive).tracked(), strict=True))
    for name, truth in zip(NAMES, (TRUTH.offset, TRUTH.ratio, TRUTH.scale), strict=True):
        assert found[name].status == "estimated" and found[name].reason == ""
        assert abs(found[name].value - truth) < 2.0 * found[name].spread
    assert abs(found["steering_wheel_offset"].value - TRUTH.offset) < math.radians(0.1)
    assert found["steering_ratio"].value == pytest.approx(TRUTH.ratio, rel=0.01)
    assert found["stiffness_scale"].value == pytest.approx(TRUTH.scale, rel=0.02)


@pytest.mark.slow
def test_other_cars_on_other_roads(leaf):
    random = np.random.default_rng(5)
    for seed in range(4):
        truth = Truth(math.radians(random.uniform(-6, 6)), 17.3 * random.uniform(0.93, 1.07),
                      random.uniform(0.75, 1.25))
        found = track(leaf, winding_road(leaf, truth, 90.0, seed)).tracked()
        for one, value in zip(found, (truth.offset, truth.ratio, truth.scale), strict=True):
            assert one.status == "estimated" and abs(one.value - value) < 2.0 * one.spread, (seed, one)


def test_a_misaligned_ins_disturbs_none_of_them(leaf, drive):
    turned = drive.copy()
    turned[:, 5] += math.radians(0.5) * turned[:, 4]
    for one, other in zip(track(leaf, drive).tracked(), track(leaf, turned).tracked(), strict=True):
        assert other.value == pytest.approx(one.value, abs=0.2 * one.spread)


def test_nothing_counts_before_enough_driving(leaf, drive):
    start = track(leaf, drive[:300]).tracked()  # 3 s
    assert {one.status for one in start} == {"unestimated"}
    assert start[0].reason.startswith("3 of 10 s driving")
    assert track(leaf, drive[:0]).tracked()[2].reason.startswith("0 of 3 s left bends above 1.5 m/s^2; 0 of 3 s right")


def test_a_circle_tells_no_ratio_and_no_scale(leaf):
    time = 0.01 * np.arange(6000)
    rate = 8.0 / 30.0
    rows = np.stack([time, time, time, time, 8.0 + 0 * time, rate * leaf.cg_to_ins_x + 0.2 + 0 * time, rate + 0 * time,
                     1.6 + 0 * time], axis=1)
    offset, ratio, scale = track(leaf, rows).tracked()
    assert "0 of 5 s right bends" in ratio.reason and "1 of 2 speeds" in scale.reason
    assert (offset.status, ratio.status, scale.status) == ("unestimated",) * 3


def test_slow_and_hard_driving_is_left_out_and_counted(leaf, drive):
    slow, hard = drive.copy(), drive.copy()
    slow[:, 4:7] *= 0.2
    hard[:, 5:7] *= 2.5
    tracker = track(leaf, slow)
    assert tracker.seconds.used == 0.0 and tracker.seconds.rejected["too slow"] == pytest.approx(99.6, abs=0.3)
    assert track(leaf, hard).seconds.rejected["a_y"] > 10.0


def test_values_no_car_has_are_invalid(leaf, drive):
    broken = drive.copy()
    broken[:, 7] *= 0.5  # a sensor that counts half degrees
    assert track(leaf, broken).tracked()[1].status == "invalid"
    noise = drive.copy()
    noise[:, 6] += 0.15 * np.sin(np.arange(len(drive)) / 30.0)  # a yaw rate that is not this car's
    reasons = [one.reason for one in track(leaf, noise).tracked()]
    assert all("times as large as assumed" in reason for reason in reasons)


def test_reset_forgets_everything(leaf, drive):
    tracker = track(leaf, drive)
    other = replace(leaf, steering_ratio=15.0)
    tracker.reset(other)
    fresh = RecursiveIdentifier(other)
    assert tracker.tracked() == fresh.tracked() and tracker.seconds == fresh.seconds
    assert tracker.tracked()[1].value == 15.0


def test_moments_are_central_averages_and_never_cross_a_gap(leaf):
    """Signals that are straight lines in time: every average and derivative is exact."""
    time = np.arange(0, 2_000_000_000, 10_000_000)
    t = time * 1e-9
    rows = np.stack([10.0 + t, 0.1 * t, 0.2 * t, -0.5 * t], axis=1)
    found = list(moments_of(time, rows, leaf))
    assert len(found) == 18  # twenty tenths of a second, one on either side for the derivative
    for k, m in enumerate(found):
        middle = 0.1 * (k + 1) + 0.04
        arm = -leaf.cg_to_ins_x * 0.2
        assert m[:3] == pytest.approx((10.0 + middle, (0.1 + arm) * middle, 0.2 * middle))
        assert m[3:8] == pytest.approx((1.0, 0.1 + arm, 0.2, -0.5 * middle, -0.5))
    gap = (time < 900_000_000) | (time > 1_100_000_000)
    assert len(list(moments_of(time[gap], rows[gap], leaf))) == 7 + 6  # nothing from before and after is mixed


def test_late_steering_and_a_jump_of_time(leaf):
    moments = Moments(leaf)
    for k in range(100):
        moments.add_ins(InsSample(k * 10_000_000, 0.0, 0.0, 0.0, 10.0, 0.0, 0.1))
    assert list(moments.take()) == []  # nothing is known about the hand wheel yet
    for k in range(100):
        moments.add_steering(k * 10_000_000, 0.5)
    assert len(list(moments.take())) == 8
    zero = -3_600_000_000_000
    for k in range(100):
        moments.add_ins(InsSample(zero + k * 10_000_000, 0.0, 0.0, 0.0, 10.0, 0.0, 0.1))
        moments.add_steering(zero + k * 10_000_000, 0.5)
    assert len(list(moments.take())) in (7, 8)  # the first samples after a jump are the proof of it
