"""Models with effects: rejected values, free parameters, and functions that are shared between values."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import AugmentedModel, augment, set_effects_to_null
from st_core.composition import AugmentedParameters
from st_core.effects import find_applicable_effects
from st_core.errors import ConfigurationError
from st_core.models import MODELS, get_model
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState

STATE, INPUTS = VehicleState(0.0, 0.0, 12.0, 0.1, 0.3, 0.2), ControlInput(0.08, -0.5)


@pytest.mark.parametrize(("base", "effects", "message"), [
    ("bicycle", [], "unknown model 'bicycle'"),
    ("linear", ["frction"], "unknown effect 'frction', did you mean friction?"),
    ("linear", "friction", "effect friction: does not apply to a linear model, only to nonlinear"),
    ("kinematic", ["mass"], "effect mass: does not apply to a kinematic model, only to linear or nonlinear"),
    ("nonlinear", ["tyre_saturation"], "effect tyre_saturation: does not apply to a nonlinear model"),
    ("linear", ["mass", "mass"], "duplicate name"),
    ("linear", {"mass": {}}, "effect mass: factor: no value given"),
    ("linear", {"mass": {"factor": 9.0}}, "effect mass: factor: 9.0 is outside 0.6 to 2$"),
    ("linear", {"mass": {"factor": "heavy"}}, "effect mass: factor: 'heavy' is not a number"),
    ("linear", {"mass": {"factor": True}}, "effect mass: factor: True is not a number"),
    ("linear", {"mass": {"faktor": 1.0}}, "effect mass: faktor: unknown parameter; it has factor"),
])
def test_invalid_effects_and_values_are_rejected(base, effects, message):
    with pytest.raises(ConfigurationError, match=message):
        augment(base, effects)


def test_values_outside_vehicle_bounds_name_the_quantity(leaf):
    car = replace(leaf, cg_to_front_axle=0.4)
    with pytest.raises(ConfigurationError, match="cg_to_front_axle"):
        predict(augment("linear", {"cg_position": {"shift": 0.5}}), car, STATE, INPUTS)


def test_kinematic_model_with_tyres_accepts_effects_of_the_nonlinear_model(leaf):
    model = augment("kinematic", ["tyre_slip", "tyre_saturation", "friction", "tyre_relaxation", "mass"])
    expected = augment("nonlinear", ["friction", "tyre_relaxation", "mass"])
    paths = [predict(m, leaf, STATE, INPUTS).states for m in (model, expected)]
    np.testing.assert_allclose(*paths, rtol=1e-12, atol=1e-12)


def test_parameters_that_are_not_fitted_are_optional(leaf):
    defaults = augment("nonlinear", {"roll_steer": {"gradient": 0.001}})
    explicit = augment("nonlinear", {"roll_steer": {"gradient": 0.001, "frequency": 2.0, "damping": 0.4}})
    assert defaults.values == explicit.values
    slower_roll = augment("nonlinear", {"roll_steer": {"gradient": 0.001, "frequency": 1.0}})
    paths = [predict(model, leaf, STATE, INPUTS).states for model in (defaults, slower_roll)]
    assert not np.allclose(*paths)


@pytest.mark.parametrize(("effect", "key", "value"), [
    ({"lateral_load_transfer": {"share": 1.0}}, "track_width", 1.3),
    ({"lateral_load_transfer": {"share": 1.0}}, "load_transfer_front", 0.7),
    ({"steered_drive_force": {"share": 1.0}}, "drive_front", 0.0),
    ({"combined_slip": {"share": 1.0}}, "drive_front", 0.0),
    ({"crosswind": {"wind_x": 0.0, "wind_y": 9.0}}, "side_area", 5.0),
    ({"crosswind": {"wind_x": 0.0, "wind_y": 9.0}}, "side_force_arm", -0.3),
])
def test_effect_constants_come_from_the_vehicle(leaf, effect, key, value):
    cars, inputs = (leaf, replace(leaf, **{key: value})), ControlInput(0.1, 1.5)
    paths = [predict(augment("nonlinear", effect), car, STATE, inputs).states for car in cars]
    assert np.abs(paths[0] - paths[1]).max() > 1e-3
    np.testing.assert_array_equal(*(predict("nonlinear", car, STATE, inputs).states for car in cars))


def test_free_parameters_as_a_vector():
    model = augment("nonlinear", ["crosswind", "friction", "roll_steer"])
    names = [(effect, p.name) for effect, p in model.free_parameters]
    assert names == [("crosswind", "wind_x"), ("crosswind", "wind_y"), ("friction", "factor"),
                     ("roll_steer", "gradient")]
    assert model.vector.tolist() == [1.0, 5.0, 0.8, 0.0005]
    other = model.with_vector([2.0, -3.0, 0.9, 0.001])
    assert other.vector.tolist() == [2.0, -3.0, 0.9, 0.001]
    assert model.vector.tolist() == [1.0, 5.0, 0.8, 0.0005]
    with pytest.raises(ConfigurationError, match="effect friction: factor"):
        model.with_vector([2.0, -3.0, 9.0, 0.001])
    with pytest.raises(ConfigurationError, match="effect mass: not in this model"):
        model.with_values({"mass": {"factor": 1.1}})


def test_new_values_reuse_the_same_functions(leaf):
    model = augment("nonlinear", ["friction", "tyre_relaxation", "steering_offset"])
    for other in (model.with_vector(0.9 * model.vector), set_effects_to_null(model),
                  augment("nonlinear", ["steering_offset", "tyre_relaxation", "friction"])):
        assert other.rhs is model.rhs and other.inputs is model.inputs and other.start is model.start
        p, q = model.parameters(leaf), other.parameters(leaf)
        assert type(p) is type(q) is AugmentedParameters
        assert [type(theta) for theta in p.thetas] == [type(theta) for theta in q.thetas]


@pytest.mark.parametrize("names", [["mass"], ["friction", "steering_delay"], ["sensor_lever_arm", "yaw_rate_bias"]])
def test_effects_outside_the_equations_keep_the_base_functions(leaf, names):
    model, base = augment("nonlinear", names), MODELS["nonlinear"]
    assert model.rhs is base.rhs and model.inputs is base.inputs
    assert type(model.parameters(leaf)) is type(base.parameters(leaf))


def test_parameters_contain_only_floats_and_can_be_pickled(car):
    def leaves(p):
        return [x for part in p for x in leaves(part)] if isinstance(p, tuple) else [p]

    for base in MODELS:
        p = augment(base, find_applicable_effects(base)).parameters(car)
        assert all(type(x) is float for x in leaves(p))
        assert pickle.loads(pickle.dumps(p)) == p
        assert all(type(a) is type(b) for a, b in zip(pickle.loads(pickle.dumps(p)).thetas, p.thetas, strict=True))


@pytest.mark.parametrize("base", [pytest.param(m, marks=[] if m == "kinematic" else pytest.mark.slow) for m in MODELS])
def test_model_with_all_effects_at_null_serves_every_single_effect(leaf, base):
    all_at_null = set_effects_to_null(augment(base, find_applicable_effects(base)))
    plain = predict(base, leaf, STATE, INPUTS)
    np.testing.assert_array_equal(predict(all_at_null, leaf, STATE, INPUTS).states, plain.states)
    assert not all_at_null.has_steering_dynamics and not all_at_null.has_sensor_effects
    assert all_at_null.effective_vehicle(leaf) is leaf
    for name in find_applicable_effects(base):
        single = augment(base, [name])
        model = all_at_null.with_values({name: single.values[name]})
        assert model.rhs is all_at_null.rhs
        assert model.has_steering_dynamics == single.has_steering_dynamics
        assert model.has_sensor_effects == single.has_sensor_effects
        paths = [predict(m, leaf, STATE, INPUTS).states for m in (model, single)]
        np.testing.assert_allclose(*paths, rtol=1e-13, atol=1e-13)


def test_removing_costly_null_effects_keeps_the_prediction(leaf):
    all_at_null = set_effects_to_null(augment("nonlinear", find_applicable_effects("nonlinear")))
    model = all_at_null.with_values({"mass": {"factor": 1.1}, "steering_compliance": {"compliance": 1e-6}})
    reduced = model.without_costly_null_effects()
    removed = {e.name for e in model.effects} - {e.name for e in reduced.effects}
    assert removed == {"lateral_load_transfer", "longitudinal_load_transfer"}  # the compliance is not at null
    np.testing.assert_array_equal(*(predict(m, leaf, STATE, INPUTS).states for m in (reduced, model)))
    assert {"steering_compliance"} == {e.name for e in reduced.effects if e.costly}


def test_linear_model_drops_tyre_saturation_at_null(leaf):
    all_at_null = set_effects_to_null(augment("linear", find_applicable_effects("linear")))
    all_at_null = all_at_null.with_values({"mass": {"factor": 1.1}})
    reduced = all_at_null.without_costly_null_effects()
    assert {e.name for e in all_at_null.effects} - {e.name for e in reduced.effects} >= {"tyre_saturation"}
    states = [predict(model, leaf, STATE, INPUTS).states for model in (reduced, all_at_null)]
    np.testing.assert_array_equal(*states)
    saturated = all_at_null.with_values({"tyre_saturation": {"share": 0.5}}).without_costly_null_effects()
    assert "tyre_saturation" in {e.name for e in saturated.effects}


def test_augmenting_an_augmented_model_adds_effects(leaf):
    first = augment("linear", {"mass": {"factor": 1.2}})
    both = augment(first, {"yaw_inertia": {"factor": 0.9}})
    assert both.base is MODELS["linear"] and dict(both.values["mass"]) == {"factor": 1.2}
    expected = augment("linear", {"mass": {"factor": 1.2}, "yaw_inertia": {"factor": 0.9}})
    np.testing.assert_array_equal(*(predict(model, leaf, STATE, INPUTS).states for model in (both, expected)))
    with pytest.raises(ConfigurationError, match="effect mass: already in the model"):
        augment(first, ["mass"])


def test_augmented_model_without_effects_equals_the_base(leaf):
    model = augment("nonlinear", [])
    assert isinstance(model, AugmentedModel) and get_model(model) is model
    plain = predict("nonlinear", leaf, STATE, INPUTS)
    np.testing.assert_array_equal(predict(model, leaf, STATE, INPUTS).states, plain.states)


def test_steering_effects_are_sorted_by_order_of_action():
    model = augment("linear", ["steering_lag", "steering_backlash", "steering_delay"])
    assert [e.name for e in model.effects] == ["steering_delay", "steering_backlash", "steering_lag"]


@pytest.mark.parametrize("effects", [{}, {"steering_ratio": {"factor": 0.9}}])
def test_effective_road_wheel_angle_is_an_angle(leaf, effects):
    """The first input of a tyre model without effects in its equations is the sine of the angle."""
    angle = np.array([-0.5, 1e-3, 0.5])
    effective = augment("nonlinear", effects).effective_road_wheel_angle(angle, leaf)
    np.testing.assert_allclose(effective / angle, effective[1] / angle[1], rtol=1e-12)
    assert np.array_equal(effective, angle) == (not effects)
