"""Effects on the sensor side: what they make of a known truth, and the way back, for logs and single samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.effects import EFFECTS, Effect, Measured, Parameter, register
from st_core.errors import ConfigurationError, StCoreError
from st_core.evaluation import Evaluator
from st_core.log import DriveLog
from st_core.models import MODELS
from st_core.prediction import Predictor
from st_core.readings import correct_log, correct_sample, find_missing_reading, predict_readings
from st_core.types import InsSample, VehicleState, body_to_map, ins_to_cg_acceleration, map_to_body
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
def test_what_the_sensor_shows(effect, values, changed):
    shown = augment("nonlinear", {effect: values}).observe(TRUE)
    for name, value in shown._asdict().items():
        assert value == pytest.approx(changed.get(name, getattr(TRUE, name)), rel=1e-12), name


def test_unit_turned_to_the_left_sees_the_car_drift_to_the_right():
    angle = 0.02
    straight = TRUE._replace(velocity_y=0.0)
    shown = augment("nonlinear", {"heading_misalignment": {"angle": angle}}).observe(straight)
    assert shown.yaw == TRUE.yaw + angle and (shown.x, shown.y) == (TRUE.x, TRUE.y)
    assert shown.velocity_y == pytest.approx(-math.sin(angle) * TRUE.velocity_x)
    # Velocity over ground is what it is, whatever axes it is given in.
    over_ground = [body_to_map(m.velocity_x, m.velocity_y, m.yaw) for m in (shown, straight)]
    assert over_ground[0] == pytest.approx(over_ground[1])


def test_biases_are_added_after_scales_and_taken_off_before():
    model = augment("linear", {"yaw_rate_scale": {"factor": 1.1}, "yaw_rate_bias": {"bias": 0.02}})
    assert model.observe(TRUE).yaw_rate == pytest.approx(1.1 * 0.25 + 0.02)
    assert model.correct(model.observe(TRUE)) == pytest.approx(TRUE)


def test_late_sensors_are_late_behind_all_other_faults():
    """Scale and bias of a late yaw rate are those of the sensor; a position is late by the true velocity."""
    model = augment("linear", {"yaw_rate_scale": {"factor": 1.1}, "yaw_rate_bias": {"bias": 0.02},
                               "yaw_rate_delay": {"time": 0.05}, "speed_scale": {"factor": 1.2},
                               "heading_misalignment": {"angle": 0.05}, "position_lag": {"time": 0.1}})
    shown = model.observe(TRUE)
    assert shown.yaw_rate == pytest.approx(1.1 * (0.25 + 0.05 * 0.4) + 0.02)
    late = augment("linear", {"position_lag": {"time": 0.1}}).observe(TRUE)
    assert (shown.x, shown.y) == pytest.approx((late.x, late.y))
    assert model.correct(shown) == pytest.approx(TRUE)


@pytest.mark.parametrize("base", ["linear", "nonlinear"])
def test_readings_at_the_ins_are_those_of_a_rigid_body(leaf, base):
    model = MODELS[base]
    p = model.parameters(leaf)
    w = model.inputs(0.1, -0.5, p)
    shown = predict_readings(model, leaf, STATE, w, p)
    sample = cg_to_ins(VehicleState(*STATE), 0, leaf.cg_to_ins_x, leaf.cg_to_ins_y)
    assert shown[:6] == pytest.approx(sample[1:])
    derivative = model.rhs(STATE, w, p)
    assert shown.yaw_acceleration == derivative[5] and predict_readings(model, leaf, STATE).yaw_acceleration == 0.0
    at_cg = ins_to_cg_acceleration(shown.acceleration_x, shown.acceleration_y, 0.25, derivative[5],
                                          leaf.cg_to_ins_x, leaf.cg_to_ins_y)
    assert at_cg == pytest.approx((-0.5 - 0.3 * 0.25, derivative[3] + 12.0 * 0.25))
    assert math.isnan(predict_readings(model, leaf, STATE).acceleration_y)


def test_kinematic_model_feels_the_curve_it_drives(leaf):
    model = MODELS["kinematic"]
    p = model.parameters(leaf)
    w = model.inputs(0.1, 0.0, p)
    _, a_y = model.specific_force((0.0, 0.0, 8.0, 0.0, 0.0, 0.0), w, p)
    assert a_y == pytest.approx(8.0**2 * w[1])


def test_lever_arm_moves_the_point_that_is_measured(leaf):
    model = augment("linear", {"sensor_lever_arm": {"x": 0.3, "y": -0.2}})
    here, there = predict_readings(MODELS["linear"], leaf, STATE), predict_readings(model, leaf, STATE)
    forward, left = map_to_body(there.x - here.x, there.y - here.y, 0.7)
    assert (forward, left) == pytest.approx((0.3, -0.2))
    assert there.velocity_y - here.velocity_y == pytest.approx(0.3 * 0.25)
    assert there.velocity_x - here.velocity_x == pytest.approx(0.2 * 0.25)


def test_a_point_above_the_roll_axis_has_the_velocity_of_its_displaced_position():
    time = np.arange(0.0, 4.0, 0.001)
    rate, yaw, speed = 0.3 * np.sin(2.0 * time), 0.15 - 0.15 * np.cos(2.0 * time), 15.0
    x, y = (np.cumsum(speed * direction) * 0.001 for direction in (np.cos(yaw), np.sin(yaw)))
    true = Measured(x, y, yaw, speed + 0.0 * time, 0.0 * time, rate, 0.0, 0.0, 0.6 * np.cos(2.0 * time))
    shown = augment("kinematic", {"sensor_roll": {"shift": 0.01}}).observe(true)
    _, left = map_to_body(shown.x - x, shown.y - y, yaw)
    np.testing.assert_allclose(left, -0.01 * speed * rate, atol=1e-9)  # to the outside of the bend
    forward, left = map_to_body(np.gradient(shown.x, time), np.gradient(shown.y, time), yaw)
    np.testing.assert_allclose(np.stack((forward, left))[:, 5:-5],
                               np.stack((shown.velocity_x, shown.velocity_y))[:, 5:-5], atol=0.01)


def test_logs_and_samples_are_corrected_alike():
    model = augment("nonlinear", ["heading_misalignment", "speed_scale", "yaw_rate_scale", "yaw_rate_bias"])
    time_ns = np.arange(5, dtype=np.int64) * 10_000_000
    columns = [np.linspace(a, a + 0.1, 5) for a in (3.0, 4.0, 0.2, 11.0, 0.1, 0.3)]
    log = DriveLog("short", time_ns, *columns, time_ns, np.zeros(5))
    corrected = correct_log(model, log)
    assert corrected.acceleration_x is None and corrected.acceleration_y is None
    for i in range(5):
        sample = correct_sample(model, InsSample(int(time_ns[i]), *(float(c[i]) for c in columns)))
        assert sample.time_ns == time_ns[i]
        for name in ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate"):
            assert getattr(sample, name) == pytest.approx(getattr(corrected, name)[i], rel=1e-14), name


@pytest.fixture
def leaning():
    """An own effect: a unit on soft mounts, whose yaw is off by what the lateral acceleration presses it."""

    class Leaning(Effect):
        name = "leaning"
        physics = "measured yaw = yaw + gain a_y"
        excited_by = "curves"
        kind, slot = "sensors", "heading"
        parameters = (Parameter("gain", "rad s^2/m", null=0.0, initial=0.001, bounds=(-0.1, 0.1), odd=False,
                                meaning="to the side it is pressed to", source="invented"),)

        @staticmethod
        def observe(measured, theta):
            return measured._replace(yaw=measured.yaw + theta.gain * measured.acceleration_y)

        @staticmethod
        def correct(measured, theta):
            return measured._replace(yaw=measured.yaw - theta.gain * measured.acceleration_y)

    register(Leaning)
    yield augment("linear", {"leaning": {"gain": 0.01}, "yaw_rate_bias": {"bias": 0.02}})
    del EFFECTS["leaning"]


def test_a_correction_that_needs_an_acceleration_is_made_of_the_measured_one_or_not_at_all(leaf, leaning):
    time_ns = np.arange(5, dtype=np.int64) * 10_000_000
    columns = [np.linspace(a, a + 0.1, 5) for a in (3.0, 4.0, 0.2, 11.0, 0.1, 0.3)]
    log = DriveLog("short", time_ns, *columns, time_ns, np.zeros(5))
    measured = replace(log, acceleration_y=np.full(5, 2.0))
    np.testing.assert_allclose(correct_log(leaning, measured).yaw, log.yaw - 0.02, rtol=1e-14)
    with pytest.raises(StCoreError, match="short: effect leaning needs acceleration_y, which was not recorded"):
        correct_log(leaning, log)
    with pytest.raises(ConfigurationError, match="effect leaning needs acceleration_y, which is not measured live"):
        Predictor(leaf, [leaning])
    with pytest.raises(ConfigurationError, match="effect leaning needs acceleration_y, which is not measured live"):
        Evaluator(leaf, models=[leaning])
    assert math.isnan(correct_sample(leaning, InsSample(5, 1.0, 2.0, 0.3, 4.0, 0.5, 0.6)).yaw)


def test_no_effect_of_the_library_needs_an_acceleration_to_correct_the_rest():
    for effect in EFFECTS.values():
        if effect.correct:
            assert find_missing_reading(augment("linear", [effect.name]), ("acceleration_x", "acceleration_y")) is None


def test_models_without_sensor_effects_hand_samples_through():
    sample = InsSample(5, 1.0, 2.0, 0.3, 4.0, 0.5, 0.6)
    assert correct_sample(MODELS["linear"], sample) is sample
    assert correct_sample(augment("linear", ["mass"]), sample) is sample
