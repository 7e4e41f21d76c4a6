"""Frozen steering angle: detected in ordinary driving, not with a constant steering wheel or a stationary car."""

import math

import numpy as np
import pytest
from st_core.measurement_history import FrozenSteeringDetector
from st_core.models import get_model
from st_core.prediction import predict
from st_core.types import InputSequence, InsSample, VehicleState

STEP, STEPS = 0.05, 400
T0 = 1_700_000_000_000_000_000
TIME = STEP * np.arange(STEPS + 1)


def simulate(leaf, angle, speed=10.0, acceleration=0.0):
    """20 s of the nonlinear car: rows of (time, v_x, yaw rate)."""
    half = np.linspace(0.0, STEP * STEPS, 2 * STEPS + 1)
    inputs = InputSequence(angle(half) * np.ones_like(half), np.full_like(half, acceleration))
    run = predict(get_model("nonlinear"), leaf, VehicleState(0.0, 0.0, speed, 0.0, 0.0, 0.0), inputs, 20.0, STEP)
    return TIME, run.velocity_x, run.yaw_rate


def detect(leaf, rows, measured_angle, noise=0.003):
    """(time [s], finding) while frozen; measured_angle(t) [rad] at 100 Hz, yaw rate with noise [rad/s]."""
    detector, found, draw = FrozenSteeringDetector(leaf), [], np.random.default_rng(3)
    for t in np.arange(0.0, 20.0, 0.01):
        v_x, rate = (float(np.interp(t, rows[0], row)) for row in rows[1:])
        time_ns = T0 + round(t * 1e9)
        detector.add_steering(time_ns, float(measured_angle(t)))
        detector.add_ins(InsSample(time_ns, 0.0, 0.0, 0.0, v_x, 0.0, rate + draw.normal(0.0, noise)))
        if detector.frozen_angle:
            found.append((t, detector.frozen_angle))
    return found


def weave(t):
    return 0.05 * np.sin(0.8 * t)


def test_frozen_angle_is_reported_until_it_moves_again(leaf):
    rows = simulate(leaf, weave)
    found = detect(leaf, rows, lambda t: weave(5.0) if 5.0 <= t < 12.0 else weave(t))
    times = [t for t, _ in found]
    assert 5.0 < times[0] < 9.0 and times[-1] < 12.0
    last = found[-1][1]
    assert last.angle == pytest.approx(weave(5.0)) and last.duration == pytest.approx(7.0, abs=0.02)
    assert last.low < 0.0 < last.high
    assert times == pytest.approx(np.arange(times[0], 11.995, 0.01).tolist())  # reported without interruption


@pytest.mark.parametrize(("angle", "speed", "acceleration"), [
    (0.0, 12.0, 0.0), (0.0, 2.0, 1.0), (0.09, 8.0, 0.0), (-0.2, 4.0, 0.0), (0.05, 14.0, -0.5), (0.04, 5.0, 0.4),
])
def test_constant_steering_wheel_is_not_frozen(leaf, angle, speed, acceleration):
    """Straight and in turns up to 5 m/s^2, at constant, rising and falling speed."""
    rows = simulate(leaf, lambda t: angle, speed, acceleration)
    assert detect(leaf, rows, lambda t: angle) == []


def test_silent_sensor_is_not_frozen(leaf):
    """From 5 s on, no angle is received while the car weaves."""
    detector = FrozenSteeringDetector(leaf)
    times, v_x, rates = simulate(leaf, weave)
    for t, speed, rate in zip(times, v_x, rates, strict=True):
        if t < 5.0:
            detector.add_steering(T0 + round(t * 1e9), weave(t))
        detector.add_ins(InsSample(T0 + round(t * 1e9), 0.0, 0.0, 0.0, speed, 0.0, rate))
        assert detector.frozen_angle is None, t


def test_moving_steering_wheel_is_not_frozen(leaf):
    assert detect(leaf, simulate(leaf, weave), weave) == []


def test_stationary_car_is_not_reported(leaf):
    rows = TIME, np.zeros(STEPS + 1), np.zeros(STEPS + 1)
    assert detect(leaf, rows, lambda t: 0.1, noise=0.05) == []


def test_non_finite_samples_are_not_reported(leaf):
    detector = FrozenSteeringDetector(leaf)
    for k in range(200):
        detector.add_steering(T0 + k * 10_000_000, 0.1)
        detector.add_ins(InsSample(T0 + k * 10_000_000, 0.0, 0.0, 0.0, math.nan, 0.0, math.nan))
    assert detector.frozen_angle is None
