"""Properties of every registered effect: descriptions, bounds, neutrality at null, symmetry, standstill, batches."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from batched import predict_batch
from effect_values import values_of
from st_core import effects
from st_core.augmented import augment, set_effects_to_null
from st_core.effects import ANY, EFFECTS, Measured, find_applicable_effects
from st_core.errors import ConfigurationError
from st_core.log import DriveLog
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.readings import correct_log, predict_readings
from st_core.types import ControlInput, InputSequence, VehicleState
from weaving_log import weaving_log

REQUIRED_EFFECTS = {
    "combined_slip", "cg_position", "crosswind", "friction", "front_saturation", "front_stiffness", "front_tyre_curve",
    "heading_misalignment", "lateral_acceleration_bias", "lateral_load_transfer", "load",
    "longitudinal_load_transfer", "mass", "position_lag", "rear_saturation", "rear_stiffness",
    "rear_tyre_curve", "road_bank", "road_slope", "roll_steer",
    "sensor_lever_arm", "sensor_roll", "speed_scale", "steered_drive_force", "steering_backlash", "steering_compliance",
    "steering_delay", "steering_lag", "steering_map", "steering_offset", "steering_ratio", "tyre_load_sensitivity",
    "tyre_relaxation", "tyre_saturation", "tyre_slip", "tyre_stiffness", "yaw_inertia", "yaw_rate_bias",
    "yaw_rate_delay", "yaw_rate_scale",
}
EFFECTS_BY_BASE = [(base, name) for base in MODELS for name in find_applicable_effects(base)]
EACH_EFFECT = pytest.mark.parametrize(("base", "name"), EFFECTS_BY_BASE)

STATE = VehicleState(3.0, -2.0, 12.0, 0.1, 0.3, 0.2)
MIRROR = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
MIRRORED_LOG = ("y", "yaw", "velocity_y", "yaw_rate", "acceleration_y", "road_wheel_angle")


def mirror_values(name: str, values: dict[str, float]) -> dict[str, float]:
    odd = {p.name for p in EFFECTS[name].parameters if p.odd}
    return {key: -value if key in odd else value for key, value in values.items()}


def varied_inputs(steps: int) -> InputSequence:
    time = np.linspace(0.0, 1.0, 2 * steps + 1)
    return InputSequence(0.08 * np.sin(9.0 * time), -1.0 + 2.0 * time)


def test_registry_contains_required_effects_one_per_file():
    assert set(EFFECTS) >= REQUIRED_EFFECTS
    folder = Path(effects.__file__).parent
    built_in = {name for name in EFFECTS if EFFECTS[name].__module__.startswith("st_core.")}
    assert built_in == {file.stem for file in folder.glob("*.py") if not file.name.startswith("_")}
    assert all(Path(effects.find_source_file(EFFECTS[name])).stem == name for name in built_in)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_descriptions_and_parameters_are_complete(name):
    effect = EFFECTS[name]
    assert effect.physics.strip() and effect.excited_by.strip()
    assert effect.applies_to <= ANY
    assert set(effect.confounded_with) | set(effect.members) <= set(EFFECTS) - {name}
    assert effect.fold or effect.kind != "vehicle parameters"
    for p in effect.parameters:
        assert p.unit and p.source and p.meaning
        assert p.bounds[0] <= p.null <= p.bounds[1] and p.bounds[0] <= p.initial <= p.bounds[1]
        assert (p.initial != p.null) is p.fit


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_values_at_bounds_are_accepted_and_beyond_are_rejected(name):
    base = next(m for m in MODELS if m in EFFECTS[name].applies_to)
    initial = values_of(name, 1.0)
    for p in EFFECTS[name].parameters:
        low, high = p.bounds
        for value in p.bounds:
            assert augment(base, {name: {**initial, p.name: value}}).values[name][p.name] == value
        for value in (np.nextafter(low, -np.inf), np.nextafter(high, np.inf), np.nan):
            with pytest.raises(ConfigurationError, match=f"effect {name}: {p.name}: .* is outside .* to .*"):
                augment(base, {name: {**initial, p.name: float(value)}})


@pytest.mark.parametrize(("name", "parameter", "invalid", "physical"), [
    ("tyre_load_sensitivity", "factor", (), (0.5,)),  # no published tyre; at 5.0, stiffness is proportional to load
    ("front_tyre_curve", "peak", (0.3, 2.5), (0.3, 2.5)), ("front_tyre_curve", "curvature", (), ()),
    ("combined_slip", "share", (), ())])
def test_bounds_at_which_an_estimate_is_invalid_or_not_named(name, parameter, invalid, physical):
    parameter = next(p for p in EFFECTS[name].parameters if p.name == parameter)
    assert parameter.hard_bounds == invalid and parameter.physical_bounds == physical


@EACH_EFFECT
def test_null_values_leave_predictions_and_readings_bit_identical(car, base, name):
    model = set_effects_to_null(augment(base, [name]))
    for inputs in (ControlInput(0.1, -0.7), varied_inputs(100)):
        plain = predict(base, car, STATE, inputs)
        np.testing.assert_array_equal(predict(model, car, STATE, inputs).states, plain.states)
    assert model.effective_vehicle(car) == car
    log = weaving_log()
    corrected = correct_log(model, log)
    for field in (*Measured._fields, "ins_time_ns", "steering_time_ns", "road_wheel_angle"):
        np.testing.assert_array_equal(getattr(corrected, field), getattr(log, field))
    readings, plain = (predict_readings(m, car, STATE.as_tuple()) for m in (model, MODELS[base]))
    np.testing.assert_array_equal(readings, plain)


@EACH_EFFECT
def test_initial_values_change_predictions_or_readings(leaf, base, name):
    model = augment(base, [name])
    prediction = np.abs(predict(model, leaf, STATE, varied_inputs(100)).states
                        - predict(base, leaf, STATE, varied_inputs(100)).states).max()
    log = weaving_log()
    corrected = correct_log(model, log)
    measured = max(float(np.abs(getattr(corrected, f) - getattr(log, f)).max())
                   for f in (*Measured._fields, "steering_time_ns", "road_wheel_angle"))
    lever = abs(model.effective_vehicle(leaf).cg_to_ins_x - leaf.cg_to_ins_x)
    assert max(prediction, measured, lever) > 1e-3


@EACH_EFFECT
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_mirrored_inputs_give_mirrored_outputs(leaf, base, name, share):
    values = values_of(name, share)
    model, other = augment(base, {name: values}), augment(base, {name: mirror_values(name, values)})
    inputs = varied_inputs(100)
    opposite = InputSequence(-inputs.road_wheel_angle, inputs.velocity_x_dot)
    states = predict(model, leaf, STATE, inputs).states
    mirrored = predict(other, leaf, VehicleState(*(MIRROR * STATE.as_tuple())), opposite).states
    np.testing.assert_allclose(mirrored, states * MIRROR, rtol=1e-12, atol=1e-12)
    log = weaving_log()
    fields = {f: getattr(log, f) for f in log.__dataclass_fields__}
    log_mirrored = DriveLog(**{f: -v if f in MIRRORED_LOG else v for f, v in fields.items()})
    corrected, corrected_mirrored = correct_log(model, log), correct_log(other, log_mirrored)
    for field in MIRRORED_LOG:
        np.testing.assert_allclose(getattr(corrected_mirrored, field), -getattr(corrected, field),
                                   rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(corrected_mirrored.velocity_x, corrected.velocity_x, rtol=1e-13)


@EACH_EFFECT
@pytest.mark.parametrize("share", [1.0, 2.0])
def test_predictions_are_bounded_down_to_standstill(car, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    speeds = np.array([-1.0, 0.0, 1e-9, 0.1, 0.5, 1.0, 2.0, 2.9, 3.1])
    starts = np.column_stack([np.broadcast_to(v, speeds.shape) for v in (0.0, 0.0, speeds, 0.2, 0.0, 0.3)])
    paths = [*predict_batch(model, car, starts, np.full(9, 0.4), np.zeros(9))]
    # Python floats raise on a division by zero, arrays do not.
    paths += [predict(model, car, VehicleState(*starts[k].tolist()), ControlInput(0.4, 0.0)).states for k in (1, 2)]
    for x, y, _, velocity_y, _, yaw_rate in (path.T[:6] for path in paths):
        assert max(np.abs(x).max(), np.abs(y).max()) < 30.0
        assert np.abs(yaw_rate).max() < 2.5 and np.abs(velocity_y).max() < 4.0
    assert all(np.isfinite(path).all() for path in paths)
    # Braking through standstill.
    path = predict(model, car, VehicleState(0.0, 0.0, 4.0, 0.1, 0.0, 0.2), ControlInput(0.3, -1.5))
    assert np.isfinite(path.states).all()


@EACH_EFFECT
@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_batch_equals_loop_and_arrays_equal_floats(leaf, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    random = np.random.default_rng(11)
    count = 12
    starts = random.uniform([-100, -100, 5.0, -0.5, -3, -0.5], [100, 100, 20, 0.5, 3, 0.5], (count, 6))
    angle, acceleration = random.uniform(-0.1, 0.1, (count, 41)), random.uniform(-3.0, 3.0, (count, 41))
    batch = predict_batch(model, leaf, starts, angle, acceleration, 1.0)
    constant = predict_batch(model, leaf, starts, angle[:, 0], acceleration[:, 0], 1.0)
    for i in range(count):
        start = VehicleState(*starts[i])
        single = predict(model, leaf, start, InputSequence(angle[i], acceleration[i]), 1.0)
        np.testing.assert_allclose(batch[i], single.states, rtol=1e-12, atol=1e-12)
        single = predict(model, leaf, start, ControlInput(angle[i, 0], acceleration[i, 0]), 1.0)
        np.testing.assert_allclose(constant[i], single.states, rtol=1e-12, atol=1e-12)


@EACH_EFFECT
def test_nan_input_makes_later_states_nan(leaf, base, name):
    model = augment(base, [name])
    inputs = varied_inputs(100)
    angle = inputs.road_wheel_angle.copy()
    angle[100:110] = np.nan
    path = predict(model, leaf, STATE, InputSequence(angle, inputs.velocity_x_dot))
    np.testing.assert_array_equal(path.states[:50], predict(model, leaf, STATE, inputs).states[:50])
    assert np.isnan(path.x[51:]).all() and np.isnan(path.yaw[51:]).all()


@pytest.mark.parametrize("base", MODELS)
def test_any_two_effects_compose_in_either_order(leaf, base):
    inputs = varied_inputs(20)
    alone = {name: predict(augment(base, [name]), leaf, STATE, inputs, 1.0).states
             for name in find_applicable_effects(base)}
    for first, second in itertools.combinations(find_applicable_effects(base), 2):
        both = augment(base, [first, second])
        path = predict(both, leaf, STATE, inputs, 1.0).states
        assert np.isfinite(path).all(), (first, second)
        np.testing.assert_array_equal(path, predict(augment(base, [second, first]), leaf, STATE, inputs, 1.0).states)
        # With one effect at null, the prediction is that of the other alone.
        for name, other in ((first, second), (second, first)):
            one_at_null = both.with_values({other: {p.name: p.null for p in EFFECTS[other].parameters}})
            path = predict(one_at_null, leaf, STATE, inputs, 1.0).states
            np.testing.assert_allclose(path, alone[name], rtol=1e-14, atol=1e-14)


@EACH_EFFECT
def test_correct_inverts_observe(leaf, base, name):
    model = augment(base, {name: values_of(name, 1.3)})
    readings = Measured(10.0, -4.0, 0.7, 12.0, 0.3, 0.25, 0.4, 2.9, -0.4)
    true = model.correct(readings)
    np.testing.assert_allclose(model.observe(true), readings, rtol=1e-14, atol=1e-15)


@EACH_EFFECT
def test_integration_error_falls_with_fourth_power_of_step(leaf, base, name):
    model = augment(base, [name])
    state, end = VehicleState(0.0, 0.0, 12.0, 0.1, 0.3, 0.2), 1.0
    inputs = ControlInput(0.05, 0.5)

    def final(step):
        return predict(model, leaf, state, inputs, end, step).states[-1]

    exact = final(0.00125)
    errors = [np.abs(final(step) - exact).max() for step in (0.02, 0.01)]
    assert errors[0] < 1e-5
    if errors[1] > 1e-12:
        assert np.log2(errors[0] / errors[1]) > 3.5
