"""Drives from which a parameter cannot be identified: the error gives the numbers and the remedy."""

import numpy as np
import pytest
from driven import drive, weave
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.driving_prediction import fit_stiffness, identify_yaw_inertia
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import IdentificationError
from st_core.identification.steering import identify_steering_offset


@pytest.fixture(scope="module")
def log(leaf):
    return drive(leaf, 9.0, weave(0.06), 20.0)


@pytest.fixture(scope="module")
def circle(leaf):
    return drive(leaf, 8.0, lambda t: np.full_like(t, 0.08), 40.0, name="circle")


@pytest.mark.parametrize("identify", [identify_stiffness, fit_stiffness, identify_steering_offset,
                                      identify_ins_mounting, identify_yaw_inertia])
def test_missing_duplicate_and_short_drives_are_rejected(identify, log, leaf):
    with pytest.raises(IdentificationError, match="no drives were given"):
        identify([], leaf)
    with pytest.raises(IdentificationError, match="duplicate name"):
        identify([log, log], leaf)
    short = log.slice(log.start_ns, log.start_ns + 3_000_000_000)
    with pytest.raises(IdentificationError, match=r"9 m/s: 301 INS samples, which overlap with the steering for 3.0 s"):
        identify([short], leaf)


@pytest.mark.parametrize("identify", [identify_stiffness, fit_stiffness])
def test_circle_has_too_little_excitation_for_stiffness(identify, circle, leaf):
    with pytest.raises(IdentificationError, match=r"lateral acceleration: 1 of 11 bins .* Drive left and right turns"):
        identify([circle], leaf)


def test_circle_has_no_straight_driving_for_the_offset(circle, leaf):
    with pytest.raises(IdentificationError, match="straight driving: 0 windows of 2 s have a radius above 500 m"):
        identify_steering_offset([circle], leaf)


def test_slow_weaving_has_too_little_excitation_for_yaw_inertia(leaf):
    logs = [drive(leaf, speed, weave(0.05, 20.0), 40.0) for speed in (7.0, 12.0)]
    with pytest.raises(IdentificationError, match=r"excitation: yaw acceleration: .* drive step steers, lane changes"):
        identify_yaw_inertia(logs, leaf)


def test_one_speed_has_too_little_excitation_for_steering_ratio(leaf):
    logs = [drive(leaf, 9.0 + shift, weave(0.06), 40.0) for shift in (0.5, 1.0)]
    with pytest.raises(IdentificationError, match="too little excitation: speed: 1 of 8 bins"):
        fit_stiffness(logs, leaf, additional=("steering_ratio",))


def test_fast_drive_has_too_little_excitation_for_ins_mounting(leaf):
    fast = drive(leaf, 14.0, weave(0.03), 20.0)
    with pytest.raises(IdentificationError, match=r"too little excitation: speed: 0 of 4 bins .* Drive slowly"):
        identify_ins_mounting([fast], leaf)
