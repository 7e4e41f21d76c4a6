"""Identified values: document, contradictions with the vehicle file, application to a vehicle."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.errors import ConfigurationError
from st_core.identification.bounded_fit import find_interval_end, fit_within_bounds
from st_core.identification.magic_formula import identify_lambda_ky
from st_core.identification.result import (
    Coverage,
    Identification,
    IdentificationError,
    ParameterEstimate,
    apply_to_vehicle,
    compare_with_file,
    describe_contradiction,
    describe_stale_lambda,
)
from st_core.tyres import stiffness_scale
from st_core.vehicle import DERIVED_SOURCE, Provenance, VehicleParameters


def make_estimate(parameter, value, spread=1.0, status="identified"):
    return ParameterEstimate(parameter, value, "1", spread, (value - 2 * spread, value + 2 * spread), "a test",
                             ("one", "two"), "Verdict.", status)


def make_identification(*estimates):
    return Identification("scales", estimates, ("one",))


def with_uncertainties(vehicle, **uncertainties):
    notes = {key: Provenance(value, "before", "old.csv", "2026-01-01") for key, value in uncertainties.items()}
    return replace(vehicle, provenance=notes)


def test_document_has_the_keys_of_identification_json():
    found = make_identification(make_estimate("mass", 1600.0),
                                make_estimate("yaw_inertia", 2900.0, math.inf, "unidentifiable"))
    text = json.dumps(found.to_document(), allow_nan=False)
    assert set(json.loads(text)) == {"mass", "yaw_inertia"}
    keys = {"value", "unit", "standard_uncertainty", "interval95", "method", "runs", "verdict"}
    assert all(set(entry) == keys for entry in found.to_document().values())
    assert found.to_document()["yaw_inertia"]["interval95"] == [None, None]
    assert found.to_document()["mass"]["runs"] == ["one", "two"]


def test_verdict_states_once_that_the_interval_contains_zero():
    found = make_identification(make_estimate("steering_wheel_offset", 0.001))
    copied = replace(found, estimates=replace(found).estimates)
    assert copied["steering_wheel_offset"].verdict == "Verdict. steering_wheel_offset is not distinguishable from zero."


def test_coverage_counts_filled_bins():
    coverage = Coverage("speed", "m/s", np.array([0.0, 5.0, 10.0, 15.0]), np.array([100, 3, 50]), 20, 3)
    assert (coverage.filled_bins, coverage.sufficient) == (2, False)
    assert coverage.describe() == "speed: 2 of 3 bins from 0 to 15 m/s have at least 20 samples (needed: 3)"


def test_values_are_applied_to_the_vehicle_with_provenance(leaf):
    found = make_identification(make_estimate("mass", 1700.0, 2.0),
                                make_estimate("tyre_front.p_dy1", 0.9, 0.01, "doubtful"),
                                make_estimate("yaw_inertia", 1.0, math.inf, "unidentifiable"),
                                make_estimate("heading_misalignment", 0.01))
    car = apply_to_vehicle(leaf, [found], "2026-05-01")
    assert (car.mass, car.tyre_front.p_dy1, car.yaw_inertia) == (1700.0, 0.9, leaf.yaw_inertia)
    assert car.provenance["mass"] == Provenance(2.0, "a test", "one, two", "2026-05-01")
    assert set(car.provenance) == {"mass", "tyre_front.p_dy1"}
    assert car.sources["tyre_front.p_dy1"] == "st identify scales, doubtful"
    # The derived scale depends on the static load; its source stays "derived" when the file is reloaded.
    assert car.tyre_front.lambda_ky == stiffness_scale(70000.0, car.static_tyre_load_front, car.tyre_front)
    reloaded = VehicleParameters.from_yaml(car.to_yaml())
    assert reloaded == car and reloaded.provenance == car.provenance
    assert reloaded.sources["tyre_front.lambda_ky"] == DERIVED_SOURCE


def test_value_outside_vehicle_bounds_is_rejected(leaf):
    with pytest.raises(ConfigurationError, match=r"mass: 0\.5 is outside 1 to 60000 kg"):
        apply_to_vehicle(leaf, [make_identification(make_estimate("mass", 0.5, 0.1))], "2026-05-01")


def test_contradiction_with_the_vehicle_file_is_reported_with_numbers(leaf):
    car = with_uncertainties(leaf, mass=3.0)
    message = compare_with_file(car, make_estimate("mass", 1601.0, 4.0))
    assert "mass 1601 contradicts 1590" in message and "+11 is 2.2 times the combined uncertainty" in message
    assert "before, 2026-01-01" in message
    assert compare_with_file(car, make_estimate("mass", 1599.0, 4.0)) == ""
    assert compare_with_file(leaf, make_estimate("mass", 3000.0)) == ""  # the file's value has no uncertainty
    angle = replace(make_estimate("steering_wheel_offset", 0.02, 0.001), unit="rad")
    message = describe_contradiction(angle, 0.01, 0.001, "the mean reading")
    assert "1.1459 contradicts 0.57296 deg of the mean reading: the difference +0.573 is" in message
    ratio = replace(make_estimate("steering_ratio", 15.2, 0.1), unit="1")
    message = describe_contradiction(ratio, 16.0, 0.1, "the file")
    assert "steering_ratio 15.2 contradicts 16 of the file: the difference -0.8 is" in message


def test_stale_stiffness_scale_is_reported(leaf):
    fixed = replace(leaf, sources={**leaf.sources, "tyre_front.lambda_ky": "by hand"})
    found = [make_identification(make_estimate("cornering_stiffness_front", 80000.0))]
    assert describe_stale_lambda(fixed, found)[0].startswith("tyre_front.lambda_ky of the vehicle file is outdated")
    assert describe_stale_lambda(leaf, found) == ()


def test_lambda_ky_at_static_load_matches_the_paper(leaf):
    car = with_uncertainties(leaf, cornering_stiffness_front=700.0, cornering_stiffness_rear=1060.0)
    found = identify_lambda_ky(car, {"tyre_front": (0.0, "front.csv")})
    front, rear = found["tyre_front.lambda_ky"], found["tyre_rear.lambda_ky"]
    assert front.value == pytest.approx(0.423, abs=1e-3) and rear.value == pytest.approx(0.962, abs=1e-3)
    assert front.standard_uncertainty / front.value == pytest.approx(0.01)  # 700 of 70000 N/rad
    wider = identify_lambda_ky(car, {"tyre_front": (0.02, "front.csv")})["tyre_front.lambda_ky"]
    assert wider.standard_uncertainty / wider.value == pytest.approx(math.hypot(0.01, 0.02))
    assert "No table of tyre_rear" in found.warnings[0]


def test_lambda_ky_intervals_contain_the_true_value(leaf):
    """Stiffness with a standard uncertainty of 0.3 %, drawn 50 times."""
    random = np.random.default_rng(0)
    hits, errors = 0, []
    for _ in range(50):
        car = replace(leaf, cornering_stiffness_front=70000.0 * (1.0 + random.normal(0.0, 0.003)))
        car = with_uncertainties(car, cornering_stiffness_front=210.0, cornering_stiffness_rear=300.0)
        found = identify_lambda_ky(car, {})["tyre_front.lambda_ky"]
        hits += found.interval95[0] <= leaf.tyre_front.lambda_ky <= found.interval95[1]
        errors.append(abs(found.value / leaf.tyre_front.lambda_ky - 1.0))
    assert hits >= 45 and max(errors) < 0.01


def test_lambda_ky_above_one_is_doubtful_and_missing_uncertainty_rejected(leaf):
    stiff = with_uncertainties(replace(leaf, cornering_stiffness_rear=150000.0), cornering_stiffness_front=1.0,
                               cornering_stiffness_rear=1500.0)
    assert identify_lambda_ky(stiff, {})["tyre_rear.lambda_ky"].status == "doubtful"
    with pytest.raises(IdentificationError, match="cornering_stiffness_front of the vehicle file has no uncertainty"):
        identify_lambda_ky(leaf, {})


def line_residuals(x, y):
    return lambda values: values[..., :1] + values[..., 1:] * x - y


def test_profile_interval_of_a_straight_line_equals_student_t_interval():
    random = np.random.default_rng(3)
    x = np.linspace(0.0, 10.0, 12)
    y = 1.0 + 0.5 * x + random.normal(0.0, 0.3, len(x))
    residuals = line_residuals(x, y)
    fit = fit_within_bounds(residuals, [[0.0, 0.0]], [-10.0, -10.0], [10.0, 10.0])
    slope, cov = np.polyfit(x, y, 1, cov=True)
    assert fit.values[1] == pytest.approx(slope[0], rel=1e-6)
    assert fit.standard_errors[1] == pytest.approx(math.sqrt(cov[0, 0]), rel=1e-4)
    half = 2.228 * math.sqrt(cov[0, 0])  # Student's t, 10 degrees of freedom
    for side in (-1.0, 1.0):
        end, is_open = find_interval_end(residuals, fit, 1, side)
        assert side * (end - slope[0]) == pytest.approx(half, rel=0.05) and not is_open


def test_parameter_at_bound_has_open_interval_and_no_standard_error():
    x = np.linspace(0.0, 10.0, 12)
    y = 1.0 + 0.5 * x + np.random.default_rng(3).normal(0.0, 0.3, len(x))
    fit = fit_within_bounds(line_residuals(x, y), [[0.0, 0.1]], [-10.0, -10.0], [10.0, 0.45])
    assert fit.is_at_bound(1) and fit.standard_errors[1] == 0.0
    assert find_interval_end(line_residuals(x, y), fit, 1, 1.0) == (0.45, True)


@pytest.mark.parametrize(("parameter", "interval", "status"), [
    ("cornering_stiffness_front", (-1e4, 2e5), "unidentifiable"), ("steering_wheel_offset", (-0.01, 0.02), "doubtful"),
    ("steering_wheel_offset", (0.01, 0.02), "identified"), ("tyre_front.p_ey1", (-0.3, 0.2), "identified")])
def test_interval_containing_zero_is_not_identified(parameter, interval, status):
    estimate = ParameterEstimate(parameter, sum(interval) / 2, "1", 1.0, interval, "", (), "Fixed.")
    (found,) = Identification("stiffness", (estimate,), ()).estimates
    assert found.status == status and ("zero" in found.verdict) == (status != "identified")
