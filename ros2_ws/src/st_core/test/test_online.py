"""Online identification of steering and stiffness: accuracy, required driving, plausibility, reset."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from driven import Sensors, drive
from st_core.augmented import augment
from st_core.identification.online import NAMES, OnlineIdentifier, fit_recent
from st_core.types import InsSample
from winding_road import Truth, winding_road

TRUTH = Truth(math.radians(-4.0), 16.6, 0.85)


def track(car, rows, tracker=None):
    """rows: (t, x, y, yaw, v_x, v_y, yaw rate, steering wheel) at the INS point, SI."""
    tracker = tracker or OnlineIdentifier(car)
    for row in rows:
        time = round(row[0] * 1e9) + 1
        tracker.add_steering(time, row[7])
        tracker.add_ins(InsSample(time, *row[1:7]))
        if tracker.is_fit_due:
            tracker.fit = fit_recent(*tracker.take_snapshot())
    return tracker


def to_rows(logs):
    """Rows of consecutive drives, INS and steering at the same instants."""
    parts, end = [], 0.0
    for log in logs:
        t = (log.ins_time_ns - log.start_ns) * 1e-9
        parts.append(np.stack([t + end, log.x, log.y, log.yaw, log.velocity_x, log.velocity_y, log.yaw_rate,
                               log.steering_wheel_angle], axis=1))
        end += t[-1] + 1.0
    return np.concatenate(parts).tolist()


@pytest.fixture(scope="module")
def road(leaf):
    return winding_road(leaf, TRUTH, 100.0, seed=1).tolist()


@pytest.fixture(scope="module")
def tracked(leaf, road):
    return track(leaf, road)


@pytest.mark.slow
def test_estimates_lie_within_two_standard_deviations(tracked):
    for estimate, truth in zip(tracked.make_estimates(), (TRUTH.offset, TRUTH.ratio, TRUTH.scale), strict=True):
        assert estimate.status == "estimated" and estimate.reason == ""
        assert abs(estimate.value - truth) < 2.0 * estimate.deviation, estimate


@pytest.mark.slow
def test_estimates_of_other_cars_on_other_roads(leaf):
    random = np.random.default_rng(5)
    for seed in range(3):
        truth = Truth(math.radians(random.uniform(-6, 6)), 17.3 * random.uniform(0.93, 1.07),
                      random.uniform(0.75, 1.25))
        found = track(leaf, winding_road(leaf, truth, 90.0, seed).tolist()).make_estimates()
        for estimate, value in zip(found, (truth.offset, truth.ratio, truth.scale), strict=True):
            assert estimate.status == "estimated", (seed, estimate)
            assert abs(estimate.value - value) < 2.0 * estimate.deviation, (seed, estimate)


def record_lagging_slalom(leaf, speeds):
    """Rows of a car with 0.04 s steering lag, tyre relaxation and 20 % more front stiffness."""
    car = replace(leaf, cornering_stiffness_front=1.2 * leaf.cornering_stiffness_front).with_derived_scales()
    model = augment("nonlinear", {"tyre_relaxation": {"length": 0.4}})
    return to_rows([drive(car, speed, lambda t, a=angle: a * np.sin(2.5 * t), 50.0, model=model,
                          sensors=Sensors(delay=0.04), seed=2) for speed, angle in speeds])


def test_slalom_at_one_speed_does_not_determine_the_ratio(leaf):
    ratio = track(leaf, record_lagging_slalom(leaf, [(12.0, 0.045)])).make_estimates()[1]
    assert ratio.status == "unestimated" and "1 of 2 speed ranges" in ratio.reason


def test_slalom_at_two_speeds_gives_the_true_ratio_despite_lag(leaf):
    ratio = track(leaf, record_lagging_slalom(leaf, [(8.0, 0.08), (14.5, 0.035)])).make_estimates()[1]
    assert ratio.status == "estimated" and abs(ratio.value - leaf.steering_ratio) < 2.0 * ratio.deviation


def test_no_estimate_before_enough_driving(leaf, road):
    estimates = track(leaf, road[:300]).make_estimates()  # 3 s
    assert {estimate.status for estimate in estimates} == {"unestimated"}
    assert estimates[0].reason.startswith("3 of 10 s of driving")
    stiffness = track(leaf, []).make_estimates()[2]
    assert stiffness.reason.startswith("0 of 3 s of left bends above 1.5 m/s^2; 0 of 3 s of right")


def test_slow_and_hard_driving_is_rejected_and_counted(leaf, road):
    slow, hard = np.array(road), np.array(road)
    slow[:, 4:7] *= 0.2
    hard[:, 5:7] *= 2.5
    tracker = track(leaf, slow.tolist())
    driving_time = tracker.driving_time
    assert driving_time.used == 0.0 and driving_time.rejected["too slow"] == pytest.approx(100.0, abs=0.3)
    assert track(leaf, hard[:3000].tolist()).driving_time.rejected["lateral acceleration too high"] > 3.0


@pytest.mark.slow
def test_implausible_values_are_not_estimated(leaf, road):
    half_angle = np.array(road)
    half_angle[:, 7] *= 0.5  # steering wheel angle with half the scale
    assert track(leaf, half_angle.tolist()).make_estimates()[1].status == "invalid"
    noise = np.array(road)
    noise[:, 6] += 0.15 * np.sin(np.arange(len(noise)) / 30.0)  # rad/s, unrelated to the steering
    assert "estimated" not in {estimate.status for estimate in track(leaf, noise.tolist()).make_estimates()[1:]}


def test_reset_and_backward_time_jump_discard_everything(leaf, tracked):
    other = replace(leaf, steering_ratio=15.0)
    fresh = OnlineIdentifier(other)
    reset = deepcopy(tracked)
    reset.reset(other)
    assert reset.make_estimates() == fresh.make_estimates() and reset.driving_time == fresh.driving_time
    assert dict(zip(NAMES, reset.make_estimates(), strict=True))["steering_ratio"].value == 15.0
    tracker = track(leaf, [[10.0 + 0.01 * k, 0.1 * k, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0] for k in range(100)])
    assert tracker.driving_time.used == pytest.approx(0.99, abs=0.02)
    assert not tracker.add_ins(InsSample(1, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0)) and tracker.driving_time.used == 0.0


def test_non_finite_and_old_samples_are_rejected(leaf):
    tracker = OnlineIdentifier(leaf)
    assert tracker.add_ins(InsSample(1000, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0))
    assert not tracker.add_ins(InsSample(1000, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0))
    assert not tracker.add_ins(InsSample(2000, math.nan, 0.0, 0.0, 10.0, 0.0, 0.0))
    assert tracker.add_steering(1000, 0.1) and not tracker.add_steering(1000, 0.1)
    assert not tracker.add_steering(2000, math.inf)
