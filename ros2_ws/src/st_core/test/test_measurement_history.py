"""INS and steering on one time axis: the result does not depend on the order of arrival."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_core.measurement_history import DERIVATIVE, FILTERED_VELOCITY, MeasurementHistory
from st_core.timeseries import filtered_derivative
from st_core.types import InsSample

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def history() -> MeasurementHistory:
    return MeasurementHistory(span=2.0, maximum_gap=0.1, filter_cutoff=5.0)


def sample(ms: float, speed: float = 10.0, yaw: float = 0.0) -> InsSample:
    return InsSample(T0 + round(ms * MS), 0.01 * ms, 0.0, yaw, speed, 0.0, 0.1)


def speed_at(ms: float) -> float:
    return 10.0 + math.sin(0.02 * ms)


@given(st.data(), st.lists(st.integers(0, 450), min_size=1, max_size=40, unique=True))
def test_filtered_acceleration_does_not_depend_on_the_order_of_arrival(data, times):
    live = history()
    for t in data.draw(st.permutations(times)):
        assert live.add_ins(sample(t, speed_at(t)))
    ordered = sorted(times)
    filtered, derivative = filtered_derivative(
        T0 + np.array(ordered) * MS, np.array([speed_at(t) for t in ordered]), 5.0, 0.1)
    np.testing.assert_array_equal(live.ins.rows[:, FILTERED_VELOCITY], filtered)
    np.testing.assert_array_equal(live.ins.rows[:, DERIVATIVE], derivative)


def test_discarding_old_samples_does_not_change_the_filter():
    live = history()
    for t in range(0, 10_000, 10):
        live.add_ins(sample(t, speed_at(t)))
    times = np.arange(0, 10_000, 10)
    _, derivative = filtered_derivative(T0 + times * MS, np.array([speed_at(t) for t in times]), 5.0, 0.1)
    assert len(live.ins) == 201
    np.testing.assert_array_equal(live.ins.rows[:, DERIVATIVE], derivative[-201:])


def test_inputs_are_known_only_between_samples_of_both_sensors():
    live = history()
    for t in range(0, 500, 10):
        live.add_ins(sample(t, 10.0 + 0.002 * t))
    for t in range(100, 400, 20):
        live.add_steering(T0 + t * MS, 0.001 * t)
    inputs = live.inputs_at(T0 + 350 * MS)
    assert inputs.road_wheel_angle == pytest.approx(0.35)
    assert inputs.velocity_x_dot == pytest.approx(2.0, rel=1e-3)
    assert live.inputs_at(T0 + 90 * MS) is None
    assert live.inputs_at(T0 + 390 * MS) is None
    assert live.inputs_at(T0 - 10 * MS) is None
    times_ns = T0 + np.array([90, 350, 390, 495]) * MS
    np.testing.assert_allclose(live.steering.sample(times_ns)[:, 0], [np.nan, 0.35, np.nan, np.nan], rtol=1e-12)
    assert np.isfinite(live.ins.sample(times_ns)[:, DERIVATIVE]).tolist() == [True, True, True, False]


def test_yaw_is_interpolated_across_plus_minus_pi():
    live = history()
    live.add_ins(sample(0, yaw=3.1))
    live.add_ins(sample(10, yaw=-3.1))
    assert live.ins_at(T0 + 5 * MS).yaw == pytest.approx(math.pi)
    assert live.ins_at(T0 + 20 * MS) is None


def test_acceleration_is_unknown_at_the_first_sample_after_a_gap():
    live = history()
    for t in (0, 10, 500):
        live.add_ins(sample(t))
        live.add_steering(T0 + t * MS, 0.0)
    assert live.inputs_at(T0) is None
    assert live.inputs_at(T0 + 10 * MS) is not None
    assert live.inputs_at(T0 + 500 * MS) is None


def test_both_signals_restart_when_ins_time_jumps_back():
    live = history()
    for t in range(10_000, 11_000, 10):
        live.add_ins(sample(t))
        live.add_steering(T0 + t * MS, 0.1)
    for t in range(0, 100, 10):
        live.add_ins(sample(t))
    assert live.generation == 1 and len(live.ins) == 10 and len(live.steering) == 0
    for t in range(100, 200, 10):
        live.add_ins(sample(t))
        live.add_steering(T0 + t * MS, 0.2)
    assert live.generation == 1
    assert live.inputs_at(T0 + 150 * MS).road_wheel_angle == pytest.approx(0.2)
    assert live.ins.newest == live.steering.newest == T0 + 190 * MS


def test_non_finite_samples_are_rejected():
    live = history()
    live.add_ins(sample(0))
    assert not live.add_ins(sample(10, speed=math.nan))
    assert not live.add_steering(T0, math.inf)
    assert (len(live.ins), len(live.steering)) == (1, 0)
