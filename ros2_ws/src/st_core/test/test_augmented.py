"""Models with effects added: what is refused, what a fit may change, and that nothing is made anew for new values."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import AugmentedModel, augment, set_effects_to_null
from st_core.composition import AugmentedParameters
from st_core.effects import EFFECTS, applicable
from st_core.errors import ConfigurationError
from st_core.models import MODELS, get_model
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState

STATE, HELD = VehicleState(0.0, 0.0, 12.0, 0.1, 0.3, 0.2), ControlInput(0.08, -0.5)


@pytest.mark.parametrize(("base", "effects", "message"), [
    ("bicycle", [], "unknown model 'bicycle'"),
    ("linear", ["frction"], "unknown effect 'frction', did you mean friction?"),
    ("linear", ["friction"], "effect friction: does not apply to a linear model, only to nonlinear"),
    ("kinematic", ["mass"], "effect mass: does not apply to a kinematic model, only to linear or nonlinear"),
    ("nonlinear", ["tyre_saturation"], "effect tyre_saturation: does not apply to a nonlinear model"),
    ("linear", ["mass", "mass"], "duplicate name"),
    ("linear", {"mass": {}}, "effect mass: factor: no value given"),
    ("linear", {"mass": {"factor": 9.0}}, "effect mass: factor: 9.0 is outside 0.6 to 2 1"),
    ("linear", {"mass": {"factor": "heavy"}}, "effect mass: factor: 'heavy' is not a number"),
    ("linear", {"mass": {"factor": True}}, "effect mass: factor: True is not a number"),
    ("linear", {"mass": {"factor": 1.0, "faktor": 1.0}}, "effect mass: faktor: unknown parameter; it has factor"),
])
def test_what_is_refused(base, effects, message):
    with pytest.raises(ConfigurationError, match=message):
        augment(base, effects)


def test_effects_that_make_no_car_are_refused_by_name_of_the_quantity(leaf):
    short = replace(leaf, cg_to_front_axle=0.4)
    with pytest.raises(ConfigurationError, match="cg_to_front_axle"):
        predict(augment("linear", {"cg_position": {"shift": 0.5}}), short, STATE, HELD)


def test_a_lift_opens_the_effects_of_the_kind_it_leads_to(leaf):
    model = augment("kinematic", ["tyre_slip", "tyre_saturation", "friction", "tyre_relaxation", "mass"])
    expected = augment("nonlinear", ["friction", "tyre_relaxation", "mass"])
    np.testing.assert_allclose(predict(model, leaf, STATE, HELD).states, predict(expected, leaf, STATE, HELD).states,
                               rtol=1e-12, atol=1e-12)


def test_parameters_nobody_fits_may_be_left_out_or_given(leaf):
    short = augment("nonlinear", {"roll_steer": {"gradient": 0.001}})
    whole = augment("nonlinear", {"roll_steer": {"gradient": 0.001, "frequency": 2.0, "damping": 0.4}})
    assert short.values == whole.values
    slow = augment("nonlinear", {"roll_steer": {"gradient": 0.001, "frequency": 1.0}})
    assert not np.allclose(predict(slow, leaf, STATE, HELD).states, predict(short, leaf, STATE, HELD).states)


@pytest.mark.parametrize(("effect", "key", "value"), [
    ({"lateral_load_transfer": {"share": 1.0}}, "track_width", 1.3),
    ({"lateral_load_transfer": {"share": 1.0}}, "load_transfer_front", 0.7),
    ({"steered_drive_force": {"share": 1.0}}, "drive_front", 0.0),
    ({"combined_slip": {"share": 1.0}}, "drive_front", 0.0),
    ({"crosswind": {"wind_x": 0.0, "wind_y": 9.0}}, "side_area", 5.0),
    ({"crosswind": {"wind_x": 0.0, "wind_y": 9.0}}, "side_force_arm", -0.3),
])
def test_constants_come_from_the_car(leaf, effect, key, value):
    other, power = replace(leaf, **{key: value}), ControlInput(0.1, 1.5)
    paths = [predict(augment("nonlinear", effect), car, STATE, power).states for car in (leaf, other)]
    assert np.abs(paths[0] - paths[1]).max() > 1e-3
    bare = [predict("nonlinear", car, STATE, power).states for car in (leaf, other)]
    np.testing.assert_array_equal(*bare)  # nothing else reads it


def test_free_parameters_as_a_vector():
    model = augment("nonlinear", ["crosswind", "friction", "roll_steer"])
    names = [(effect, p.name) for effect, p in model.free]
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


def test_new_values_make_no_new_functions(leaf):
    model = augment("nonlinear", ["friction", "tyre_relaxation", "steering_offset"])
    for other in (model.with_vector(0.9 * model.vector), set_effects_to_null(model),
                  augment("nonlinear", ["steering_offset", "tyre_relaxation", "friction"])):
        assert other.rhs is model.rhs and other.inputs is model.inputs and other.start is model.start
        p, q = model.parameters(leaf), other.parameters(leaf)
        assert type(p) is type(q) is AugmentedParameters
        assert [type(theta) for theta in p.effects] == [type(theta) for theta in q.effects]


@pytest.mark.parametrize("names", [["mass"], ["friction", "steering_delay"], ["sensor_lever_arm", "yaw_rate_bias"]])
def test_effects_beside_the_equations_leave_those_of_the_base(leaf, names):
    model, base = augment("nonlinear", names), MODELS["nonlinear"]
    assert model.rhs is base.rhs and model.inputs is base.inputs
    assert type(model.parameters(leaf)) is type(base.parameters(leaf))


def test_parameters_hold_floats_and_travel_between_processes(car):
    def leaves(p):
        return [x for part in p for x in leaves(part)] if isinstance(p, tuple) else [p]

    for base in MODELS:
        p = augment(base, applicable(base)).parameters(car)
        assert all(type(x) is float for x in leaves(p))
        assert pickle.loads(pickle.dumps(p)) == p
        assert all(type(a) is type(b) for a, b in zip(pickle.loads(pickle.dumps(p)).effects, p.effects, strict=True))


@pytest.mark.parametrize("base", [pytest.param(m, marks=[] if m == "kinematic" else pytest.mark.slow) for m in MODELS])
def test_one_set_of_functions_serves_every_choice_of_effects(leaf, base):
    everything = set_effects_to_null(augment(base, applicable(base)))
    plain = predict(base, leaf, STATE, HELD)
    np.testing.assert_array_equal(predict(everything, leaf, STATE, HELD).states, plain.states)
    assert not everything.has_steering_dynamics and not everything.has_sensor_effects
    assert everything.effective_vehicle(leaf) is leaf
    for name in applicable(base):
        alone = augment(base, [name])
        chosen = everything.with_values({name: alone.values[name]})
        assert chosen.rhs is everything.rhs
        assert chosen.has_steering_dynamics == alone.has_steering_dynamics
        assert chosen.has_sensor_effects == alone.has_sensor_effects
        np.testing.assert_allclose(predict(chosen, leaf, STATE, HELD).states, predict(alone, leaf, STATE, HELD).states,
                                   rtol=1e-13, atol=1e-13)


def test_without_costly_effects_at_null_the_same_is_predicted(leaf):
    everything = set_effects_to_null(augment("nonlinear", applicable("nonlinear")))
    chosen = everything.with_values({"mass": {"factor": 1.1}, "steering_compliance": {"compliance": 1e-6}})
    lean = chosen.without_null_effects()
    left_out = {e.name for e in chosen.effects} - {e.name for e in lean.effects}
    assert left_out == {"lateral_load_transfer", "longitudinal_load_transfer"}  # the compliance is not at null
    np.testing.assert_array_equal(predict(lean, leaf, STATE, HELD).states, predict(chosen, leaf, STATE, HELD).states)
    assert {"steering_compliance"} == {e.name for e in lean.effects if e.costly}


def test_a_linear_car_does_without_tyres_that_saturate_at_null(leaf):
    everything = set_effects_to_null(augment("linear", applicable("linear"))).with_values({"mass": {"factor": 1.1}})
    lean = everything.without_null_effects()
    assert {e.name for e in everything.effects} - {e.name for e in lean.effects} >= {"tyre_saturation"}
    states = [predict(model, leaf, STATE, HELD).states for model in (lean, everything)]
    np.testing.assert_array_equal(*states)
    saturated = everything.with_values({"tyre_saturation": {"share": 0.5}}).without_null_effects()
    assert "tyre_saturation" in {e.name for e in saturated.effects}


def test_more_effects_on_a_model_that_has_some(leaf):
    first = augment("linear", {"mass": {"factor": 1.2}})
    both = augment(first, {"yaw_inertia": {"factor": 0.9}})
    assert both.base is MODELS["linear"] and dict(both.values["mass"]) == {"factor": 1.2}
    expected = augment("linear", {"mass": {"factor": 1.2}, "yaw_inertia": {"factor": 0.9}})
    np.testing.assert_array_equal(predict(both, leaf, STATE, HELD).states, predict(expected, leaf, STATE, HELD).states)
    with pytest.raises(ConfigurationError, match="effect mass: already in the model"):
        augment(first, ["mass"])


def test_no_effect_at_all_is_the_base(leaf):
    model = augment("nonlinear", [])
    assert isinstance(model, AugmentedModel) and get_model(model) is model
    plain = predict("nonlinear", leaf, STATE, HELD)
    np.testing.assert_array_equal(predict(model, leaf, STATE, HELD).states, plain.states)


def test_effects_are_sorted_by_the_order_they_act_in():
    model = augment("linear", ["steering_lag", "steering_backlash", "steering_delay"])
    assert [e.name for e in model.effects] == ["steering_delay", "steering_backlash", "steering_lag"]
    assert sorted(EFFECTS, key=lambda n: EFFECTS[n].order).index("tyre_relaxation") < 20
