"""Warning about a too long integration step: the proposed value removes it for every car, model and effect."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from batched import predict_log
from st_core import integrate
from st_core.augmented import augment
from st_core.checks.finding import Severity
from st_core.checks.trial import check_step_length
from st_core.discovery.settings import DiscoverySettings
from st_core.discovery.windows import Windows
from st_core.integrate import StepTooLongWarning, are_stable, required_slip_speed
from st_core.log import DriveLog

STEP = 0.05
MODELS = ("linear", "nonlinear")
EFFECTS = ({"steering_lag": {"time_constant": 0.1}}, {"tyre_relaxation": {"length": 0.3}}, {"mass": {"factor": 0.7}},
           {"front_stiffness": {"factor": 1.6}}, {"yaw_inertia": {"factor": 0.7}},
           {"rear_stiffness": {"factor": 1.4}, "tyre_relaxation": {"length": 0.1}})


def straight_drive(speeds, rate=100.0):
    """speeds [m/s] at `rate` [Hz]."""
    speeds = np.asarray(speeds, float)
    time = (np.arange(len(speeds)) * 1e9 / rate).astype(np.int64)
    zero = np.zeros(len(speeds))
    return DriveLog("straight", time, np.cumsum(speeds) / rate, zero, zero, speeds, zero, zero, time, zero)


@pytest.fixture(scope="module")
def log():
    return straight_drive(np.interp(np.arange(6000), [0, 2000, 4000, 5000, 5999], [0.5, 20.0, 2.0, 2.0, 35.0]))


def printed_value(finding):
    return float(re.search(r"value: ([\d.]+), unit: m/s", finding.advice.line)[1])


def models(name):
    yield name
    for effect in EFFECTS:
        yield augment(name, effect)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("inertia_factor", [0.5, 0.35, 0.25])
def test_proposed_value_removes_the_finding(car, log, name, inertia_factor):
    stiff = replace(car, yaw_inertia=inertia_factor * car.yaw_inertia)
    vehicle_findings = 0
    for model in models(name):
        finding = check_step_length([model], stiff, log, STEP)
        if finding is None:
            continue
        if finding.advice.kind == "vehicle":
            assert printed_value(finding) == finding.value and finding.unit == "m/s"
            assert ("rerun st discover" in finding.advice.line) is not isinstance(model, str)
            corrected = replace(stiff, minimum_slip_speed=printed_value(finding))
            assert check_step_length([model], corrected, log, STEP) is None
            vehicle_findings += 1
        else:
            assert finding.advice.line == f"--step {finding.value:.9g}"
            assert check_step_length([model], stiff, log, finding.value) is None
    assert vehicle_findings >= 4


def test_value_below_the_proposed_one_is_not_enough(car, log):
    stiff = replace(car, yaw_inertia=0.3 * car.yaw_inertia)
    value = check_step_length(MODELS, stiff, log, STEP).value
    assert check_step_length(MODELS, replace(stiff, minimum_slip_speed=value - 0.1), log, STEP) is not None


def test_minimum_slip_speed_must_exceed_the_lowest_stable_speed(leaf):
    """6.1 m/s for this car is not enough as the minimum slip speed."""
    stiff = replace(leaf, yaw_inertia=0.35 * leaf.yaw_inertia)
    lowest = integrate.lowest_stable_speed("linear", stiff, STEP)
    assert not are_stable(["linear"], replace(stiff, minimum_slip_speed=lowest + 0.08), [0.5, 35.0], STEP)
    needed = required_slip_speed(["linear"], stiff, [0.5, 35.0], STEP)
    assert needed > lowest + 0.1 and round(10 * needed, 9) == round(10 * needed)


def test_prediction_does_not_warn_with_the_proposed_value(leaf, log, monkeypatch):
    monkeypatch.setattr(integrate, "_issued_warnings", set())
    stiff = replace(leaf, yaw_inertia=0.35 * leaf.yaw_inertia)
    starts = np.arange(0, 50, 5) * 10**9
    with pytest.warns(StepTooLongWarning, match=r"minimum_slip_speed of [\d.]+ m/s in the vehicle file") as caught:
        predict_log("nonlinear", stiff, log, starts, backend="numpy")
    proposed = float(re.search(r"minimum_slip_speed of ([\d.]+) m/s", str(caught[0].message))[1])
    integrate._issued_warnings.clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        predict_log("nonlinear", replace(stiff, minimum_slip_speed=proposed), log, starts, backend="numpy")


def test_finding_names_models_and_times(leaf, log):
    finding = check_step_length(MODELS, replace(leaf, minimum_slip_speed=0.1), log, STEP)
    assert finding.severity is Severity.WARNING and "linear and nonlinear models of Nissan Leaf ZE0" in finding.text
    first, second = finding.times
    # The speed is below the limit of 2.66 m/s at the start, and again from 39 to 50 s.
    assert first == (0.0, pytest.approx(2.2, abs=0.5)) and second == pytest.approx((39.2, 50.2), abs=0.7)
    assert "at 0.5 to 2." in finding.text


def test_shorter_step_is_proposed_where_no_minimum_slip_speed_helps(leaf, log):
    """The rate of a relaxation length of 0.2 m grows with speed: at 35 m/s no minimum slip speed reduces it."""
    model = augment("linear", {"tyre_relaxation": {"length": 0.2}})
    finding = check_step_length([model], leaf, log, 0.2)
    assert (finding.advice.kind, finding.unit) == ("option", "s") and finding.advice.line == f"--step {finding.value:g}"
    assert check_step_length([model], leaf, log, finding.value) is None
    assert check_step_length([model], leaf, log, 2.0 * finding.value) is not None


def test_cars_of_the_repository_have_no_finding(car, log):
    assert check_step_length(("kinematic", *MODELS), car, log, STEP) is None
    assert check_step_length(MODELS, car, log.slice(1, 2), STEP) is None


def test_steps_are_shorter_for_a_model_car_that_is_slower_than_its_stable_slip_speed(leaf):
    tyres = {name: getattr(leaf, name)._replace(nominal_load=4.0) for name in ("tyre_front", "tyre_rear")}
    car = replace(leaf, mass=1.6, yaw_inertia=0.005, wheelbase=0.17, cg_to_front_axle=0.08, minimum_slip_speed=0.5,
                  cornering_stiffness_front=60.0, cornering_stiffness_rear=60.0, **tyres).with_derived_scales()
    log = straight_drive(np.interp(np.arange(6000), [0, 3000, 5999], [1.6, 3.0, 1.6]))
    finding = check_step_length(MODELS, car, log, STEP)
    assert finding.advice.kind == "option" and finding.value < STEP
    assert check_step_length(MODELS, car, log, finding.value) is None
    settings = DiscoverySettings(channels=("yaw_rate",))
    substeps = [Windows([log], vehicle, settings)._batch._substeps for vehicle in (car, leaf)]
    assert substeps[0] > 1 and substeps[1] == 1
