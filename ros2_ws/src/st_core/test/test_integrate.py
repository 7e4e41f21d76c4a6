"""Runge-Kutta: order 4, the unrolled step equals the general one, inputs are evaluated at their own instants."""

import math

import numpy as np
import pytest
from st_core.integrate import _rk4_step_six_states, rk4, rk4_step
from st_core.prediction import predict
from st_core.types import ControlInput, InputSequence, VehicleState


def oscillator(state, w, p):
    return state[1], -p * state[0] + w


def test_oscillator_converges_with_order_four():
    errors = []
    for steps in (20, 40, 80):
        end = rk4(oscillator, (1.0, 0.0), [0.0] * (2 * steps + 1), 4.0, 2.0 / steps)[-1]
        errors.append(math.hypot(end[0] - math.cos(4.0), end[1] + 2.0 * math.sin(4.0)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.15)


def test_cubic_input_is_integrated_exactly():
    # Simpson's rule is exact for a cubic only with inputs at the start, middle and end of each step.
    step, steps = 0.5, 4
    grid = [(0.5 * step * i) ** 3 for i in range(2 * steps + 1)]
    end = rk4(lambda state, w, p: (w,), (0.0,), grid, None, step)[-1]
    assert end[0] == pytest.approx(2.0**4 / 4.0, rel=1e-14)


def test_written_out_step_equals_general_step():
    def derivative(s, w, p):
        return (s[1] * w, math.sin(s[2]), s[3] - s[0], s[4] * s[5] * p, math.cos(s[0]), -s[1])

    state, arguments = (0.3, -1.2, 0.5, 2.0, 0.1, -0.7), (1.0, 1.5, 2.0, 0.3, 0.1)
    expected = rk4_step(derivative, state, *arguments)
    assert _rk4_step_six_states(derivative, state, *arguments) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("model", ["kinematic", "linear", "nonlinear"])
def test_models_converge_with_order_four(leaf, model):
    start = VehicleState(1.0, -2.0, 12.0, 0.2, 0.4, 0.3)

    def end(step):
        time = np.arange(round(2.0 / step) * 2 + 1) * 0.5 * step
        inputs = InputSequence(0.05 + 0.02 * np.sin(2.0 * time), 1.0 - 0.5 * time)
        return predict(model, leaf, start, inputs, 2.0, step).states[-1]

    exact = end(0.0005)
    errors = [np.linalg.norm(end(step) - exact) for step in (0.04, 0.02, 0.01)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.3)


def test_steps_of_fifty_milliseconds_resolve_the_nonlinear_model(leaf):
    start, inputs = VehicleState(0.0, 0.0, 16.0, 0.0, 0.0, 0.0), ControlInput(0.06, -1.0)
    coarse, fine = (predict("nonlinear", leaf, start, inputs, 5.0, step).states[-1] for step in (0.05, 0.001))
    assert np.abs(coarse - fine).max() < 1e-3
