"""CasADi functions of every model and effect against the equations on floats, and their Jacobians."""

import math

import numpy as np
import pytest
from effect_values import values_towards_bound
from st_core import ops
from st_core.augmented import augment
from st_core.effects import find_applicable_effects
from st_core.errors import ConfigurationError
from st_core.integrate import rk4, rk4_step
from st_core.models import MODELS

casadi = pytest.importorskip("casadi", reason="casadi is not installed")
from st_core.backends.casadi_backend import build, list_free_parameters  # noqa: E402

STEPS, STEP = 100, 0.05
SHARES = (-1.0, -0.3, 0.4, 1.0)  # of the distance from null to a bound
EFFECTS_BY_BASE = [(base, name) for base in MODELS for name in find_applicable_effects(base)]


def random_cases(count, seed=1):
    """Start states (count, 6) and constant inputs (count, 2): 1 to 20 m/s, |a_y| up to 6 m/s^2."""
    draw = np.random.default_rng(seed)
    speed = draw.uniform(1.0, 20.0, count)
    angle = np.clip(draw.uniform(-6.0, 6.0, count) * 2.7 / speed**2, -0.3, 0.3)
    states = np.column_stack([*draw.uniform(-100.0, 100.0, (2, count)), speed, draw.uniform(-0.3, 0.3, count),
                              draw.uniform(-3.0, 3.0, count), draw.uniform(-0.4, 0.4, count)])
    return states, np.column_stack([angle, draw.uniform(-0.3, 1.0, count)])


def assert_equal_to_rounding(values, reference):
    values, reference = np.asarray(values, float), np.asarray(reference, float)
    assert np.all(np.isfinite(reference))
    assert np.max(np.abs(values - reference) / np.maximum(1.0, np.abs(reference))) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_thousand_predictions_of_five_seconds_equal_floats(leaf, name):
    model, (states, inputs) = MODELS[name], random_cases(1000)
    p = model.parameters(leaf)
    expected = []
    for state, (angle, acceleration) in zip(states.tolist(), inputs.tolist(), strict=True):
        w = model.inputs(angle, acceleration, p)
        expected.append(rk4(model.rhs, tuple(state), [w] * (2 * STEPS + 1), p, STEP)[-1])
    many = build(name, leaf).step.mapaccum(STEPS)
    final_states = [many(state, np.tile(u[:, None], STEPS), STEP)[:, -1].full().ravel()
            for state, u in zip(states, inputs, strict=True)]
    assert_equal_to_rounding(final_states, expected)


def assert_functions_equal_floats(model, vehicle, count=40):
    p, functions = model.parameters(vehicle), build(model, vehicle)
    for six, (angle, acceleration) in zip(*(c.tolist() for c in random_cases(count)), strict=True):
        w = model.inputs(angle, acceleration, p)
        state = model.start_state(tuple(six), w, p)
        u = [angle, acceleration]
        assert_equal_to_rounding(functions.start(six, u).full().ravel(), state)
        assert_equal_to_rounding(functions.dynamics(state, u).full().ravel(), model.rhs(state, w, p))
        advance = rk4_step(model.rhs, state, w, w, w, p, 0.02)
        assert_equal_to_rounding(functions.step(state, u, 0.02).full().ravel(), advance)


@pytest.mark.parametrize(("base", "name"), EFFECTS_BY_BASE)
def test_every_effect_equals_floats_at_several_values(leaf, base, name):
    for share in SHARES:
        assert_functions_equal_floats(augment(base, {name: values_towards_bound(name, share)}), leaf, count=15)


@pytest.mark.parametrize("base", MODELS)
def test_all_effects_together_equal_floats(car, base):
    assert_functions_equal_floats(augment(base, find_applicable_effects(base)), car)


