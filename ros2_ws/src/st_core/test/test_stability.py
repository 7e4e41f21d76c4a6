"""Stability limits of RK4 for the step of the paper and two cars; a single warning; substeps as remedy."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from st_core import integrate
from st_core.augmented import augment
from st_core.handling import linear_system
from st_core.integrate import (
    StepTooLongWarning,
    growth_factor,
    lateral_modes,
    lowest_stable_speed,
    required_slip_speed,
    required_substeps,
)
from st_core.prediction import PredictionSettings, Predictor, predict
from st_core.types import ControlInput, InputSequence, VehicleState

STEP = 0.05


@pytest.fixture(autouse=True)
def no_previous_warnings(monkeypatch):
    monkeypatch.setattr(integrate, "_issued_warnings", set())


@pytest.fixture
def stiff_car(car):
    """The car with a minimum slip speed of 0.1 m/s, too low for steps of 50 ms."""
    return replace(car, minimum_slip_speed=0.1)


@pytest.mark.parametrize("speed", [1.0, 3.0, 8.0, 25.0])
def test_lateral_modes_match_the_closed_form(car, speed):
    expected = np.sort_complex(np.linalg.eigvals(linear_system(speed, car)[0]))
    np.testing.assert_allclose(np.sort_complex(lateral_modes("linear", car, speed)), expected, rtol=1e-7)
    # The nonlinear tyre has the same initial slope within the rounding of its published parameters.
    np.testing.assert_allclose(np.sort_complex(lateral_modes("nonlinear", car, speed)), expected, rtol=0.05)
    z = STEP * expected
    closed = np.abs(1.0 + z + z**2 / 2.0 + z**3 / 6.0 + z**4 / 24.0).max()
    assert growth_factor("linear", car, speed, STEP) == pytest.approx(closed, rel=1e-6)


def test_lowest_stable_speed_for_the_step_of_the_paper(stiff_car):
    expected = {"Nissan Leaf ZE0": 2.660, "Hyundai Genesis": 3.979}[stiff_car.name]
    assert lowest_stable_speed("linear", stiff_car, STEP) == pytest.approx(expected, abs=0.001)
    assert lowest_stable_speed("linear", stiff_car, 0.5 * STEP) == pytest.approx(0.5 * expected, rel=0.05)


def test_minimum_slip_speed_keeps_every_model_stable(car):
    for model in ("kinematic", "linear", "nonlinear"):
        assert lowest_stable_speed(model, car, STEP) == 0.0
        assert required_substeps(model, car, [0.5, 30.0], STEP) == 1


def test_simulation_diverges_below_the_lowest_stable_speed(stiff_car):
    limit = lowest_stable_speed("linear", stiff_car, STEP)
    for factor, bounded in ((0.97, False), (1.03, True)):
        start = VehicleState(0.0, 0.0, factor * limit, 1.0e-6, 0.0, 0.0)
        path = predict("linear", stiff_car, start, ControlInput(0.0, 0.0), horizon=10.0)
        assert (np.abs(path.velocity_y[-1]) < 1.0e-6) == bounded


def test_substeps_restore_stability_and_accuracy(stiff_car):
    speed = 1.0
    count = required_substeps("linear", stiff_car, [speed], STEP)
    assert growth_factor("linear", stiff_car, speed, STEP / count) <= 1.0
    assert growth_factor("linear", stiff_car, speed, STEP / (count - 1)) > 1.0
    start, inputs = VehicleState(0.0, 0.0, speed, 0.0, 0.0, 0.0), ControlInput(0.1, 0.0)
    divided = predict("linear", stiff_car, start, inputs, substeps=count)
    fine = predict("linear", stiff_car, start, inputs, step=STEP / 16)
    assert divided.states.shape == (101, 6)
    np.testing.assert_allclose(divided.states[-1], fine.states[-1], atol=1e-3)
    coarse = predict("linear", stiff_car, start, inputs)
    assert np.abs(coarse.velocity_y - fine.velocity_y[::16]).max() > 3.0 * np.abs(fine.velocity_y).max()
    # Inputs of a sequence are interpolated linearly.
    ramp = np.linspace(0.0, 0.1, 201)
    substepped = predict("linear", stiff_car, start, InputSequence(ramp, 0.0 * ramp), substeps=2)
    fine_ramp = np.linspace(0.0, 0.1, 401)
    short_steps = predict("linear", stiff_car, start, InputSequence(fine_ramp, 0.0 * fine_ramp), step=0.5 * STEP)
    np.testing.assert_allclose(substepped.states, short_steps.states[::2], rtol=1e-12, atol=1e-12)


def test_warning_is_issued_once_with_the_remedy(stiff_car):
    with pytest.warns(StepTooLongWarning) as caught:
        for _ in range(3):
            integrate.warn_if_step_too_long("linear", stiff_car, [2.0, 20.0], STEP)
    assert len(caught) == 1
    floor = required_slip_speed(["linear"], stiff_car, [2.0, 20.0], STEP)
    count = required_substeps("linear", stiff_car, [2.0], STEP)
    assert str(caught[0].message) == (
        f"linear model of {stiff_car.name}: integration steps of 50 ms are too long at 2.00 m/s, so the predicted "
        f"lateral motion is wrong; use a minimum_slip_speed of {floor:g} m/s in the vehicle file, or substeps={count}")


def test_no_warning_for_stable_steps(car, stiff_car):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Predictor(car, ("kinematic", "linear", "nonlinear"))
        integrate.warn_if_step_too_long("linear", stiff_car, [5.0, 30.0], STEP)
        integrate.warn_if_step_too_long("kinematic", stiff_car, [0.1], STEP)
        integrate.warn_if_step_too_long("linear", stiff_car, [], STEP)


def test_live_predictor_warns_at_construction(stiff_car):
    with pytest.warns(StepTooLongWarning, match="linear model of"):
        Predictor(stiff_car, ("linear",), PredictionSettings(minimum_speed=1.0))


def test_prediction_warns_once_about_a_long_step_and_bridges_it_with_substeps(car):
    start = VehicleState(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    with pytest.warns(StepTooLongWarning, match="steps of 500 ms are too long at 1.00 m/s") as caught:
        for _ in range(2):
            predict("linear", car, start, ControlInput(0.05, 0.0), step=0.5)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        predict("linear", car, start, ControlInput(0.05, 0.0), step=0.5, substeps=10)


def test_extra_states_are_included_in_the_modes(leaf):
    model = augment("linear", {"tyre_relaxation": {"length": 0.2}})
    modes = lateral_modes(model, leaf, 20.0)
    assert len(modes) == 4 and modes.real.min() < lateral_modes("linear", leaf, 20.0).real.min()
    assert required_substeps(model, leaf, [20.0], 0.2) > required_substeps("linear", leaf, [20.0], 0.2) == 1


def test_unstable_vehicle_does_not_require_shorter_steps(leaf):
    oversteering = replace(leaf, cornering_stiffness_rear=35000.0, minimum_slip_speed=0.1)
    assert lateral_modes("linear", oversteering, 40.0).real.max() > 0.0
    assert growth_factor("linear", oversteering, 40.0, 0.01) <= 1.0
    assert lowest_stable_speed("linear", oversteering, 0.01) < 1.0
    assert lowest_stable_speed("linear", leaf, 5.0) == np.inf
