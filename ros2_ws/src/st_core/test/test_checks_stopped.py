"""A channel that reads one number throughout, and recordings of which stamps leave next to nothing."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from exact_drive import exact_drive
from st_core.checks import AuxiliaryData, Finding, Severity, check
from st_core.checks.finding import merge_findings

CHANNELS = ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y",
            "road_wheel_angle")
# Paths can be predicted and scored without a lateral velocity and without accelerometers.
SPARED = {"velocity_y", "acceleration_x", "acceleration_y"}


@pytest.fixture(scope="module")
def log(leaf):
    return replace(exact_drive(leaf), steering_wheel_angle=None)


def stopped(log, *names, at=0.0):
    return replace(log, **{name: np.full_like(getattr(log, name), at) for name in names})


@pytest.mark.parametrize("at", [0.0, 0.3])
@pytest.mark.parametrize("name", CHANNELS)
def test_one_channel_stands_still(log, leaf, name, at):
    found, = (one for one in check(stopped(log, name, at=at), leaf).findings if one.name == "channel_frozen")
    assert found.severity is (Severity.WARNING if name in SPARED else Severity.ERROR) and found.channels == (name,)
    # Leaving out all of the drive is no cure.
    assert found.advice.kind == "look"


@pytest.mark.parametrize("names", list(combinations(CHANNELS, 2)), ids=" and ".join)
def test_two_channels_stand_still(log, leaf, names):
    errors = [one for one in check(stopped(log, *names), leaf).findings if one.severity is Severity.ERROR]
    assert bool(errors) == (not SPARED.issuperset(names))


def test_what_is_wrong_with_the_stamps_of_a_few_samples_is_told(log, leaf):
    stamps = np.repeat(log.ins_time_ns[:30], 20)
    found, = check(log.select_ins(np.arange(30)), leaf, AuxiliaryData({"INS": stamps})).findings
    assert found.name == "time_duplicates" and found.value == pytest.approx(0.95, abs=0.01)


def test_gaps_are_those_of_the_corrected_time(log, leaf):
    slow = replace(log, ins_time_ns=1000 * log.ins_time_ns, steering_time_ns=1000 * log.steering_time_ns)
    assert [one.name for one in check(slow, leaf).with_severity(Severity.ERROR)] == ["time_unit"]
    kept = np.ones(len(log.x), bool)
    kept[100:101] = False
    assert "time_gaps" not in {one.name for one in check(slow.select_ins(kept), leaf).findings}


def test_findings_of_unequal_severity_are_not_one():
    one = Finding("channel_frozen", Severity.WARNING, ("velocity_y",), "velocity_y is constant", 0.0)
    other = replace(one, severity=Severity.ERROR, channels=("yaw_rate",), text="yaw_rate is constant")
    assert merge_findings([one, other]) == [one, other]
    assert merge_findings([one, replace(other, severity=Severity.WARNING)])[0].channels == ("velocity_y", "yaw_rate")


def test_a_drive_that_stands_for_most_of_its_time_has_its_velocity_in_the_car(log, leaf):
    rows = len(log.x)
    still = {name: np.concatenate([np.full(2 * rows, getattr(log, name)[0]), getattr(log, name)])
             for name in ("x", "y", "yaw", "road_wheel_angle")}
    moving = {name: np.concatenate([np.zeros(2 * rows), getattr(log, name)])
              for name in ("velocity_x", "velocity_y", "yaw_rate", "acceleration_x", "acceleration_y")}
    times = log.ins_time_ns[0] + 10_000_000 * np.arange(3 * rows)
    long = replace(log, ins_time_ns=times, steering_time_ns=times + 5_000_000, **still, **moving)
    found = check(long, leaf).findings
    assert "velocity_axes" not in [one.name for one in found]
