"""Signals that do not belong together are errors of the checks, by name: no parameter is fitted to them."""

from dataclasses import replace

import numpy as np
import pytest
from driven import drive, weave
from st_core.checks import Severity, check
from st_core.handling import stability_factor

DEGREES = 57.29577951308232


@pytest.fixture(scope="module")
def log(leaf):
    return drive(leaf, 9.0, weave(0.06), 20.0)


def errors(log, car):
    return {one.name: one for one in check(log, car).with_severity(Severity.ERROR)}


def test_a_good_drive_passes(log, leaf):
    assert errors(log, leaf) == {}


@pytest.mark.parametrize(("wrong", "name"), [
    (lambda d: {"yaw": d.yaw * DEGREES}, "yaw_scale"),
    (lambda d: {"yaw_rate": d.yaw_rate * DEGREES}, "yaw_rate_scale"),
    (lambda d: {"yaw_rate": -d.yaw_rate}, "yaw_rate_scale"),
    (lambda d: {"road_wheel_angle": d.road_wheel_angle * DEGREES}, "steering_scale"),
    (lambda d: {"road_wheel_angle": d.road_wheel_angle / DEGREES}, "steering_scale"),
    (lambda d: {"road_wheel_angle": -d.road_wheel_angle}, "steering_sign"),
    (lambda d: {"road_wheel_angle": d.steering_wheel_angle}, "steering_scale"),
    (lambda d: {"velocity_x": 3.6 * d.velocity_x, "velocity_y": 3.6 * d.velocity_y}, "velocity_scale"),
])
def test_signals_that_do_not_belong_together(log, leaf, wrong, name):
    assert name in errors(replace(log, **wrong(log)), leaf)


@pytest.mark.parametrize("wrong", [
    lambda d: {"yaw": d.yaw * DEGREES, "yaw_rate": d.yaw_rate * DEGREES},
    lambda d: {"velocity_x": d.velocity_y, "velocity_y": d.velocity_x},
])
def test_several_that_do_not(log, leaf, wrong):
    assert errors(replace(log, **wrong(log)), leaf)


def test_the_sign_shows_in_bends_that_are_too_wide_for_the_size(leaf):
    fast = drive(leaf, 24.0, weave(0.009), 40.0)
    assert np.sqrt(np.mean(np.square(leaf.wheelbase * fast.yaw_rate / fast.velocity_x))) < 0.006
    assert errors(fast, leaf) == {}
    turned = replace(fast, road_wheel_angle=-fast.road_wheel_angle, steering_wheel_angle=-fast.steering_wheel_angle)
    assert set(errors(turned, leaf)) == {"steering_sign"}


def test_understeer_of_a_fast_car_is_no_unit(leaf):
    soft = replace(leaf, cornering_stiffness_front=0.6 * leaf.cornering_stiffness_front)
    fast = drive(soft, 24.0, weave(0.03), 40.0)
    assert 24.0**2 * stability_factor(soft) > 0.8
    assert errors(fast, soft) == {}
    guessed = replace(soft, cornering_stiffness_front=120e3, cornering_stiffness_rear=90e3)
    assert stability_factor(guessed) < 0.0
    assert errors(fast, guessed) == {}
    finding = errors(replace(fast, road_wheel_angle=fast.steering_wheel_angle), soft)["steering_scale"]
    assert "the angle of the steering wheel" in finding.text
    scale = finding.advice.entry["correct"]["road_wheel_angle"]["scale"]
    assert scale == pytest.approx(1.0 / soft.steering_ratio, rel=1e-4)
