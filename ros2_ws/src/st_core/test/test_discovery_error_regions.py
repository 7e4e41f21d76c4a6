"""Conditions with large prediction errors: on synthetic errors, and on a drive with a known missing effect."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.discovery.error_regions import (
    CELL_SIZE,
    Samples,
    assign_ranges,
    compute_excesses,
    compute_log_residuals,
    describe_range,
    find_cells,
    find_error_regions,
    find_segments,
)
from st_core.log import DriveLog
from st_core.prediction import predict
from st_core.types import InputSequence, VehicleState

NOISE = {"yaw_rate": 0.01}
PLAIN = {"speed": 10.0, "lateral_acceleration": 1.0, "road_wheel_angle": 0.03, "steering_rate": 0.03,
         "forward_acceleration": 0.0}


def make_samples(seed: int, levels=None, correlation: int = 8, count: int = 800, **conditions) -> Samples:
    """Errors of 0.01 times `levels` at 4 Hz, equal over `correlation` samples; conditions are random or given."""
    rng = np.random.default_rng(seed)
    time = 0.25 * np.arange(count)
    errors = np.repeat(rng.normal(size=count // correlation + 1), correlation)[:count]
    values = {"speed": np.repeat(rng.uniform(5.0, 20.0, count // 20 + 1), 20)[:count],
             "lateral_acceleration": np.repeat(rng.uniform(-4.0, 4.0, count // 16 + 1), 16)[:count],
             "road_wheel_angle": np.full(count, 0.03), "steering_rate": np.full(count, 0.03),
             "forward_acceleration": np.zeros(count)}
    values |= {name: np.broadcast_to(value, count) for name, value in conditions.items()}
    level = 0.01 * np.broadcast_to(levels(time, values) if levels else 1.0, count)
    zero = np.zeros(count)
    return Samples(("drive",), zero.astype(int), time, zero, zero, (time // 4.0).astype(int), values,
                   {"yaw_rate": np.square(level * errors)})


def find_excesses(samples: Samples, reference: Samples | None):
    return compute_excesses(samples, reference, NOISE, 0, 200)


def test_range_with_three_times_the_error_is_found_with_its_ratio():
    samples = make_samples(1, lambda time, c: np.where(c["speed"] > 12.0, 3.0, 1.0))
    by_range = {b.range.label: b for b in find_excesses(samples, make_samples(2))}
    for label in ("12 to 15 m/s", "15 to 20 m/s"):
        one = by_range[label]
        assert one.is_significant and one.interval[0] < 3.0 < one.interval[1] and 2.2 < one.excess < 4.0
    assert not by_range["6 to 9 m/s"].is_significant


def test_no_range_is_significant_if_runs_and_reference_have_equal_errors():
    alarms = []
    for seed in range(25):
        excesses = find_excesses(make_samples(seed), make_samples(1000 + seed))
        alarms.append(sum(one.is_significant for one in excesses))
    assert np.count_nonzero(alarms) <= 3  # of 25; the false discovery rate is 5 %


def test_intervals_cover_the_ratio_in_95_of_100_cases():
    covered = []
    for seed in range(60):
        whole = find_excesses(make_samples(seed, lambda time, c: 2.0), make_samples(2000 + seed))[0]
        covered.append(whole.interval[0] <= 2.0 <= whole.interval[1])
    assert 0.88 <= np.mean(covered) <= 1.0


def test_intervals_are_wider_for_correlated_errors():
    """Sixteen equal errors count as one: intervals about four times as wide."""
    def width(correlation: int, seed: int) -> float:
        whole = find_excesses(make_samples(seed, correlation=correlation),
                              make_samples(100 + seed, correlation=correlation))[0]
        return math.log(whole.interval[1] / whole.interval[0])

    wide, narrow = (np.median([width(n, seed) for seed in range(8)]) for n in (16, 1))
    assert 2.5 < wide / narrow < 5.5


def test_expected_error_without_a_reference_is_the_noise():
    one = find_excesses(make_samples(3, lambda time, c: 4.0), None)[0]
    assert one.interval[0] < 4.0 < one.interval[1]


def test_range_without_reference_data_is_marked_as_not_covered():
    by_range = {b.range.label: b for b in find_excesses(make_samples(4, speed=22.0), make_samples(5, speed=10.0))}
    assert not by_range["20 to 25 m/s"].is_covered and not by_range["20 to 25 m/s"].is_significant


def test_change_in_time_is_found_at_its_time():
    samples = make_samples(6, lambda time, c: np.where(time > 120.0, 3.0, 1.0), **PLAIN)
    (part,) = find_segments(samples, "yaw_rate", compute_log_residuals(samples, "yaw_rate", 0.001), 4.0, 0)
    assert abs(part.start - 120.0) <= 4.0 and part.end > 198.0 and part.ratio > 2.0


def test_stationary_errors_have_no_change_in_time():
    drives = [make_samples(seed, **PLAIN) for seed in range(30)]
    assert sum(bool(find_segments(s, "yaw_rate", compute_log_residuals(s, "yaw_rate", 0.001), 4.0, seed))
               for seed, s in enumerate(drives)) <= 2


def test_larger_errors_from_harder_driving_are_not_a_change_in_time():
    """The second half is driven harder; errors of hard driving are equal in both halves."""
    def lateral(time):
        return np.where((time > 100.0) ^ ((time % 40.0) < 8.0), 4.0, 0.5)

    time = 0.25 * np.arange(800)
    samples = make_samples(7, lambda time, c: np.where(lateral(time) > 1.0, 3.0, 1.0),
                   **{**PLAIN, "lateral_acceleration": lateral(time)})
    assert not find_segments(samples, "yaw_rate", compute_log_residuals(samples, "yaw_rate", 0.001), 4.0, 0)


def test_place_with_large_errors_on_every_lap_is_found():
    base = make_samples(8, correlation=1, **PLAIN)
    angle = 2 * math.pi * base.time / 20.0  # ten laps
    x, y = 60.0 * np.cos(angle), 60.0 * np.sin(angle)
    near = np.hypot(x - 60.0, y) < 15.0
    squares = {"yaw_rate": base.squares["yaw_rate"] * np.where(near, 16.0, 1.0)}
    samples = replace(base, x=x, y=y, squares=squares)
    residuals = compute_log_residuals(samples, "yaw_rate", 0.001)
    worst = max(find_cells(samples, "yaw_rate", residuals), key=lambda c: c.interval[0])
    assert math.hypot(worst.x - 60.0, worst.y) < 1.5 * CELL_SIZE and worst.ratio > 2.0 and worst.p_value < 1e-3


@pytest.mark.parametrize(("low", "high", "expected"), [
    (12.0, 15.0, "speed 12 to 15 m/s"), (25.0, None, "speed above 25 m/s"), (0.0, 3.0, "speed below 3 m/s")])
def test_text_of_a_range(low, high, expected):
    assert describe_range("speed", low, high) == expected


def test_every_prediction_is_in_one_range_of_each_quantity():
    ranges = assign_ranges(make_samples(9))
    for quantity in {r.quantity for r in ranges}:
        assert (sum(r.mask.astype(int) for r in ranges if r.quantity == quantity) == 1).all()


def weave(leaf, model, name: str, seed: int) -> DriveLog:
    """A minute simulated with a model: straight for 20 s, then weaving; with sensor noise."""
    time = np.arange(0.0, 60.0001, 0.01)
    angle = np.where(time > 20.0, 0.05 * np.sin(2.0 * math.pi * 0.7 * time), 0.0)
    half = np.interp(np.arange(0.0, 60.0001, 0.005), time, angle)
    late = model.steering(np.arange(len(half)) * 0.005, half, np.arange(len(half)) == 0)[1]
    start = VehicleState(0.0, 0.0, 12.0, 0.0, 0.0, 0.0)
    states = predict(model, leaf, start, InputSequence(late, np.zeros(len(half))), 60.0, 0.01).states
    rng = np.random.default_rng(seed)
    x, y, velocity_x, velocity_y, yaw, yaw_rate = (states + rng.normal(size=states.shape) * (
        0.01, 0.01, 0.01, 0.01, 1e-3, 2e-3)).T
    dx = leaf.cg_to_ins_x
    time_ns = np.round(time * 1e9).astype(np.int64)
    return DriveLog(name, time_ns, x + dx * np.cos(yaw), y + dx * np.sin(yaw), yaw, velocity_x,
                    velocity_y + dx * yaw_rate, yaw_rate, time_ns, angle)


@pytest.mark.slow
def test_missing_steering_lag_is_found_at_high_steering_rates(leaf):
    plain, lagging = augment("nonlinear", {}), augment("nonlinear", {"steering_lag": {"time_constant": 0.15}})
    settings = DiscoverySettings(channels=("velocity_y", "yaw_rate"))
    healthy, suspect = weave(leaf, plain, "healthy", 1), weave(leaf, lagging, "suspect", 2)
    regions = find_error_regions([suspect], plain, leaf, settings, [healthy])
    result = [s for s in regions if s.channel == "yaw_rate" and s.condition.startswith("steering rate")]
    assert result and result[0].interval[0] > 2.0 and result[0].condition.startswith("steering rate 0.1 to 0.2 rad/s")
    assert not find_error_regions([weave(leaf, plain, "another", 3)], plain, leaf, settings, [healthy])
