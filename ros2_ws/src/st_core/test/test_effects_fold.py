"""Effects folded into the vehicle parameters predict the same as the model with these effects."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from effect_values import values_of
from st_core.augmented import augment, fold_effects
from st_core.batch import LogBatch
from st_core.effects import EFFECTS, find_applicable_effects
from st_core.log import DriveLog
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters
from weaving_log import weaving_log

FOLDABLE = [(base, name) for base in MODELS for name in find_applicable_effects(base) if EFFECTS[name].fold]
STARTS = np.array([1_000_000_000, 2_350_000_000, 4_000_000_000])


@pytest.fixture(scope="module")
def vehicle(leaf) -> VehicleParameters:
    return replace(leaf, steering_wheel_offset=0.15, cg_to_ins_y=0.2)


@functools.cache
def vehicle_log(vehicle: VehicleParameters) -> DriveLog:
    """Weaving with the steering wheel angles that this vehicle needs."""
    log = weaving_log()
    return replace(log, steering_wheel_angle=vehicle.steering_wheel_angle(log.road_wheel_angle)).with_steering(vehicle)


@functools.cache
def predict_with_errors(model, vehicle: VehicleParameters, log: DriveLog) -> tuple[np.ndarray, np.ndarray]:
    """(states at the CG, errors at the INS point) over 5 s."""
    batch = LogBatch(log, STARTS, 5.0, 0.05, backend="numpy")
    return batch.predict(model, vehicle), batch.errors(model, vehicle)


def fold_active_effects(model, vehicle: VehicleParameters):
    """(vehicle with the effects it can represent, model without them)."""
    return fold_effects(vehicle, [e for e in model.active_effects if e.fold], model.values), model.select_effects(
        e for e in model.effects if not e.fold)


def assert_folding_is_equivalent(model, vehicle: VehicleParameters) -> tuple[VehicleParameters, tuple[str, ...]]:
    """(folded vehicle, names of the effects that remain in the model), after both are shown to predict the same."""
    log = vehicle_log(vehicle)
    car, remaining = fold_active_effects(model, vehicle)
    expected = predict_with_errors(model, vehicle, log)
    for original, result in zip(expected, predict_with_errors(remaining, car, log.with_steering(car)), strict=True):
        assert np.isfinite(original).all()
        np.testing.assert_allclose(result, original, rtol=0.0, atol=1e-9)
    return car, tuple(effect.name for effect in remaining.effects)


def test_effects_that_a_vehicle_file_can_represent():
    assert {name for _, name in FOLDABLE} == {
        "cg_position", "friction", "front_stiffness", "front_tyre_curve", "load", "mass", "rear_stiffness",
        "rear_tyre_curve", "sensor_lever_arm", "steering_offset", "steering_ratio", "tyre_load_sensitivity",
        "tyre_stiffness", "yaw_inertia"}


@pytest.mark.parametrize("share", [0.7, 1.2])
@pytest.mark.parametrize(("base", "name"), FOLDABLE)
def test_folded_effect_predicts_as_the_model_with_the_effect(vehicle, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    car, remaining = assert_folding_is_equivalent(model, vehicle)
    assert car != vehicle and not remaining
    # The effect is large enough for the comparison to be meaningful.
    _, errors_without = predict_with_errors(MODELS[base], vehicle, vehicle_log(vehicle))
    _, errors_with = predict_with_errors(model, vehicle, vehicle_log(vehicle))
    assert np.abs(errors_with - errors_without).max() > 1e-3


@pytest.mark.parametrize("base", ["linear", "nonlinear"])
def test_all_foldable_effects_at_once_with_others(vehicle, base):
    others = ("heading_misalignment", "position_lag", "road_slope", "steering_delay", "steering_lag", "steering_map",
              "tyre_relaxation", "yaw_rate_bias")
    names = [*others, *(name for kind, name in FOLDABLE if kind == base)]
    values = {name: values_of(name, 0.5 if name not in others else 1.0) for name in names}
    car, remaining = assert_folding_is_equivalent(augment(base, values), vehicle)
    assert set(remaining) == set(others)
    reloaded = VehicleParameters.from_yaml(car.to_yaml())
    assert reloaded.hash == car.hash != vehicle.hash


def test_steering_ratio_and_offset_are_folded_exactly(vehicle):
    """delta = (wheel - offset) / ratio / factor + angle, for every steering wheel angle."""
    model = augment("linear", {"steering_ratio": {"factor": 0.9}, "steering_offset": {"angle": 0.01}})
    car, _ = fold_active_effects(model, vehicle)
    assert car.steering_ratio == pytest.approx(0.9 * vehicle.steering_ratio)
    for wheel in (-3.0, 0.0, 0.15, 5.0):
        expected = (wheel - 0.15) / vehicle.steering_ratio / 0.9 + 0.01
        assert car.road_wheel_angle(wheel) == pytest.approx(expected, abs=1e-15)


def test_effects_at_null_leave_the_vehicle_unchanged(vehicle):
    model = augment("nonlinear", {name: values_of(name, 0.0) for name in ("mass", "steering_ratio", "steering_lag")})
    car, remaining = fold_active_effects(model, vehicle)
    assert car is vehicle and [effect.name for effect in remaining.effects] == ["steering_lag"]
