"""Parameters identified from driving: true values are recovered from wrong start values."""

from dataclasses import replace

import numpy as np
import pytest
from driven import SILENT, Sensors, drive, steps, straight, weave, with_stiffness
from st_core.augmented import augment
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_fit import MISALIGNMENT, fit_driving
from st_core.identification.driving_prediction import (
    STIFFNESSES,
    fit_stiffness,
    identify_steering,
    identify_yaw_inertia,
)
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import IdentificationError
from st_core.identification.steering import DIRECT_OFFSET, OFFSET, identify_steering_offset
from st_core.readings import correct_log

SPEEDS = {6.0: 0.10, 9.0: 0.07, 12.0: 0.045, 15.0: 0.035}


@pytest.fixture(scope="module")
def weaving(leaf):
    return [drive(leaf, speed, weave(angle), 40.0, seed=1) for speed, angle in SPEEDS.items()]


@pytest.fixture(scope="module")
def noise_free(leaf):
    return [drive(leaf, speed, weave(angle), 40.0, sensors=SILENT) for speed, angle in SPEEDS.items()]


@pytest.fixture
def start_vehicle(leaf):
    """The Leaf with wrong stiffnesses and offset."""
    return with_stiffness(replace(leaf, steering_wheel_offset=0.0), 56_000.0, 130_000.0)


def true_stiffnesses(leaf):
    return [getattr(leaf, name) for name in STIFFNESSES]


def test_regression_recovers_stiffness_of_a_linear_car(leaf, noise_free):
    found = identify_stiffness(noise_free, with_stiffness(leaf, 50_000.0, 50_000.0))
    assert [found[name].value for name in STIFFNESSES] == pytest.approx(true_stiffnesses(leaf), rel=0.005)
    assert found["cornering_stiffness_front"].status == "identified"
    assert len(found.figure["slip_front"]) == len(found.figure["force_front"]) > 5000


@pytest.mark.slow
def test_regression_underestimates_a_saturating_tyre_and_prediction_does_not(leaf):
    """The force of the rear tyre at 2 deg is 12 % below its initial slope; the prediction includes the tyre curve."""
    logs = [drive(leaf, speed, weave(angle), 25.0, model="nonlinear", sensors=SILENT)
            for speed, angle in ((9.0, 0.15), (12.0, 0.105), (15.0, 0.08))]
    regression, prediction = identify_stiffness(logs, leaf), fit_stiffness(logs, leaf)
    assert regression["cornering_stiffness_rear"].value < 0.97 * leaf.cornering_stiffness_rear
    assert [prediction[name].value for name in STIFFNESSES] == pytest.approx(true_stiffnesses(leaf), rel=0.003)


def test_drives_determine_stiffness_only_over_the_axle_load(leaf, weaving):
    """With another mass in the file the stiffnesses are larger in proportion; the result states this assumption."""
    heavy = replace(leaf, mass=1.1 * leaf.mass, yaw_inertia=1.1 * leaf.yaw_inertia)
    found = fit_stiffness(weaving, heavy, "linear")
    assert [found[n].value for n in STIFFNESSES] == pytest.approx([1.1 * v for v in true_stiffnesses(leaf)], rel=0.02)
    assert any(f"mass {heavy.mass:.5g} kg and cg_to_front_axle" in warning for warning in found.warnings)


def test_prediction_fit_recovers_stiffness_from_wrong_start_values(leaf, weaving, start_vehicle):
    found = fit_stiffness(weaving, start_vehicle, "linear")
    for name, value in zip(STIFFNESSES, true_stiffnesses(leaf), strict=True):
        estimate = found[name]
        assert estimate.value == pytest.approx(value, rel=0.02)
        low, high = estimate.interval95
        assert low < value < high and 0 < estimate.standard_uncertainty < 0.02 * value
    assert found.correlation.shape == (2, 2) and found.correlation[0, 0] == 1.0
    assert "blocks of 10 s from 4 runs" in found["cornering_stiffness_front"].verdict


def test_prediction_fit_separates_offset_misalignment_and_gyro_bias(leaf, start_vehicle):
    sensors = Sensors(misalignment=0.01, yaw_rate_bias=0.004)
    logs = [drive(leaf, speed, weave(angle), 40.0, sensors=sensors, seed=3) for speed, angle in SPEEDS.items()]
    found = fit_stiffness(logs, start_vehicle, "linear", additional=("steering_wheel_offset", MISALIGNMENT))
    assert found["steering_wheel_offset"].value == pytest.approx(leaf.steering_wheel_offset, abs=np.deg2rad(0.1))
    assert found[MISALIGNMENT].value == pytest.approx(0.01, abs=0.0005)
    assert [found[name].value for name in STIFFNESSES] == pytest.approx(true_stiffnesses(leaf), rel=0.02)
    assert any("yaw rate bias" in warning and "+0.004" in warning for warning in found.warnings)


