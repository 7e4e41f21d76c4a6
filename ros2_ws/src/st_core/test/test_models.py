"""The three models: exact circle, mirror symmetry, standstill, NaN, load transfer. Batches: test_backends.py."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_core.errors import ConfigurationError
from st_core.models import MODELS, get_model, nonlinear_tyre
from st_core.prediction import predict
from st_core.types import ControlInput, InputSequence, VehicleState
from st_core.tyres import GRAVITY

ALL = sorted(MODELS)
MIRROR = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0])

RANGES = ((-500.0, 500.0), (-500.0, 500.0), (0.0, 25.0), (-1.0, 1.0), (-7.0, 7.0), (-0.8, 0.8))
state_strategy = st.builds(VehicleState, *[st.floats(*limits) for limits in RANGES])
input_strategy = st.builds(ControlInput, st.floats(-0.5, 0.5), st.floats(-6.0, 4.0))


def test_registry_names_its_models():
    assert ALL == ["kinematic", "linear", "nonlinear"]
    assert all(get_model(name).name == name for name in ALL)
    with pytest.raises(ConfigurationError, match=r"unknown model 'bicycle'; known: kinematic, linear, nonlinear"):
        get_model("bicycle")


def test_kinematic_circle_is_exact(leaf):
    speed, angle = 6.0, 0.2
    beta = math.atan(leaf.cg_to_rear_axle / leaf.wheelbase * math.tan(angle))
    rate = speed / leaf.wheelbase * math.cos(beta) * math.tan(angle)
    path = predict("kinematic", leaf, VehicleState(3.0, -1.0, speed, 0.0, 0.5, 0.0), ControlInput(angle, 0.0))
    time, radius, course = path.time, speed / rate, 0.5 + beta
    np.testing.assert_allclose(path.yaw, 0.5 + rate * time, rtol=1e-13)
    np.testing.assert_allclose(path.x, 3.0 + radius * (np.sin(course + rate * time) - math.sin(course)), atol=2e-6)
    np.testing.assert_allclose(path.y, -1.0 - radius * (np.cos(course + rate * time) - math.cos(course)), atol=2e-6)
    # The rear axle rolls without slip: its centre keeps the distance l / tan(delta) from the turning centre.
    centre = 3.0 - radius * math.sin(course), -1.0 + radius * math.cos(course)
    rear = path.x - leaf.cg_to_rear_axle * np.cos(path.yaw), path.y - leaf.cg_to_rear_axle * np.sin(path.yaw)
    distance = np.hypot(rear[0] - centre[0], rear[1] - centre[1])
    np.testing.assert_allclose(distance, leaf.wheelbase / math.tan(angle), atol=1e-5)


def test_kinematic_model_keeps_lateral_velocity_and_yaw_rate_constant(leaf):
    path = predict("kinematic", leaf, VehicleState(0.0, 0.0, 6.0, 0.4, 0.0, 0.3), ControlInput(0.1, 0.5))
    assert (path.velocity_y == 0.4).all() and (path.yaw_rate == 0.3).all()


@pytest.mark.parametrize("model", ALL)
def test_forward_speed_follows_the_input_alone(leaf, model):
    path = predict(model, leaf, VehicleState(0.0, 0.0, 10.0, 0.1, 0.0, 0.1), ControlInput(0.05, -1.5))
    np.testing.assert_allclose(path.velocity_x, 10.0 - 1.5 * path.time, rtol=1e-12)


@pytest.mark.parametrize("model", ALL)
def test_straight_ahead_stays_straight(leaf, model):
    path = predict(model, leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), ControlInput(0.0, 0.0))
    np.testing.assert_allclose(path.states[-1], [50.0, 0.0, 10.0, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("model", ALL)
@settings(max_examples=20, deadline=None)
@given(state=state_strategy, control=input_strategy)
def test_mirrored_inputs_give_mirrored_paths(leaf, model, state, control):
    path = predict(model, leaf, state, control, 1.0)
    mirrored_state = VehicleState(*(MIRROR * state.as_tuple()))
    mirrored_control = ControlInput(-control.road_wheel_angle, control.velocity_x_dot)
    mirrored = predict(model, leaf, mirrored_state, mirrored_control, 1.0)
    np.testing.assert_allclose(mirrored.states, path.states * MIRROR, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("model", ALL)
def test_rotated_start_yaw_rotates_the_path(leaf, model):
    turn = 1.1
    path = predict(model, leaf, VehicleState(0.0, 0.0, 9.0, 0.1, 0.2, 0.3), ControlInput(0.1, 0.4))
    turned = predict(model, leaf, VehicleState(0.0, 0.0, 9.0, 0.1, 0.2 + turn, 0.3), ControlInput(0.1, 0.4))
    np.testing.assert_allclose(turned.x, path.x * math.cos(turn) - path.y * math.sin(turn), atol=1e-11)
    np.testing.assert_allclose(turned.y, path.x * math.sin(turn) + path.y * math.cos(turn), atol=1e-11)


@pytest.mark.parametrize("model", ALL)
@pytest.mark.parametrize("speed", [0.0, 1e-9, 0.1, 0.5, 1.0, 2.0, 2.9, 3.1, -1.0])
def test_low_speed_predictions_are_bounded(car, model, speed):
    path = predict(model, car, VehicleState(0.0, 0.0, speed, 0.2, 0.0, 0.3), ControlInput(0.4, 0.0))
    assert np.isfinite(path.states).all()
    assert np.abs(path.states[:, :2]).max() < 30.0
    assert np.abs(path.yaw_rate).max() < 2.0 and np.abs(path.velocity_y).max() < 2.0


@pytest.mark.parametrize("model", ALL)
def test_braking_through_standstill_stays_finite(car, model):
    path = predict(model, car, VehicleState(0.0, 0.0, 4.0, 0.1, 0.0, 0.2), ControlInput(0.3, -1.5))
    assert np.isfinite(path.states).all()


@pytest.mark.parametrize("model", ALL)
@pytest.mark.parametrize("acceleration", [1e4, -1e4])
def test_extreme_acceleration_does_not_raise(leaf, model, acceleration):
    path = predict(model, leaf, VehicleState(0.0, 0.0, 10.0, 0.1, 0.0, 0.2), ControlInput(0.1, acceleration))
    assert path.states.shape == (101, 6)


@pytest.mark.parametrize("model", ALL)
def test_nan_and_infinity_propagate(leaf, model):
    good = VehicleState(0.0, 0.0, 10.0, 0.1, 0.0, 0.2)
    for bad in (math.nan, math.inf):
        invalid = VehicleState(0.0, 0.0, bad, 0.1, 0.0, 0.2)
        assert not np.isfinite(predict(model, leaf, invalid, ControlInput(0.1, 0.0)).states[-1, :3]).any()
        assert np.isnan(predict(model, leaf, good, ControlInput(bad, 0.0)).states[-1, :2]).all()
    invalid = VehicleState(0.0, 0.0, 10.0, 0.1, math.nan, 0.2)
    assert np.isnan(predict(model, leaf, invalid, ControlInput(0.1, 0.0)).states[-1, [0, 1, 4]]).all()


@pytest.mark.parametrize("model", ALL)
def test_nan_input_affects_later_states_only(leaf, model):
    angle = np.full(201, 0.05)
    known = predict(model, leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), InputSequence(angle, np.zeros(201)))
    angle = angle.copy()
    angle[100:110] = np.nan
    path = predict(model, leaf, VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), InputSequence(angle, np.zeros(201)))
    np.testing.assert_array_equal(path.states[:50], known.states[:50])
    assert np.isnan(path.x[51:]).all() and np.isnan(path.yaw[51:]).all()


@pytest.mark.parametrize("model", ALL)
def test_constant_sequence_equals_control_input(leaf, model):
    state = VehicleState(5.0, 2.0, 14.0, -0.1, 0.3, 0.2)
    control = predict(model, leaf, state, ControlInput(0.04, 0.7))
    sequence = predict(model, leaf, state, InputSequence(np.full(201, 0.04), np.full(201, 0.7)))
    np.testing.assert_allclose(sequence.states, control.states, rtol=1e-13, atol=1e-13)


def test_load_transfer_preserves_weight_and_matches_its_formula(leaf):
    p = nonlinear_tyre.parameters(leaf)
    for acceleration in (-6.0, -1.5, 0.0, 3.0):
        front, rear = nonlinear_tyre.axle_loads(acceleration, p)
        assert front + rear == pytest.approx(leaf.mass * GRAVITY, rel=1e-14)
        expected = leaf.mass / leaf.wheelbase * (GRAVITY * leaf.cg_to_rear_axle - acceleration * leaf.cg_height)
        assert front == pytest.approx(expected, rel=1e-14)
    assert nonlinear_tyre.axle_loads(0.0, p)[0] == pytest.approx(2.0 * leaf.static_tyre_load_front)
    # The paper: about 400 N at -1.5 m/s^2.
    transfer = nonlinear_tyre.axle_loads(-1.5, p)[0] - nonlinear_tyre.axle_loads(0.0, p)[0]
    assert transfer == pytest.approx(400.0, abs=15.0)


def test_tyre_models_agree_at_small_slip(leaf):
    state, control = VehicleState(0.0, 0.0, 10.0, 0.0, 0.0, 0.0), ControlInput(0.005, 0.0)
    linear, nonlinear = (predict(name, leaf, state, control).states for name in ("linear", "nonlinear"))
    assert np.abs(linear - nonlinear).max() < 2e-3


def test_saturation_widens_the_turn(leaf):
    state, control = VehicleState(0.0, 0.0, 12.0, 0.0, 0.0, 0.0), ControlInput(0.2, 0.0)
    linear, nonlinear = (predict(name, leaf, state, control) for name in ("linear", "nonlinear"))
    assert nonlinear.yaw[-1] < linear.yaw[-1]
