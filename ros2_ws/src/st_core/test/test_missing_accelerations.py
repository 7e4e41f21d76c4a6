"""An accelerometer that is not there for some samples: those samples are lost, nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.discovery.next_manoeuvre import simulate_drive
from st_core.discovery.windows import Windows, noise_floor
from st_core.log import DriveLog
from st_core.manoeuvres import CATALOGUE
from st_core.readings import find_missing_reading


@pytest.fixture(scope="module")
def logs(leaf) -> tuple[DriveLog, DriveLog]:
    """A drive with noise, and the same with three single samples and 2.5 s of the accelerometer missing."""
    log = simulate_drive(next(m for m in CATALOGUE if m.name == "sweep"), augment("nonlinear", {}), leaf)
    rng = np.random.default_rng(4)
    names = ("yaw_rate", "velocity_x", "velocity_y", "acceleration_y")
    log = replace(log, **{n: getattr(log, n) + 0.01 * rng.standard_normal(len(log.x)) for n in names})
    lost = np.array(log.acceleration_y)
    lost[[300, 700, 701]] = np.nan
    lost[1000:1100] = np.nan
    return log, replace(log, acceleration_y=lost)


def test_accelerations_needed_by_sensor_effects_on_a_kinematic_base_with_slip():
    values = {"tyre_slip": {"share": 1.0}, "yaw_rate_delay": {"time": 0.02}, "position_lag": {"time": 0.02}}
    model = augment("kinematic", {name: values[name] for name in values})
    assert find_missing_reading(model, ["acceleration_x", "acceleration_y"]) is None


def test_windows_are_scored_where_it_is_known(logs, leaf):
    settings = DiscoverySettings(where=False)
    whole, holed = (Windows([log], leaf, settings)._measured["acceleration_y"] for log in logs)
    lost = np.isnan(holed) & np.isfinite(whole)
    assert 0.0 < lost.mean() < 0.1
    both = np.isfinite(holed)
    assert np.abs(holed - whole)[both].max() < 0.05


def test_noise_is_that_of_the_samples_there_are(logs, leaf):
    whole, holed = (noise_floor(Windows([log], leaf, DiscoverySettings())) for log in logs)
    samples = 0.1 / np.diff(logs[0].ins_time_ns * 1e-9).mean()  # averaged
    assert whole["acceleration_y"] == pytest.approx(0.01 / np.sqrt(samples), rel=0.2)
    assert holed["acceleration_y"] == pytest.approx(whole["acceleration_y"], rel=0.05)
