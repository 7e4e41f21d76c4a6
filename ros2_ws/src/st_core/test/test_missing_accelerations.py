"""Missing accelerometer samples: only the windows that need them are affected."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.discovery.next_manoeuvre import simulate_drive
from st_core.discovery.windows import Windows
from st_core.log import DriveLog
from st_core.manoeuvres import CATALOGUE
from st_core.readings import find_missing_reading


@pytest.fixture(scope="module")
def logs(leaf) -> tuple[DriveLog, DriveLog]:
    """A drive with noise, and the same drive without three single acceleration samples and without a stretch of 100."""
    log = simulate_drive(next(m for m in CATALOGUE if m.name == "sweep"), augment("nonlinear", {}), leaf)
    rng = np.random.default_rng(4)
    names = ("yaw_rate", "velocity_x", "velocity_y", "acceleration_y")
    log = replace(log, **{n: getattr(log, n) + 0.01 * rng.standard_normal(len(log.x)) for n in names})
    acceleration_y = np.array(log.acceleration_y)
    acceleration_y[[300, 700, 701]] = np.nan
    acceleration_y[1000:1100] = np.nan
    return log, replace(log, acceleration_y=acceleration_y)


def test_sensor_effects_on_a_kinematic_base_with_slip_need_only_accelerations():
    values = {"tyre_slip": {"share": 1.0}, "yaw_rate_delay": {"time": 0.02}, "position_lag": {"time": 0.02}}
    model = augment("kinematic", values)
    assert find_missing_reading(model, ["acceleration_x", "acceleration_y"]) is None


def test_windows_are_scored_where_the_acceleration_is_measured(logs, leaf):
    settings = DiscoverySettings(locate_errors=False)
    complete, with_gaps = (Windows([log], leaf, settings)._measured["acceleration_y"] for log in logs)
    lost = np.isnan(with_gaps) & np.isfinite(complete)
    assert 0.0 < lost.mean() < 0.1
    measured = np.isfinite(with_gaps)
    assert np.abs(with_gaps - complete)[measured].max() < 0.05


def test_noise_floor_is_estimated_from_the_measured_samples(logs, leaf):
    complete, with_gaps = (Windows([log], leaf, DiscoverySettings()).noise_floor() for log in logs)
    averaged = 0.1 / np.diff(logs[0].ins_time_ns * 1e-9).mean()  # number of samples
    assert complete["acceleration_y"] == pytest.approx(0.01 / np.sqrt(averaged), rel=0.2)
    assert with_gaps["acceleration_y"] == pytest.approx(complete["acceleration_y"], rel=0.05)
