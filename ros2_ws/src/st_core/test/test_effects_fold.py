"""Effects put into the vehicle file: the car that has them predicts what the model with them predicts."""

from dataclasses import replace

import numpy as np
import pytest
from effect_values import values_of
from st_core.augmented import augment, fold
from st_core.batch import LogBatch
from st_core.effects import EFFECTS, applicable
from st_core.log import DriveLog
from st_core.models import MODELS
from st_core.timeseries import NANOSECOND
from st_core.vehicle import VehicleParameters

FOLDED = [(base, name) for base in MODELS for name in applicable(base) if EFFECTS[name].fold]
STARTS = np.array([1_000_000_000, 2_350_000_000, 4_000_000_000])


@pytest.fixture(scope="module")
def vehicle(leaf) -> VehicleParameters:
    return replace(leaf, steering_wheel_offset=0.15, cg_to_ins_y=0.2)


def weaving_log(vehicle: VehicleParameters) -> DriveLog:
    time_ns = np.arange(0, 10_000_000_000, 10_000_000, dtype=np.int64)
    t = time_ns * NANOSECOND
    log = DriveLog("weaving", time_ns, 14.0 * t, np.sin(t), 0.1 * np.sin(1.5 * t), 14.0 + np.sin(0.7 * t),
                   0.2 * np.sin(2.0 * t), 0.15 * np.cos(1.5 * t), time_ns, 0.0 * t,
                   vehicle.steering_wheel_angle(0.05 * np.sin(2.0 * t + 0.3)))
    return log.with_steering(vehicle)


def predicted(model, vehicle: VehicleParameters, log: DriveLog) -> tuple[np.ndarray, np.ndarray]:
    """(states at the CG, errors at the INS point) over 5 s."""
    batch = LogBatch(log, STARTS, 5.0, 0.05, backend="numpy")
    return batch.predict(model, vehicle), batch.errors(model, vehicle)


def folded(model, vehicle: VehicleParameters):
    """(vehicle with the effects that it can hold, model without them)."""
    return fold(vehicle, [e for e in model.active if e.fold], model.values), model.select_effects(
        e for e in model.effects if not e.fold)


def assert_folded(model, vehicle: VehicleParameters) -> tuple[VehicleParameters, tuple[str, ...]]:
    """The car with the effects in it and the names of those left, once both are seen to predict the same."""
    log = weaving_log(vehicle)
    car, rest = folded(model, vehicle)
    for mine, theirs in zip(predicted(model, vehicle, log), predicted(rest, car, log.with_steering(car)), strict=True):
        assert np.isfinite(mine).all()
        np.testing.assert_allclose(theirs, mine, rtol=0.0, atol=1e-9)
    return car, tuple(effect.name for effect in rest.effects)


def test_what_a_vehicle_file_can_hold():
    assert {name for _, name in FOLDED} == {
        "cg_position", "friction", "front_stiffness", "front_tyre_curve", "load", "mass", "rear_stiffness",
        "rear_tyre_curve", "sensor_lever_arm", "steering_offset", "steering_ratio", "tyre_load_sensitivity",
        "tyre_stiffness", "yaw_inertia"}


@pytest.mark.parametrize("share", [0.7, 1.2])
@pytest.mark.parametrize(("base", "name"), FOLDED)
def test_in_the_file_or_in_the_model_it_is_the_same(vehicle, base, name, share):
    model = augment(base, {name: values_of(name, share)})
    car, left = assert_folded(model, vehicle)
    assert car != vehicle and not left
    # It is seen that something changed.
    log = weaving_log(vehicle)
    _, before = predicted(MODELS[base], vehicle, log)
    _, after = predicted(model, vehicle, log)
    assert np.abs(after - before).max() > 1e-3


@pytest.mark.parametrize("base", ["linear", "nonlinear"])
def test_all_at_once_and_beside_others(vehicle, base):
    others = ("heading_misalignment", "position_lag", "road_slope", "steering_delay", "steering_lag", "steering_map",
              "tyre_relaxation", "yaw_rate_bias")
    names = [*others, *(name for kind, name in FOLDED if kind == base)]
    values = {name: values_of(name, 0.5 if name not in others else 1.0) for name in names}
    car, left = assert_folded(augment(base, values), vehicle)
    assert set(left) == set(others)
    again = VehicleParameters.from_yaml(car.to_yaml())
    assert again.hash == car.hash != vehicle.hash


def test_steering_is_folded_by_its_own_formula(vehicle):
    """delta = (wheel - offset) / ratio / factor + angle, whatever the wheel reads."""
    model = augment("linear", {"steering_ratio": {"factor": 0.9}, "steering_offset": {"angle": 0.01}})
    car, _ = folded(model, vehicle)
    assert car.steering_ratio == pytest.approx(0.9 * vehicle.steering_ratio)
    for wheel in (-3.0, 0.0, 0.15, 5.0):
        meant = (wheel - 0.15) / vehicle.steering_ratio / 0.9 + 0.01
        assert car.road_wheel_angle(wheel) == pytest.approx(meant, abs=1e-15)


def test_at_null_the_car_stays_as_it_is(vehicle):
    model = augment("nonlinear", {name: values_of(name, 0.0) for name in ("mass", "steering_ratio", "steering_lag")})
    car, rest = folded(model, vehicle)
    assert car is vehicle and [effect.name for effect in rest.effects] == ["steering_lag"]