def test_linear_model_with_an_effect_gives_a_secant(leaf, weaving):
    """A model with effects has the name "augmented", but its stiffness is that of its linear tyres."""
    found = fit_stiffness(weaving, leaf, augment("linear", {"steering_delay": {"time": 0.0}}))
    assert "Secant from slip angles" in found["cornering_stiffness_front"].verdict


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("identify", [identify_stiffness, identify_steering_offset, identify_ins_mounting,
                                      identify_yaw_inertia])
def test_drives_recorded_at_5_hz_are_rejected(leaf, noise_free, identify):
    """Every interval between samples is a gap, so that no sample is left."""
    with pytest.raises(IdentificationError, match=r"record INS and steering at more than 10 Hz|straight driving: 0"):
        identify([log.select_ins(np.arange(0, len(log.ins_time_ns), 20)) for log in noise_free], leaf)


@pytest.mark.slow
def test_steering_ratio_from_slow_and_fast_bends(leaf, weaving, start_vehicle):
    start = replace(start_vehicle, steering_ratio=19.5)
    found = identify_steering(weaving, start, "linear")
    ratio = found["steering_ratio"]
    assert ratio.value == pytest.approx(leaf.steering_ratio, rel=0.005)
    assert ratio.interval95[0] < leaf.steering_ratio < ratio.interval95[1]
    assert ratio.standard_uncertainty > 0.005 * ratio.value and "a wrong wheelbase" in ratio.verdict
    assert found.estimates[0].parameter == "steering_ratio" and found.correlation.shape == (4, 4)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_steering_offset_by_both_methods(leaf, start_vehicle):
    logs = [drive(leaf, speed, straight, 40.0, seed=2) for speed in (8.0, 12.0)]
    found = identify_steering_offset(logs, start_vehicle)
    for name in (OFFSET, DIRECT_OFFSET):
        assert found[name].value == pytest.approx(leaf.steering_wheel_offset, abs=np.deg2rad(0.1))
    assert not found.warnings and found[OFFSET].status == "identified"


def test_heading_drift_increases_steering_offset_uncertainty(leaf, start_vehicle):
    """The yaw drifts by 0.01 rad/s while the path is straight."""
    log = drive(leaf, 10.0, straight, 60.0, seed=2)
    drifting = replace(log, yaw=log.yaw + 0.01 * np.abs((log.ins_time_ns - log.start_ns) * 1e-9 - 30.0))
    steady, drifted = (identify_steering_offset([one], start_vehicle)[DIRECT_OFFSET] for one in (log, drifting))
    assert drifted.standard_uncertainty > 10 * steady.standard_uncertainty


def test_ins_mounting_from_slow_driving(leaf):
    sensors = Sensors(misalignment=-0.007, lever=(0.12, -0.08))
    logs = [drive(leaf, speed, weave(angle, 14.0), 60.0, sensors=sensors, seed=4)
            for speed, angle in ((3.0, 0.30), (4.0, 0.28), (5.5, 0.18), (7.0, 0.10))]
    found = identify_ins_mounting(logs, leaf)
    assert found["cg_to_ins_x"].value == pytest.approx(leaf.cg_to_ins_x + 0.12, abs=0.02)
    assert found["cg_to_ins_y"].value == pytest.approx(-0.08, abs=0.03)
    assert found[MISALIGNMENT].value == pytest.approx(-0.007, abs=0.0003)
    assert found[MISALIGNMENT].verdict.count(" deg, ") == 2 and found["cg_to_ins_y"].verdict.startswith("-0.")
    low, high = found["cg_to_ins_x"].interval95
    assert low < leaf.cg_to_ins_x + 0.12 < high


def test_lateral_ins_position_needs_tight_bends(leaf):
    logs = [drive(leaf, speed, weave(0.04, 14.0), 60.0, seed=5) for speed in (4.0, 7.0)]
    found = identify_ins_mounting(logs, leaf)
    assert [e.parameter for e in found.estimates] == ["cg_to_ins_x", MISALIGNMENT]
    assert any("cg_to_ins_y is not estimated" in warning for warning in found.warnings)


def test_yaw_inertia_and_dead_time_from_steps(leaf, start_vehicle):
    logs = [drive(leaf, speed, steps(angle), 30.0, sensors=Sensors(delay=0.03), seed=6)
            for speed, angle in ((9.0, 0.05), (14.0, 0.03))]
    start = replace(start_vehicle, yaw_inertia=2300.0, steering_wheel_offset=leaf.steering_wheel_offset)
    found = identify_yaw_inertia(logs, start, "linear")
    inertia = found["yaw_inertia"]
    assert inertia.value == pytest.approx(leaf.yaw_inertia, rel=0.03)
    assert inertia.interval95[0] < leaf.yaw_inertia < inertia.interval95[1]
    assert found["steering_delay"].value == pytest.approx(0.03, abs=0.003)
    assert any("contradicts 2300" in warning for warning in found.warnings)


