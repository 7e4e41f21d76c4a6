"""Contributions to the error by cause, for known causes: a parameter, the start state, noise."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.bands.error_budget import PARAMETERS, SENSORS, sum_squared_contributions
from st_core.log import INS_SIGNALS, DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.models import get_model
from st_core.regression import white_noise
from st_core.vehicle import Provenance
from steady_circle import Circle

SETTINGS = EvaluationSettings()
SPEED, SECONDS = 10.0, 20.0


def straight_drive(noise: float = 0.0, offset: float = 0.0) -> DriveLog:
    """Straight at constant speed; white noise [m, m/s, rad, ...] on all INS signals; steering error `offset` [rad]."""
    time = np.arange(0.0, SECONDS, 0.01)
    draw, zero = np.random.default_rng(3), np.zeros(len(time))
    ns = np.round(time * 1e9).astype(np.int64)
    values = [SPEED * time, zero, zero, zero + SPEED, zero, zero]
    return DriveLog("straight", ns, *(v + noise * draw.standard_normal(len(time)) for v in values), ns, zero + offset)


def contributions(model, vehicle, log, intervals=None):
    count, total, parts = sum_squared_contributions(get_model(model), vehicle, SETTINGS.signals(log), SETTINGS,
                                                    intervals)
    return total / count, {cause: squares / count for cause, squares in parts.items()}


def test_white_noise_is_estimated_without_the_motion():
    log = straight_drive(0.02)
    assert all(white_noise(getattr(log, name)) == pytest.approx(0.02, rel=0.1) for name in INS_SIGNALS)
    assert white_noise(np.sin(2.0 * np.arange(0.0, 20.0, 0.01))) < 1e-5


def test_start_state_noise_propagates_to_the_end_of_the_path(leaf):
    _, parts = contributions("kinematic", leaf, straight_drive(0.01))
    yaw = np.sqrt(parts[SENSORS, "yaw at the start"])
    assert yaw[4, 1] == pytest.approx(0.01 * SPEED * 5.0, rel=0.15)
    assert yaw[0, 1] == pytest.approx(0.01 * SPEED * 1.0, rel=0.2)
    assert yaw[:, 2] == pytest.approx(0.01, rel=0.1)
    speed = np.sqrt(parts[SENSORS, "velocity_x at the start"])
    assert speed[:, 0] == pytest.approx(0.01 * np.arange(1, 6), rel=0.15)
    assert np.sqrt(parts[SENSORS, "pose at the end"])[0, 0] == pytest.approx(0.01, rel=0.15)


def test_parameter_error_of_one_standard_deviation_explains_the_whole_error(leaf):
    """Wheelbase wrong by its own standard deviation: error and contribution are equal to first order."""
    angle = 0.06  # rad
    yaw_rate = SPEED / leaf.wheelbase * np.tan(angle)  # no slip at the rear axle
    log = Circle(SPEED, leaf.cg_to_rear_axle * yaw_rate, yaw_rate, leaf.cg_to_ins_x).log(angle, SECONDS)
    stated = replace(leaf.with_values({"wheelbase": leaf.wheelbase * 1.02}),
                     provenance={"wheelbase": Provenance(0.02 * leaf.wheelbase)})
    total, parts = contributions("kinematic", stated, log)
    assert set(cause for cause in parts if cause[0] == PARAMETERS) == {(PARAMETERS, "wheelbase")}
    assert parts[PARAMETERS, "wheelbase"][4, 1] == pytest.approx(total[4, 1], rel=0.15)
    assert sum(squares[4, 1] for cause, squares in parts.items() if cause[0] == SENSORS) < 0.01 * total[4, 1]


def test_interval_of_a_model_file_counts_as_a_standard_deviation(leaf):
    model = augment("kinematic", {"steering_offset": {"angle": 0.01}})
    interval = 0.01 - 0.00196, 0.01 + 0.00196
    _, parts = contributions(model, leaf, straight_drive(), {("steering_offset", "angle"): interval})
    # Lateral deviation for 0.001 rad at the wheels: v^2 t^2 / (2 L) times the angle.
    expected = 0.001 * SPEED**2 * 25.0 / (2.0 * leaf.wheelbase)
    assert np.sqrt(parts[PARAMETERS, "steering_offset.angle"][4, 1]) == pytest.approx(expected, rel=0.05)


def test_steering_offset_counts_if_the_steering_wheel_angle_was_recorded(leaf):
    log = straight_drive()
    uncertain = replace(leaf, provenance={"steering_wheel_offset": Provenance(0.01)})
    assert not [c for c in contributions("kinematic", uncertain, log)[1] if c[0] == PARAMETERS]
    with_wheel_angle = replace(log, steering_wheel_angle=np.full(len(log.road_wheel_angle), leaf.steering_wheel_offset))
    found = contributions("kinematic", uncertain, with_wheel_angle)[1][PARAMETERS, "steering_wheel_offset"]
    expected = 0.01 / leaf.steering_ratio * SPEED**2 * 25.0 / (2.0 * leaf.wheelbase)
    assert np.sqrt(found[4, 1]) == pytest.approx(expected, rel=0.05)
