"""A correction is proposed only if it does not raise the prediction errors of its run."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import Sines, exact_drive
from st_core.checks import Finding, Severity
from st_core.checks.finding import Advice
from st_core.checks.trial import try_corrections
from st_core.corrections import Correction, apply_corrections
from st_core.handling import stability_factor

FAULTS = {
    "yaw_rate": {"scale": 20.0}, "yaw": {"add": 0.2}, "velocity": {"scale": 1.05}, "velocity_x": {"scale": 1.05},
    "position": {"earlier": 0.3}, "x": {"scale": 1.05}, "heading": {"add": 0.2}, "road_wheel_angle": {"earlier": 0.4},
}


def finding(severity, **correct):
    (channel, values), = correct.items()
    return Finding("some_fault", severity, (channel,), "a fault", advice=Advice.correct(channel, **values))


def inverse_correction(values):
    return {"scale": 1.0 / values["scale"]} if "scale" in values else {key: -value for key, value in values.items()}


@pytest.mark.parametrize("severity", [Severity.ERROR, Severity.WARNING])
@pytest.mark.parametrize("channel", FAULTS)
def test_only_the_right_correction_is_proposed(leaf, channel, severity):
    log = exact_drive(leaf, 60.0)
    log = replace(log, steering_wheel_angle=None)
    values = FAULTS[channel]
    broken = apply_corrections(log, {channel: Correction(**values)}, leaf)
    right, wrong = (finding(severity, **{channel: one}) for one in (inverse_correction(values), values))
    (kept,) = try_corrections([right], broken, leaf)
    assert kept.advice == right.advice and kept.tried[1] < 1.05 * kept.tried[0]
    (refuted,) = try_corrections([wrong], log, leaf)
    assert refuted.advice.kind == "text" and not refuted.advice.entry and refuted.tried[1] > refuted.tried[0]
    assert refuted.severity is (Severity.NOTE if severity is Severity.WARNING else Severity.ERROR)
    subject = "it" if severity is Severity.WARNING else "the corrections of all errors"
    assert refuted.advice.line.startswith(f"its correction is not proposed, as {subject} would raise the prediction")


def test_corrections_of_errors_are_tried_together(leaf):
    log = replace(exact_drive(leaf, 60.0), steering_wheel_angle=None)
    both = {"yaw": {"scale": -1.0}, "yaw_rate": {"scale": -1.0}}
    broken = apply_corrections(log, {name: Correction(**one) for name, one in both.items()}, leaf)
    findings = [finding(Severity.ERROR, **{name: one}) for name, one in both.items()]
    assert [one.advice for one in try_corrections(findings, broken, leaf)] == [one.advice for one in findings]


def test_correction_outside_the_limits_of_the_vehicle_file_is_not_tried(leaf):
    advice = Advice("vehicle", "steering_wheel_offset: 5 rad", {"steering_wheel_offset": 5.0})
    given = Finding("steering_offset", Severity.WARNING, ("road_wheel_angle",), "a fault", advice=advice)
    assert try_corrections([given], exact_drive(leaf, 60.0), leaf) == [given]


@pytest.mark.parametrize("ahead", [2.0, -2.0])
def test_wrong_correction_is_rejected_on_a_steady_circle(leaf, ahead):
    """Steering gain and offset are not separable there; unbounded, they would explain any error."""
    speed, turning = 8.0, 0.5
    circle = exact_drive(leaf, 60.0, speed=Sines(speed, ()), turning=Sines(turning, ()))
    angle = leaf.wheelbase * turning / speed * (1.0 + stability_factor(leaf) * speed**2)
    circle = replace(circle, steering_wheel_angle=None, road_wheel_angle=np.full(len(circle.road_wheel_angle), angle))
    (refuted,) = try_corrections([finding(Severity.WARNING, position={"ahead": ahead})], circle, leaf)
    assert refuted.severity is Severity.NOTE and not refuted.advice.entry and refuted.tried[1] > 1.0 > refuted.tried[0]