def test_tyre_relaxation_does_not_bias_yaw_inertia(leaf):
    relaxing = augment("linear", {"tyre_relaxation": {"length": 0.4}})
    logs = [drive(leaf, speed, steps(angle), 30.0, model=relaxing, seed=8)
            for speed, angle in ((9.0, 0.05), (14.0, 0.03))]
    found = identify_yaw_inertia(logs, leaf, "linear")
    inertia = found["yaw_inertia"]
    assert inertia.value == pytest.approx(leaf.yaw_inertia, rel=0.03)
    assert inertia.interval95[0] < leaf.yaw_inertia < inertia.interval95[1]
    assert inertia.standard_uncertainty > 0.005 * leaf.yaw_inertia
    assert any(warning.startswith("Also fitted: tyre_relaxation 0.") for warning in found.warnings)


def test_wrong_steering_ratio_does_not_bias_yaw_inertia(leaf):
    logs = [drive(leaf, speed, steps(angle), 30.0, seed=8) for speed, angle in ((7.0, 0.06), (16.0, 0.025))]
    wrong = replace(leaf, steering_ratio=0.92 * leaf.steering_ratio)
    found = identify_yaw_inertia([log.with_steering(wrong) for log in logs], wrong, "linear")
    inertia = found["yaw_inertia"]
    assert inertia.interval95[0] < leaf.yaw_inertia < inertia.interval95[1]
    assert inertia.value == pytest.approx(leaf.yaw_inertia, rel=0.03)
    assert "trailer" in inertia.verdict and inertia.standard_uncertainty > 0.05 * inertia.value


def test_relaxation_at_its_limit_makes_yaw_inertia_unidentifiable(leaf, monkeypatch):
    """As of a car with a trailer; no relaxation at all, the lower limit, is usual."""
    logs = [drive(leaf, speed, steps(angle), 30.0, seed=8) for speed, angle in ((9.0, 0.05), (14.0, 0.03))]
    for length, status in ((0.0, "identified"), (1.5, "unidentifiable")):
        def fit_at_bound(*args, length=length):
            fit = fit_driving(*args)
            values = np.where(np.array(fit.names) == "tyre_relaxation", length, fit.values)
            return replace(fit, values=values, at_bound=("tyre_relaxation",))
        monkeypatch.setattr("st_core.identification.driving_prediction.fit_driving", fit_at_bound)
        inertia = identify_yaw_inertia(logs, leaf, "linear")["yaw_inertia"]
        assert inertia.status == status
        assert ("tyre_relaxation 1.5 m is at its upper limit" in inertia.verdict) == (length > 0.0)


@pytest.mark.parametrize("measured", [True, False])
def test_ins_that_rolls_with_the_body_does_not_bias_yaw_inertia(leaf, measured):
    """Without lateral velocity, in which the roll appears, it is not fitted."""
    opposite = augment("linear", {"sensor_roll": {"shift": -0.005}})  # its correction moves the INS outwards
    logs = [drive(leaf, speed, weave(angle, 3.0), 30.0, sensors=Sensors(yaw_rate=5e-4), seed=5)
            for speed, angle in ((9.0, 0.07), (12.0, 0.045), (15.0, 0.035))]
    logs = [correct_log(opposite, correct_log(opposite, log)) for log in logs]
    logs = logs if measured else [replace(log, velocity_y=0.0 * log.velocity_y) for log in logs]
    inertia = identify_yaw_inertia(logs, leaf, "linear")["yaw_inertia"]
    assert inertia.interval95[0] < leaf.yaw_inertia < inertia.interval95[1]
    assert inertia.value == pytest.approx(leaf.yaw_inertia, rel=0.015 if measured else 0.03)


def test_stiffness_of_yaw_inertia_includes_its_change_with_the_slip_range(leaf, monkeypatch):
    """As of a car with other tyres than in its file, whose stiffness from gentle driving differs."""
    monkeypatch.setattr("st_core.identification.driving_prediction.estimate_slip_range_uncertainty",
                        lambda *_: {"cornering_stiffness_rear": 9000.0})
    logs = [drive(leaf, speed, steps(angle), 30.0, seed=8) for speed, angle in ((9.0, 0.05), (14.0, 0.03))]
    found = identify_yaw_inertia(logs, leaf, "linear")
    assert found["cornering_stiffness_rear"].standard_uncertainty > 9000.0
    assert found["yaw_inertia"].standard_uncertainty < 0.1 * leaf.yaw_inertia


def test_implausible_yaw_inertia_is_unidentifiable(leaf):
    heavy = replace(leaf, yaw_inertia=9000.0)
    logs = [drive(heavy, speed, steps(angle), 30.0, seed=9) for speed, angle in ((9.0, 0.05), (14.0, 0.03))]
    inertia = identify_yaw_inertia(logs, heavy, "linear")["yaw_inertia"]
    assert inertia.status == "unidentifiable" and "k^2 / (l_f l_r) 3." in inertia.verdict
