"""Sensor effects: readings for a known true state, and their correction, for logs and single samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.effects import EFFECTS, Effect, Measured, Parameter, register
from st_core.errors import ConfigurationError, StCoreError
from st_core.evaluation import Evaluator
from st_core.log import INS_SIGNALS, DriveLog
from st_core.models import MODELS
from st_core.prediction import Predictor
from st_core.readings import correct_log, correct_sample, find_missing_reading, predict_readings
from st_core.types import InsSample, VehicleState, body_to_map, map_to_body
from steady_circle import cg_to_ins

TRUE = Measured(x=10.0, y=-4.0, yaw=0.7, velocity_x=12.0, velocity_y=0.3, yaw_rate=0.25, acceleration_x=0.4,
                acceleration_y=2.9, yaw_acceleration=-0.4)
STATE = (10.0, -4.0, 12.0, 0.3, 0.7, 0.25)


@pytest.mark.parametrize(("effect", "values", "changed"), [
    ("yaw_rate_bias", {"bias": 0.01}, {"yaw_rate": 0.26}),
    ("speed_scale", {"factor": 0.5 + 0.4}, {"velocity_x": 10.8, "velocity_y": 0.27}),
    ("yaw_rate_scale", {"factor": 1.04}, {"yaw_rate": 0.26, "yaw_acceleration": -0.416}),
    ("yaw_rate_delay", {"time": 0.05}, {"yaw_rate": 0.27}),
    ("lateral_acceleration_bias", {"bias": -0.2}, {"acceleration_y": 2.7}),
    ("position_lag", {"time": 0.1}, {"x": 10.0 - 0.1 * (12.0 * math.cos(0.7) - 0.3 * math.sin(0.7)),
                                     "y": -4.0 - 0.1 * (12.0 * math.sin(0.7) + 0.3 * math.cos(0.7))}),
])
def test_observe_applies_the_sensor_error(effect, values, changed):
    readings = augment("nonlinear", {effect: values}).observe(TRUE)
    for name, value in readings._asdict().items():
        assert value == pytest.approx(changed.get(name, getattr(TRUE, name)), rel=1e-12), name


def test_ins_misaligned_to_the_left_measures_velocity_to_the_right():
    angle = 0.02
    straight = TRUE._replace(velocity_y=0.0)
    readings = augment("nonlinear", {"heading_misalignment": {"angle": angle}}).observe(straight)
    assert readings.yaw == TRUE.yaw + angle and (readings.x, readings.y) == (TRUE.x, TRUE.y)
    assert readings.velocity_y == pytest.approx(-math.sin(angle) * TRUE.velocity_x)
    # The velocity in map axes does not depend on the axes of the unit.
    over_ground = [body_to_map(m.velocity_x, m.velocity_y, m.yaw) for m in (readings, straight)]
    assert over_ground[0] == pytest.approx(over_ground[1])


def test_bias_is_added_after_scale_and_subtracted_before_it():
    model = augment("linear", {"yaw_rate_scale": {"factor": 1.1}, "yaw_rate_bias": {"bias": 0.02}})
    assert model.observe(TRUE).yaw_rate == pytest.approx(1.1 * 0.25 + 0.02)
    assert model.correct(model.observe(TRUE)) == pytest.approx(TRUE)


def test_delay_combines_with_scale_bias_and_misalignment():
    """Scale and bias apply to the delayed yaw rate; a position lags by the true velocity."""
    model = augment("linear", {"yaw_rate_scale": {"factor": 1.1}, "yaw_rate_bias": {"bias": 0.02},
                               "yaw_rate_delay": {"time": 0.05}, "speed_scale": {"factor": 1.2},
                               "heading_misalignment": {"angle": 0.05}, "position_lag": {"time": 0.1}})
    readings = model.observe(TRUE)
    assert readings.yaw_rate == pytest.approx(1.1 * (0.25 + 0.05 * 0.4) + 0.02)
    lagged = augment("linear", {"position_lag": {"time": 0.1}}).observe(TRUE)
    assert (readings.x, readings.y) == pytest.approx((lagged.x, lagged.y))
    assert model.correct(readings) == pytest.approx(TRUE)


def test_readings_at_the_ins_follow_rigid_body_kinematics(leaf):
    readings = predict_readings(MODELS["linear"], leaf, STATE)
    sample = cg_to_ins(VehicleState(*STATE), 0, leaf.cg_to_ins_x, leaf.cg_to_ins_y)
    assert readings[:6] == pytest.approx(sample[1:])
    assert math.isnan(readings.acceleration_y) and readings.yaw_acceleration == 0.0


def test_lever_arm_moves_the_measured_point(leaf):
    model = augment("linear", {"sensor_lever_arm": {"x": 0.3, "y": -0.2}})
    plain, moved = predict_readings(MODELS["linear"], leaf, STATE), predict_readings(model, leaf, STATE)
    forward, left = map_to_body(moved.x - plain.x, moved.y - plain.y, 0.7)
    assert (forward, left) == pytest.approx((0.3, -0.2))
    assert moved.velocity_y - plain.velocity_y == pytest.approx(0.3 * 0.25)
    assert moved.velocity_x - plain.velocity_x == pytest.approx(0.2 * 0.25)


def test_velocity_above_roll_axis_is_the_derivative_of_its_position():
    time = np.arange(0.0, 4.0, 0.001)
    rate, yaw, speed = 0.3 * np.sin(2.0 * time), 0.15 - 0.15 * np.cos(2.0 * time), 15.0
    x, y = (np.cumsum(speed * direction) * 0.001 for direction in (np.cos(yaw), np.sin(yaw)))
    true = Measured(x, y, yaw, speed + 0.0 * time, 0.0 * time, rate, 0.0, 0.0, 0.6 * np.cos(2.0 * time))
    readings = augment("kinematic", {"sensor_roll": {"shift": 0.01}}).observe(true)
    _, left = map_to_body(readings.x - x, readings.y - y, yaw)
    np.testing.assert_allclose(left, -0.01 * speed * rate, atol=1e-9)  # to the outside of the bend
    forward, left = map_to_body(np.gradient(readings.x, time), np.gradient(readings.y, time), yaw)
    np.testing.assert_allclose(np.stack((forward, left))[:, 5:-5],
                               np.stack((readings.velocity_x, readings.velocity_y))[:, 5:-5], atol=0.01)


def short_log() -> DriveLog:
    time_ns = np.arange(5, dtype=np.int64) * 10_000_000
    columns = [np.linspace(a, a + 0.1, 5) for a in (3.0, 4.0, 0.2, 11.0, 0.1, 0.3)]
    return DriveLog("short", time_ns, *columns, time_ns, np.zeros(5))


def test_logs_and_samples_are_corrected_equally():
    model = augment("nonlinear", ["heading_misalignment", "speed_scale", "yaw_rate_scale", "yaw_rate_bias"])
    log = short_log()
    corrected = correct_log(model, log)
    assert corrected.acceleration_x is None and corrected.acceleration_y is None
    for i in range(5):
        measured = [float(getattr(log, name)[i]) for name in INS_SIGNALS]
        sample = correct_sample(model, InsSample(int(log.ins_time_ns[i]), *measured))
        assert sample.time_ns == log.ins_time_ns[i]
        for name in INS_SIGNALS:
            assert getattr(sample, name) == pytest.approx(getattr(corrected, name)[i], rel=1e-14), name


@pytest.fixture
def soft_mount():
    """A user effect: a unit on soft mounts, whose yaw error is proportional to lateral acceleration."""

    class SoftMount(Effect):
        name = "soft_mount"
        physics = "measured yaw = yaw + gain a_y"
        excited_by = "curves"
        kind, slot = "sensors", "heading"
        parameters = (Parameter("gain", "rad s^2/m", null=0.0, initial=0.001, bounds=(-0.1, 0.1), odd=False,
                                meaning="yaw error per lateral acceleration", source="invented"),)

        @staticmethod
        def observe(measured, theta):
            return measured._replace(yaw=measured.yaw + theta.gain * measured.acceleration_y)

        @staticmethod
        def correct(measured, theta):
            return measured._replace(yaw=measured.yaw - theta.gain * measured.acceleration_y)

    register(SoftMount)
    yield augment("linear", {"soft_mount": {"gain": 0.01}, "yaw_rate_bias": {"bias": 0.02}})
    del EFFECTS["soft_mount"]


def test_correction_that_needs_acceleration_requires_it_to_be_measured(leaf, soft_mount):
    log = short_log()
    measured = replace(log, acceleration_y=np.full(5, 2.0))
    np.testing.assert_allclose(correct_log(soft_mount, measured).yaw, log.yaw - 0.02, rtol=1e-14)
    with pytest.raises(StCoreError, match="short: effect soft_mount needs acceleration_y, which was not recorded"):
        correct_log(soft_mount, log)
    with pytest.raises(ConfigurationError, match="effect soft_mount needs acceleration_y, which is not measured live"):
        Predictor(leaf, [soft_mount])
    with pytest.raises(ConfigurationError, match="effect soft_mount needs acceleration_y, which is not measured live"):
        Evaluator(leaf, models=[soft_mount])
    assert math.isnan(correct_sample(soft_mount, InsSample(5, 1.0, 2.0, 0.3, 4.0, 0.5, 0.6)).yaw)


def test_no_built_in_effect_needs_acceleration_for_its_correction():
    for effect in EFFECTS.values():
        if effect.correct:
            assert find_missing_reading(augment("linear", [effect.name]), ("acceleration_x", "acceleration_y")) is None


def test_signal_without_a_reading_is_not_a_missing_reading():
    assert find_missing_reading(augment("linear", ["yaw_rate_scale"]), ("a_later_signal",)) is None


def test_models_without_sensor_effects_return_samples_unchanged():
    sample = InsSample(5, 1.0, 2.0, 0.3, 4.0, 0.5, 0.6)
    assert correct_sample(MODELS["linear"], sample) is sample
    assert correct_sample(augment("linear", ["mass"]), sample) is sample
