"""Frames and lever arms: round trips, signs, formulas of the paper."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_core.types import (
    InsSample,
    VehicleState,
    body_to_map,
    cg_to_ins_position,
    ins_to_cg,
    ins_to_cg_acceleration,
    map_to_body,
    wrap_angle,
)
from steady_circle import cg_to_ins

finite = st.floats(-1.0e3, 1.0e3)


@given(st.floats(-1.0e4, 1.0e4))
def test_wrapped_angle_is_the_same_direction(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


def test_wrap_angle_at_its_limits_and_nan():
    assert wrap_angle(math.pi) == -math.pi
    assert wrap_angle(-math.pi) == -math.pi
    assert math.isnan(wrap_angle(math.nan))


@given(finite, finite, st.floats(-7.0, 7.0))
def test_body_and_map_round_trip(x, y, yaw):
    assert map_to_body(*body_to_map(x, y, yaw), yaw) == pytest.approx((x, y), abs=1e-9)


@given(st.builds(VehicleState, finite, finite, finite, finite, st.floats(-7.0, 7.0), st.floats(-3.0, 3.0)),
       st.floats(-3.0, 3.0), st.floats(-1.0, 1.0))
def test_lever_arm_round_trip(state, arm_x, arm_y):
    result = ins_to_cg(cg_to_ins(state, 7, arm_x, arm_y), arm_x, arm_y)
    assert result.as_tuple() == pytest.approx(state.as_tuple(), abs=1e-9)


def test_lever_arm_formulas_of_the_paper():
    sample = InsSample(0, 10.0, 20.0, 0.3, 8.0, -0.2, 0.5)
    state = ins_to_cg(sample, -0.398)
    assert state.velocity_y == pytest.approx(-0.2 + 0.5 * 0.398)
    assert state.velocity_x == 8.0
    assert state.x - 0.398 * math.cos(0.3) == pytest.approx(10.0)
    assert state.y - 0.398 * math.sin(0.3) == pytest.approx(20.0)
    assert cg_to_ins_position(state.x, state.y, 0.3, -0.398) == pytest.approx((10.0, 20.0))
    ax, ay = ins_to_cg_acceleration(1.0, 2.0, 0.5, 0.7, -0.398)
    assert (ax, ay) == pytest.approx((1.0 - 0.25 * 0.398, 2.0 + 0.7 * 0.398))


def test_lever_arm_acceleration_is_the_derivative_of_the_velocity():
    # A turning, accelerating body: the velocity of the INS point, differentiated in the map frame.
    arm = (-0.398, 0.2)
    t, step = 0.4, 1e-5

    def state_at(t):
        return VehicleState(0.0, 0.0, 8.0 + 1.5 * t, 0.3 - 0.4 * t, 0.2 * t + 0.35 * t * t, 0.2 + 0.7 * t)

    def cg_velocity(t):
        state = state_at(t)
        return np.array(body_to_map(state.velocity_x, state.velocity_y, state.yaw))

    def ins_velocity(t):
        sample = cg_to_ins(state_at(t), 0, *arm)
        return np.array(body_to_map(sample.velocity_x, sample.velocity_y, sample.yaw))

    def body_acceleration(velocity):
        return map_to_body(*((velocity(t + step) - velocity(t - step)) / (2 * step)), state_at(t).yaw)

    ins, cg = body_acceleration(ins_velocity), body_acceleration(cg_velocity)
    assert ins_to_cg_acceleration(*ins, state_at(t).yaw_rate, 0.7, *arm) == pytest.approx(cg, abs=1e-6)
