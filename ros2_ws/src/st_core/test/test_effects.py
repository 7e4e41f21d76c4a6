"""What every effect in the registry keeps to: texts, bounds, neutrality, mirror symmetry, standstill, batch, pairs."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from batched import predict_batch
from effect_values import values_of
from st_core import effects
from st_core.augmented import augment, set_effects_to_null
from st_core.effects import ANY, EFFECTS, Measured, applicable
from st_core.errors import ConfigurationError
from st_core.log import DriveLog
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.readings import correct_log, predict_readings
from st_core.timeseries import NANOSECOND
from st_core.types import ControlInput, InputSequence, VehicleState

WANTED = {
    "combined_slip", "cg_position", "crosswind", "friction", "front_saturation", "front_stiffness", "front_tyre_curve",
    "heading_misalignment", "lateral_acceleration_bias", "lateral_load_transfer", "load",
    "longitudinal_load_transfer", "mass", "position_lag", "rear_saturation", "rear_stiffness",
    "rear_tyre_curve", "road_bank", "road_slope", "roll_steer",
    "sensor_lever_arm", "speed_scale", "steered_drive_force", "steering_backlash", "steering_compliance",
    "steering_delay", "steering_lag", "steering_map", "steering_offset", "steering_ratio", "tyre_load_sensitivity",
    "tyre_relaxation", "tyre_saturation", "tyre_slip", "tyre_stiffness", "yaw_inertia", "yaw_rate_bias",
    "yaw_rate_delay", "yaw_rate_scale",
}
CASES = [(base, name) for base in MODELS for name in applicable(base)]
EVERY = pytest.mark.parametrize(("base", "name"), CASES)

STATE = VehicleState(3.0, -2.0, 12.0, 0.1, 0.3, 0.2)
MIRROR = np.array([1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
MIRRORED_LOG = ("y", "yaw", "velocity_y", "yaw_rate", "acceleration_y", "road_wheel_angle")


def mirrored(name: str, values: dict[str, float]) -> dict[str, float]:
    odd = {p.name for p in EFFECTS[name].parameters if p.odd}
    return {key: -value if key in odd else value for key, value in values.items()}


def varied_inputs(steps: int) -> InputSequence:
    time = np.linspace(0.0, 1.0, 2 * steps + 1)
    return InputSequence(0.08 * np.sin(9.0 * time), -1.0 + 2.0 * time)


def weaving_log() -> DriveLog:
    time_ns = np.arange(0, 8_000_000_000, 10_000_000, dtype=np.int64)
    t = time_ns * NANOSECOND
    yaw_rate = 0.3 * np.sin(2.0 * t)
    yaw = 0.15 * (1.0 - np.cos(2.0 * t))
    velocity_x, velocity_y = 12.0 + 0.1 * t, 0.2 * np.sin(2.0 * t)
    return DriveLog("weaving", time_ns, 12.0 * t, np.sin(t), yaw, velocity_x, velocity_y, yaw_rate, time_ns,
                    0.05 * np.sin(2.0 * t), None, np.full_like(t, 0.1), velocity_x * yaw_rate)


def test_the_registry_holds_what_is_wanted_one_file_each():
    assert set(EFFECTS) >= WANTED
    folder = Path(effects.__file__).parent
    own = {name for name in EFFECTS if EFFECTS[name].__module__.startswith("st_core.")}
    assert own == {file.stem for file in folder.glob("*.py") if not file.name.startswith("_")}
    assert all(Path(effects.source_file(EFFECTS[name])).stem == name for name in own)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_texts_and_parameters_are_complete(name):
    effect = EFFECTS[name]
    assert len(effect.physics) > 10 and len(effect.excited_by) > 10 and effect.__module__
    assert effect.applies_to <= ANY
    assert set(effect.confounded_with) | set(effect.members) <= set(EFFECTS) - {name}
    assert effect.fold or effect.kind != "vehicle parameters"
    for p in effect.parameters:
        assert p.unit and p.source and p.meaning
        assert p.bounds[0] <= p.null <= p.bounds[1] and p.bounds[0] <= p.initial <= p.bounds[1]
        assert (p.initial != p.null) is p.fit


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_bounds_are_accepted_and_nothing_beyond(name):
    base = next(m for m in MODELS if m in EFFECTS[name].applies_to)
    initial = values_of(name, 1.0)
    for p in EFFECTS[name].parameters:
        low, high = p.bounds
        for value in p.bounds:
            assert augment(base, {name: {**initial, p.name: value}}).values[name][p.name] == value
        for value in (np.nextafter(low, -np.inf), np.nextafter(high, np.inf), np.nan):
            with pytest.raises(ConfigurationError, match=f"effect {name}: {p.name}: .* is outside .* to .*"):
                augment(base, {name: {**initial, p.name: float(value)}})


@EVERY
def test_null_changes_nothing_to_the_last_bit(car, base, name):
    model = set_effects_to_null(augment(base, [name]))
    for inputs in (ControlInput(0.1, -0.7), varied_inputs(100)):
        plain = predict(base, car, STATE, inputs)
        np.testing.assert_array_equal(predict(model, car, STATE, inputs).states, plain.states)
    assert model.effective_vehicle(car) == car
    log = weaving_log()
    corrected = correct_log(model, log)
    for field in (*Measured._fields, "ins_time_ns", "steering_time_ns", "road_wheel_angle"):
        np.testing.assert_array_equal(getattr(corrected, field), getattr(log, field))
    state = STATE.as_tuple()
    p, p_base = model.parameters(car), MODELS[base].parameters(car)
    w, w_base = model.inputs(0.1, -0.7, p), MODELS[base].inputs(0.1, -0.7, p_base)
    shown = predict_readings(model, car, model.start_state(state, w, p), w, p)
    assert shown == predict_readings(MODELS[base], car, state, w_base, p_base)


@EVERY
def test_initial_value_shows_somewhere(leaf, base, name):
    model = augment(base, [name])
    moved = np.abs(predict(model, leaf, STATE, varied_inputs(100)).states
                   - predict(base, leaf, STATE, varied_inputs(100)).states).max()
    log = weaving_log()
    corrected = correct_log(model, log)
    measured = max(float(np.abs(getattr(corrected, f) - getattr(log, f)).max())
                   for f in (*Measured._fields, "steering_time_ns", "road_wheel_angle"))
    lever = abs(model.effective_vehicle(leaf).cg_to_ins_x - leaf.cg_to_ins_x)
    assert max(moved, measured, lever) > 1e-3


@EVERY
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_mirrored_in_gives_mirrored_out(leaf, base, name, share):
    values = values_of(name, share)
    model, other = augment(base, {name: values}), augment(base, {name: mirrored(name, values)})
    inputs = varied_inputs(100)
    opposite = InputSequence(-inputs.road_wheel_angle, inputs.velocity_x_dot)
    straight = predict(model, leaf, STATE, inputs).states
    turned = predict(other, leaf, VehicleState(*(MIRROR * STATE.as_tuple())), opposite).states
    np.testing.assert_allclose(turned, straight * MIRROR, rtol=1e-12, atol=1e-12)
    log = weaving_log()
    fields = {f: getattr(log, f) for f in log.__dataclass_fields__}
    log_mirrored = DriveLog(**{f: -v if f in MIRRORED_LOG else v for f, v in fields.items()})
    here, there = correct_log(model, log), correct_log(other, log_mirrored)
    for field in MIRRORED_LOG:
        np.testing.assert_allclose(getattr(there, field), -getattr(here, field), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(there.velocity_x, here.velocity_x, rtol=1e-13)


@EVERY
@pytest.mark.parametrize("share", [1.0, 2.0])
def test_down_to_standstill_finite_and_small(car, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    speeds = np.array([-1.0, 0.0, 1e-9, 0.1, 0.5, 1.0, 2.0, 2.9, 3.1])
    starts = np.column_stack([np.broadcast_to(v, speeds.shape) for v in (0.0, 0.0, speeds, 0.2, 0.0, 0.3)])
    paths = [*predict_batch(model, car, starts, np.full(9, 0.4), np.zeros(9))]
    # On floats too, where a division by zero would raise.
    paths += [predict(model, car, VehicleState(*starts[k].tolist()), ControlInput(0.4, 0.0)).states for k in (1, 2)]
    for x, y, _, velocity_y, _, yaw_rate in (path.T[:6] for path in paths):
        assert max(np.abs(x).max(), np.abs(y).max()) < 30.0
        assert np.abs(yaw_rate).max() < 2.5 and np.abs(velocity_y).max() < 4.0
    assert all(np.isfinite(path).all() for path in paths)
    # Braking through standstill.
    path = predict(model, car, VehicleState(0.0, 0.0, 4.0, 0.1, 0.0, 0.2), ControlInput(0.3, -1.5))
    assert np.isfinite(path.states).all()


@EVERY
@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_batch_equals_loop_and_arrays_equal_floats(leaf, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    random = np.random.default_rng(11)
    count = 12
    starts = random.uniform([-100, -100, 5.0, -0.5, -3, -0.5], [100, 100, 20, 0.5, 3, 0.5], (count, 6))
    angle, acceleration = random.uniform(-0.1, 0.1, (count, 41)), random.uniform(-3.0, 3.0, (count, 41))
    batch = predict_batch(model, leaf, starts, angle, acceleration, 1.0)
    held = predict_batch(model, leaf, starts, angle[:, 0], acceleration[:, 0], 1.0)
    for i in range(count):
        start = VehicleState(*starts[i])
        single = predict(model, leaf, start, InputSequence(angle[i], acceleration[i]), 1.0)
        np.testing.assert_allclose(batch[i], single.states, rtol=1e-12, atol=1e-12)
        single = predict(model, leaf, start, ControlInput(angle[i, 0], acceleration[i, 0]), 1.0)
        np.testing.assert_allclose(held[i], single.states, rtol=1e-12, atol=1e-12)


@EVERY
def test_nan_in_gives_nan_out(leaf, base, name):
    model = augment(base, [name])
    inputs = varied_inputs(100)
    angle = inputs.road_wheel_angle.copy()
    angle[100:110] = np.nan
    path = predict(model, leaf, STATE, InputSequence(angle, inputs.velocity_x_dot))
    np.testing.assert_array_equal(path.states[:50], predict(model, leaf, STATE, inputs).states[:50])
    assert np.isnan(path.x[51:]).all() and np.isnan(path.yaw[51:]).all()


@pytest.mark.parametrize("base", MODELS)
def test_any_two_compose(leaf, base):
    inputs = varied_inputs(20)
    alone = {name: predict(augment(base, [name]), leaf, STATE, inputs, 1.0).states for name in applicable(base)}
    for first, second in itertools.combinations(applicable(base), 2):
        both = augment(base, [first, second])
        path = predict(both, leaf, STATE, inputs, 1.0).states
        assert np.isfinite(path).all(), (first, second)
        np.testing.assert_array_equal(path, predict(augment(base, [second, first]), leaf, STATE, inputs, 1.0).states)
        # One of them at null leaves the other as it is alone.
        for name, other in ((first, second), (second, first)):
            off = both.with_values({other: {p.name: p.null for p in EFFECTS[other].parameters}})
            path = predict(off, leaf, STATE, inputs, 1.0).states
            np.testing.assert_allclose(path, alone[name], rtol=1e-14, atol=1e-14)


@EVERY
def test_correct_undoes_observe(leaf, base, name):
    model = augment(base, {name: values_of(name, 1.3)})
    state = STATE.as_tuple()
    p = model.parameters(leaf)
    w = model.inputs(0.1, -0.7, p)
    shown = predict_readings(model, leaf, model.start_state(state, w, p), w, p)
    true = model.correct(shown)
    np.testing.assert_allclose(model.observe(true), shown, rtol=1e-14, atol=1e-15)


@EVERY
def test_order_of_convergence_is_four(leaf, base, name):
    model = augment(base, [name])
    state, end = VehicleState(0.0, 0.0, 12.0, 0.1, 0.3, 0.2), 1.0
    held = ControlInput(0.05, 0.5)

    def final(step):
        return predict(model, leaf, state, held, end, step).states[-1]

    exact = final(0.00125)
    errors = [np.abs(final(step) - exact).max() for step in (0.02, 0.01)]
    assert errors[0] < 1e-5
    if errors[1] > 1e-12:
        assert np.log2(errors[0] / errors[1]) > 3.5