@pytest.mark.parametrize("base", MODELS)
def test_jacobians_equal_central_differences(leaf, base):
    model = augment(base, find_applicable_effects(base))
    functions, p = build(model, leaf), model.parameters(leaf)
    (six,), ((angle, acceleration),) = (c.tolist() for c in random_cases(1))
    w = model.inputs(angle, acceleration, p)
    x, u, h = np.array(model.start_state(tuple(six), w, p)), np.array([angle, acceleration]), 0.02

    def rates(x, u):
        return np.array(model.rhs(tuple(x), model.inputs(*u, p), p), float)

    def advance(x, u):
        w = model.inputs(*u, p)
        return np.array(rk4_step(model.rhs, tuple(x), w, w, w, p, h), float)

    for function, (a, b) in ((rates, functions.dynamics_jacobian(x, u)), (advance, functions.step_jacobian(x, u, h))):
        for matrix, argument in ((a.full(), 0), (b.full(), 1)):
            for column in range(matrix.shape[1]):
                increment = np.zeros(len((x, u)[argument]))
                increment[column] = 1e-6
                ends = [function(*(v + sign * increment if k == argument else v for k, v in enumerate((x, u))))
                        for sign in (1, -1)]
                np.testing.assert_allclose(matrix[:, column], (ends[0] - ends[1]) / 2e-6, rtol=2e-5, atol=2e-5)


def test_substeps_equal_shorter_steps(leaf):
    single, divided = build("nonlinear", leaf), build("nonlinear", leaf, substeps=3)
    x, u = [0.0, 0.0, 12.0, 0.1, 0.2, 0.3], [0.05, -1.0]
    expected = x
    for _ in range(3):
        expected = single.step(expected, u, 0.02)
    assert_equal_to_rounding(divided.step(x, u, 0.06).full(), expected.full())


def test_free_parameter_is_an_argument(leaf):
    model = augment("nonlinear", {"road_bank": {"angle": 0.1}, "steering_offset": {"angle": 0.0}})
    functions = build(model, leaf, free=["steering_offset.angle", "road_bank.angle"])
    assert [(v.name, v.unit, v.value) for v in functions.parameters] == [
        ("steering_offset.angle", "rad", 0.0), ("road_bank.angle", "rad", 0.1)]
    x, u = [0.0, 0.0, 12.0, 0.1, 0.2, 0.3], [0.1, -1.0]
    for angle, bank in ((0.0, 0.1), (0.02, -0.05)):
        fixed = build(model.with_values({"road_bank": {"angle": bank}, "steering_offset": {"angle": angle}}), leaf)
        assert_equal_to_rounding(functions.step(x, u, 0.05, [angle, bank]).full(), fixed.step(x, u, 0.05).full())


@pytest.mark.parametrize(("arguments", "message"), [
    ({"model": "bicycle"}, "unknown model 'bicycle'"),
    ({"model": "linear", "free": ["mass"]}, "free: 'mass' is not a parameter of an effect .* linear; those are: none"),
    ({"model": "linear", "substeps": 0}, "substeps: 0 is below 1"),
])
def test_invalid_arguments_are_rejected(leaf, arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        build(vehicle=leaf, **arguments)


def test_functions_carry_names_units_and_bounds(leaf):
    model = augment("nonlinear", ["tyre_relaxation", "friction", "steering_delay", "yaw_rate_bias"])
    functions = build(model, leaf)
    assert [(v.name, v.unit) for v in functions.states[6:]] == [(name, "rad") for name in model.extra_states]
    assert functions.states[2].unit == "m/s" and functions.inputs[0].unit == "rad"
    assert all(v.lower < v.upper for v in (*functions.states, *functions.inputs))
    assert set(functions.omitted_effects) == {"steering_delay", "yaw_rate_bias"}
    assert list(list_free_parameters(model)) == ["tyre_relaxation.length"]
    assert [f.name() for f in functions.functions][:2] == ["augmented_dynamics", "augmented_step"]


@pytest.mark.parametrize("kind", [casadi.SX, casadi.MX])
def test_every_operation_accepts_casadi_symbols(kind):
    x = kind.sym("x")
    for name in ops.NAMES:
        function = getattr(ops, name)
        other = (0.25,) if name in ("maximum", "minimum") else ()
        evaluate = casadi.Function("f", [x], [function(x, *other)])
        for value in (0.1, 0.25, 0.9):
            assert math.isclose(float(evaluate(value)), function(value, *other), rel_tol=1e-15)
