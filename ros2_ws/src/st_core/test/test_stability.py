"""Where RK4 lets the models down: the paper's step and two cars, warned of once, with sub-steps as remedy."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from st_core import stability
from st_core.augmented import augment
from st_core.handling import linear_system
from st_core.prediction import PredictionSettings, Predictor, predict
from st_core.stability import (
    StepTooLongWarning,
    growth_factor,
    lateral_modes,
    lowest_stable_speed,
    slip_speed_needed,
    substeps_needed,
)
from st_core.types import ControlInput, InputSequence, VehicleState

STEP = 0.05


@pytest.fixture(autouse=True)
def nothing_said_yet(monkeypatch):
    monkeypatch.setattr(stability, "_warned", set())


@pytest.fixture
def bare(car):
    """The car without the floor under its slip speed."""
    return replace(car, minimum_slip_speed=0.1)


@pytest.mark.parametrize("speed", [1.0, 3.0, 8.0, 25.0])
def test_modes_are_those_of_the_closed_form(car, speed):
    expected = np.sort_complex(np.linalg.eigvals(linear_system(speed, car)[0]))
    np.testing.assert_allclose(np.sort_complex(lateral_modes("linear", car, speed)), expected, rtol=1e-7)
    # The tyre of the nonlinear model has the same slope at no slip, to the rounding of its printed parameters.
    np.testing.assert_allclose(np.sort_complex(lateral_modes("nonlinear", car, speed)), expected, rtol=0.05)
    z = STEP * expected
    closed = np.abs(1.0 + z + z**2 / 2.0 + z**3 / 6.0 + z**4 / 24.0).max()
    assert growth_factor("linear", car, speed, STEP) == pytest.approx(closed, rel=1e-6)


def test_speeds_below_which_the_papers_step_is_too_long(bare):
    expected = {"Nissan Leaf ZE0": 2.660, "Hyundai Genesis": 3.979}[bare.name]
    assert lowest_stable_speed("linear", bare, STEP) == pytest.approx(expected, abs=0.001)
    assert lowest_stable_speed("linear", bare, 0.5 * STEP) == pytest.approx(0.5 * expected, rel=0.05)


def test_the_floor_of_the_slip_speed_keeps_both_cars_stable(car):
    for model in ("kinematic", "linear", "nonlinear"):
        assert lowest_stable_speed(model, car, STEP) == 0.0
        assert substeps_needed(model, car, [0.5, 30.0], STEP) == 1


def test_a_simulation_diverges_just_there(bare):
    limit = lowest_stable_speed("linear", bare, STEP)
    for factor, bounded in ((0.97, False), (1.03, True)):
        start = VehicleState(0.0, 0.0, factor * limit, 1.0e-6, 0.0, 0.0)
        path = predict("linear", bare, start, ControlInput(0.0, 0.0), horizon=10.0)
        assert (np.abs(path.velocity_y[-1]) < 1.0e-6) == bounded


def test_substeps_cure_it(bare):
    speed = 1.0
    count = substeps_needed("linear", bare, [speed], STEP)
    assert growth_factor("linear", bare, speed, STEP / count) <= 1.0
    assert growth_factor("linear", bare, speed, STEP / (count - 1)) > 1.0
    start, held = VehicleState(0.0, 0.0, speed, 0.0, 0.0, 0.0), ControlInput(0.1, 0.0)
    divided = predict("linear", bare, start, held, substeps=count)
    fine = predict("linear", bare, start, held, step=STEP / 16)
    assert divided.states.shape == (101, 6)
    np.testing.assert_allclose(divided.states[-1], fine.states[-1], atol=1e-3)
    coarse = predict("linear", bare, start, held)
    assert np.abs(coarse.velocity_y - fine.velocity_y[::16]).max() > 3.0 * np.abs(fine.velocity_y).max()
    # Inputs of a sequence run straight between the points given.
    ramp = np.linspace(0.0, 0.1, 201)
    given = predict("linear", bare, start, InputSequence(ramp, 0.0 * ramp), substeps=2)
    finer = np.linspace(0.0, 0.1, 401)
    same = predict("linear", bare, start, InputSequence(finer, 0.0 * finer), step=0.5 * STEP)
    np.testing.assert_allclose(given.states, same.states[::2], rtol=1e-12, atol=1e-12)


def test_the_warning_comes_once_and_says_what_to_do(bare):
    with pytest.warns(StepTooLongWarning) as caught:
        for _ in range(3):
            stability.warn_if_too_long("linear", bare, [2.0, 20.0], STEP)
    assert len(caught) == 1
    floor, count = slip_speed_needed(["linear"], bare, [2.0, 20.0], STEP), substeps_needed("linear", bare, [2.0], STEP)
    assert str(caught[0].message) == (
        f"linear model of {bare.name}: integration steps of 50 ms are too long at 2.00 m/s, so the predicted "
        f"lateral motion is wrong; use a minimum_slip_speed of {floor:g} m/s in the vehicle file, or substeps={count}")


def test_nothing_is_said_where_all_is_well(car, bare):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Predictor(car, ("kinematic", "linear", "nonlinear"))
        stability.warn_if_too_long("linear", bare, [5.0, 30.0], STEP)
        stability.warn_if_too_long("kinematic", bare, [0.1], STEP)
        stability.warn_if_too_long("linear", bare, [], STEP)


def test_the_live_predictor_says_it_when_it_starts(bare):
    with pytest.warns(StepTooLongWarning, match="linear model of"):
        Predictor(bare, ("linear",), PredictionSettings(minimum_speed=1.0))


def test_extra_states_count(leaf):
    model = augment("linear", {"tyre_relaxation": {"length": 0.2}})
    modes = lateral_modes(model, leaf, 20.0)
    assert len(modes) == 4 and modes.real.min() < lateral_modes("linear", leaf, 20.0).real.min()
    assert substeps_needed(model, leaf, [20.0], 0.2) > substeps_needed("linear", leaf, [20.0], 0.2) == 1


def test_a_car_that_is_unstable_itself_is_not_the_integrators_fault(leaf):
    oversteering = replace(leaf, cornering_stiffness_rear=35000.0, minimum_slip_speed=0.1)
    assert lateral_modes("linear", oversteering, 40.0).real.max() > 0.0
    assert growth_factor("linear", oversteering, 40.0, 0.01) <= 1.0
    assert lowest_stable_speed("linear", oversteering, 0.01) < 1.0
    assert lowest_stable_speed("linear", leaf, 5.0) == np.inf
