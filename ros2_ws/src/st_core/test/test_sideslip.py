"""Course over ground instead of heading: recognised, and replaced by the heading of steady-state cornering."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.channels import CHANNELS
from st_core.checks import check
from st_core.checks.finding import Advice
from st_core.checks.trial import _apply_advice
from st_core.identification.axle_forces import identify_stiffness
from st_core.identification.ins_mounting import identify_ins_mounting
from st_core.identification.result import IdentificationError
from st_core.log import DriveLog
from st_core.log_evaluation import evaluate_log
from st_core.sideslip import compute_steady_velocity_y, derive_yaw_rate, has_derived_yaw_rate, with_steady_sideslip
from support import read_car
from winding_road import Truth, winding_road

CAR = read_car("leaf")
START_NS = 1_756_900_800_000_000_000


@pytest.fixture(scope="module")
def heading() -> DriveLog:
    """90 s with heading and lateral velocity."""
    t, x, y, yaw, v_x, v_y, rate, steering = winding_road(CAR, Truth(0.0, CAR.steering_ratio, 1.0), 90.0, 5, 0.3).T
    time_ns = START_NS + np.round(t * 1e9).astype(np.int64)
    return DriveLog("road", time_ns, x, y, np.unwrap(yaw), v_x, v_y, rate, time_ns, steering / CAR.steering_ratio)


@pytest.fixture(scope="module")
def course(heading: DriveLog) -> DriveLog:
    """The same drive as a GNSS receiver measures it: course as yaw, speed over ground, no lateral velocity."""
    angle = np.arctan2(heading.velocity_y, heading.velocity_x)
    return replace(heading, yaw=heading.yaw + angle, velocity_x=np.hypot(heading.velocity_x, heading.velocity_y),
                   velocity_y=np.zeros_like(angle))


def test_heading_and_lateral_velocity_are_reconstructed(heading: DriveLog, course: DriveLog) -> None:
    found = with_steady_sideslip(course, CAR)
    assert not found.sideslip_measured and not CHANNELS["velocity_y"].is_measured_in(found)
    assert np.std(course.yaw - heading.yaw) > 0.008
    assert np.std(found.yaw - heading.yaw) < 0.003
    assert np.std(found.velocity_y - compute_steady_velocity_y(heading, CAR)) < 0.05


def test_predictions_improve_with_the_reconstructed_heading(course: DriveLog) -> None:
    errors = [np.nanmean(np.abs(evaluate_log(("linear",), CAR, log).errors["linear", "hindsight"].at_seconds[:, -1, 1]))
              for log in (course, with_steady_sideslip(course, CAR))]
    assert errors[1] < 0.6 * errors[0]


def test_yaw_rate_derived_from_the_course_is_replaced_by_that_of_the_heading(course: DriveLog) -> None:
    time_ns = course.ins_time_ns
    corrected = with_steady_sideslip(replace(course, yaw_rate=derive_yaw_rate(time_ns, course.yaw)), CAR)
    np.testing.assert_allclose(corrected.yaw_rate, derive_yaw_rate(time_ns, corrected.yaw), atol=1e-6)
    assert not [finding for finding in check(corrected, CAR).findings if finding.name.startswith("yaw")]


def test_measured_heading_is_unchanged(heading: DriveLog) -> None:
    assert with_steady_sideslip(heading, CAR) is heading
    without_velocity_y = replace(heading, velocity_y=np.zeros(len(heading.x)))
    assert with_steady_sideslip(without_velocity_y, CAR) is without_velocity_y


@pytest.mark.parametrize("seconds", [0.0, 0.02, 0.5])
def test_too_short_drive_is_unchanged(course: DriveLog, seconds: float) -> None:
    short = course.slice(START_NS, START_NS + round(seconds * 1e9))
    assert with_steady_sideslip(short, CAR) is short


def test_stationary_drive_is_unchanged(course: DriveLog) -> None:
    stationary = replace(course, velocity_x=np.zeros(len(course.x)))
    assert with_steady_sideslip(stationary, CAR) is stationary


def test_identification_that_needs_the_sideslip_is_rejected(course: DriveLog) -> None:
    log = with_steady_sideslip(course, CAR)
    for identify in (identify_stiffness, identify_ins_mounting):
        with pytest.raises(IdentificationError, match="road: velocity_y was not measured, or is 0 throughout"):
            identify([log], CAR)


def test_correction_of_the_yaw_rate_is_tried_before_the_sideslip_is_computed_from_it(course: DriveLog) -> None:
    wrong = with_steady_sideslip(replace(course, yaw_rate=-course.yaw_rate), CAR)
    corrected, _ = _apply_advice((wrong, CAR), Advice.correct("yaw_rate", scale=-1.0))
    np.testing.assert_allclose(corrected.velocity_y, with_steady_sideslip(course, CAR).velocity_y, atol=1e-9)


def test_checks_do_not_locate_the_ins_from_reconstructed_sideslip(course: DriveLog) -> None:
    found = check(with_steady_sideslip(course, replace(CAR, cg_to_ins_x=CAR.cg_to_ins_x + 0.5)), CAR)
    assert not {"measuring_point", "heading_misaligned", "yaw_lag"} & {finding.name for finding in found.findings}


def test_checks_do_not_locate_the_ins_on_a_straight_road() -> None:
    time_ns = START_NS + 10_000_000 * np.arange(3000)
    zero = np.zeros(3000)
    rate = np.random.default_rng(2).normal(0.0, 0.001, 3000)
    log = DriveLog("straight", time_ns, 0.1 * np.arange(3000), zero, zero, zero + 10.0, zero, rate, time_ns, zero)
    assert not {"measuring_point", "heading_misaligned"} & {finding.name for finding in check(log, CAR).findings}


def test_measured_yaw_rate_is_not_mistaken_for_a_derived_one_after_a_long_stop(heading: DriveLog) -> None:
    """At standstill measured and derived yaw rate are both zero."""
    zero, rest = 0.0 * heading.yaw_rate, np.arange(3 * len(heading.x)) >= len(heading.x)
    time_ns = heading.ins_time_ns[0] + np.arange(len(rest)) * int(np.median(np.diff(heading.ins_time_ns)))

    def with_stop(values: np.ndarray, at_rest: np.ndarray) -> np.ndarray:
        return np.where(rest, np.resize(at_rest, len(rest)), np.resize(values, len(rest)))

    constant = {name: with_stop(getattr(heading, name), getattr(heading, name)[-1:]) for name in ("x", "y", "yaw")}
    zero_at_rest = {name: with_stop(getattr(heading, name), zero[:1])
                    for name in ("velocity_x", "velocity_y", "yaw_rate")}
    log = replace(heading, ins_time_ns=time_ns, **constant, **zero_at_rest, acceleration_x=None, acceleration_y=None)
    assert not has_derived_yaw_rate(log)
    assert has_derived_yaw_rate(replace(log, yaw_rate=derive_yaw_rate(time_ns, log.yaw)))
