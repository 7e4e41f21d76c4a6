"""Sensor effects against the recording checks: both give the same value; delayed channels are corrected."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import SILENT, Noise, delay, exact_drive
from st_core.augmented import augment
from st_core.checks import check
from st_core.effects import EFFECTS, Measured
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog
from st_core.readings import correct_log

SENSOR_ESTIMATES = {(name, p.name): p.identity
                    for name, effect in EFFECTS.items() for p in effect.parameters if p.identity}


def apply_to_ins(log: DriveLog, effect: str, parameter: str, value: float) -> DriveLog:
    """The log as an INS with this effect would have recorded it."""
    model = augment("nonlinear", {effect: {parameter: value}})
    readings = model.observe(Measured(*(getattr(log, name) for name in Measured._fields)))
    return replace(log, **{name: getattr(readings, name) for name in Measured._fields if name in (
        *INS_SIGNALS, *OPTIONAL_INS_SIGNALS)})


@pytest.fixture(scope="module")
def drive(leaf) -> DriveLog:
    return exact_drive(leaf, 90.0, noise=Noise())


def test_effects_with_a_sensor_estimate():
    assert SENSOR_ESTIMATES == {
        ("heading_misalignment", "angle"): "heading_misaligned",
        ("lateral_acceleration_bias", "bias"): "acceleration_y_bias", ("position_lag", "time"): "position_lag",
        ("speed_scale", "factor"): "velocity_scale", ("yaw_rate_bias", "bias"): "yaw_rate_bias",
        ("yaw_rate_delay", "time"): "yaw_rate_lag", ("yaw_rate_scale", "factor"): "yaw_rate_scale"}
    assert all(EFFECTS[effect].kind == "sensors" for effect, _ in SENSOR_ESTIMATES)


@pytest.mark.slow
@pytest.mark.parametrize("multiple", [-2.5, 2.5])  # a bank may cause a smaller misalignment
@pytest.mark.parametrize(("effect", "parameter"), SENSOR_ESTIMATES)
def test_check_estimates_the_value_of_the_effect(leaf, drive, effect, parameter, multiple):
    p = next(p for p in EFFECTS[effect].parameters if p.name == parameter)
    value = p.null + multiple * (p.initial - p.null)
    found, low, high = check(apply_to_ins(drive, effect, parameter, value), leaf).estimates[p.identity]
    assert low < value < high
    assert found == pytest.approx(value, abs=0.03 * abs(value - p.null))


def root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("effect", "channels", "seconds", "remaining_share"), [
    ("yaw_rate_delay", ("yaw_rate",), 0.03, 0.04), ("yaw_rate_delay", ("yaw_rate",), -0.05, 0.06),
    ("position_lag", ("x", "y"), 0.05, 0.006), ("position_lag", ("x", "y"), -0.1, 0.012)])
def test_delayed_channels_are_corrected_to_first_order(leaf, effect, channels, seconds, remaining_share):
    true = exact_drive(leaf, 60.0, noise=SILENT)
    recorded = delay(true, seconds, *channels)
    _, true_rows, recorded_rows = np.intersect1d(true.ins_time_ns, recorded.ins_time_ns, return_indices=True)
    corrected = correct_log(augment("linear", {effect: {"time": seconds}}), recorded)
    inside = slice(10, -10)  # one-sided derivatives at the ends
    for name in channels:
        error, residual = (getattr(log, name)[recorded_rows] - getattr(true, name)[true_rows]
                           for log in (recorded, corrected))
        assert root_mean_square(residual[inside]) < remaining_share * root_mean_square(error[inside])


def test_yaw_acceleration_is_the_derivative_of_yaw_rate():
    time_ns = np.sort(np.random.default_rng(3).choice(10_000, 1500, replace=False)).astype(np.int64) * 1_000_000
    t, zero = time_ns * 1e-9, np.zeros(len(time_ns))
    drive = DriveLog("uneven", time_ns, zero, zero, zero, zero, zero, 0.2 * t, time_ns, zero)
    np.testing.assert_allclose(drive.yaw_acceleration, 0.2, rtol=1e-9)
    wave = replace(drive, yaw_rate=0.2 * np.sin(3.0 * t))
    inside = slice(20, -20)
    np.testing.assert_allclose(wave.yaw_acceleration[inside], 0.6 * np.cos(3.0 * t)[inside], atol=8e-3)
    for count in (0, 1):
        np.testing.assert_array_equal(drive.select_ins(np.arange(count)).yaw_acceleration, np.zeros(count))
