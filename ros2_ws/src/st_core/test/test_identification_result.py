"""Identified values: how they are written down, what contradicts what, and how they get into a vehicle."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from st_core.errors import ConfigurationError
from st_core.identification.bounded_fit import find_interval_end, fit_curve
from st_core.identification.lambda_ky import identify_lambda_ky
from st_core.identification.result import (
    Coverage,
    Estimate,
    Identification,
    IdentificationError,
    apply_to_vehicle,
    compare_with_file,
    describe_stale_scales,
)
from st_core.provenance import Provenance
from st_core.tyres import stiffness_scale
from st_core.vehicle import DERIVED_SOURCE, VehicleParameters


def estimate(parameter, value, spread=1.0, status="identified"):
    return Estimate(parameter, value, "1", spread, (value - 2 * spread, value + 2 * spread), "a test", ("one", "two"),
                    "Said.", status)


def outcome(*estimates):
    return Identification("scales", estimates, ("one",))


def known(vehicle, **uncertainties):
    notes = {key: Provenance(value, "before", "old.csv", "2026-01-01") for key, value in uncertainties.items()}
    return replace(vehicle, provenance=notes)


def test_document_is_what_identification_json_holds():
    found = outcome(estimate("mass", 1600.0), estimate("yaw_inertia", 2900.0, math.inf, "unidentifiable"))
    text = json.dumps(found.to_document(), allow_nan=False)
    assert set(json.loads(text)) == {"mass", "yaw_inertia"}
    keys = {"value", "unit", "standard_uncertainty", "interval95", "method", "runs", "verdict"}
    assert all(set(entry) == keys for entry in found.to_document().values())
    assert found.to_document()["yaw_inertia"]["interval95"] == [None, None]
    assert found.to_document()["mass"]["runs"] == ["one", "two"]


def test_a_verdict_states_once_that_zero_is_inside():
    found = outcome(estimate("steering_wheel_offset", 0.001))
    again = replace(found, estimates=replace(found).estimates)
    assert again["steering_wheel_offset"].verdict == "Said. Not distinguishable from zero."


def test_coverage_counts_filled_bins():
    coverage = Coverage("speed", "m/s", np.array([0.0, 5.0, 10.0, 15.0]), np.array([100, 3, 50]), 20, 3)
    assert (coverage.filled, coverage.sufficient) == (2, False)
    assert coverage.describe() == "speed: 2 of 3 bins from 0 to 15 m/s have at least 20 samples (needed: 3)"


def test_values_go_into_the_vehicle_with_their_provenance(leaf):
    found = outcome(estimate("mass", 1700.0, 2.0), estimate("tyre_front.p_dy1", 0.9, 0.01, "doubtful"),
                    estimate("yaw_inertia", 1.0, math.inf, "unidentifiable"), estimate("heading_misalignment", 0.01))
    car = apply_to_vehicle(leaf, [found], "2026-05-01")
    assert (car.mass, car.tyre_front.p_dy1, car.yaw_inertia) == (1700.0, 0.9, leaf.yaw_inertia)
    assert car.provenance["mass"] == Provenance(2.0, "a test", "one, two", "2026-05-01")
    assert set(car.provenance) == {"mass", "tyre_front.p_dy1"}
    assert car.sources["tyre_front.p_dy1"] == "st identify scales, doubtful"
    # The static load has changed, and with it the scale that is derived from it; the file says so when read again.
    assert car.tyre_front.lambda_ky == stiffness_scale(70000.0, car.static_tyre_load_front, car.tyre_front)
    again = VehicleParameters.from_yaml(car.to_yaml())
    assert again == car and again.provenance == car.provenance
    assert again.sources["tyre_front.lambda_ky"] == DERIVED_SOURCE


def test_a_value_no_vehicle_file_may_hold_is_refused(leaf):
    with pytest.raises(ConfigurationError, match="mass: 10 is outside 50 to 60000 kg"):
        apply_to_vehicle(leaf, [outcome(estimate("mass", 10.0))], "2026-05-01")


def test_contradictions_with_the_file_are_said_with_numbers(leaf):
    car = known(leaf, mass=3.0)
    said = compare_with_file(car, estimate("mass", 1601.0, 4.0))
    assert "mass 1601 contradicts 1590" in said and "+11 is 2.2 times the combined uncertainty" in said
    assert "before, 2026-01-01" in said
    assert compare_with_file(car, estimate("mass", 1599.0, 4.0)) == ""
    assert compare_with_file(leaf, estimate("mass", 3000.0)) == ""  # nobody knows how sure the file's value was


def test_a_scale_that_was_set_before_the_stiffness_changed_is_named(leaf):
    fixed = replace(leaf, sources={**leaf.sources, "tyre_front.lambda_ky": "by hand"})
    found = [outcome(estimate("cornering_stiffness_front", 80000.0))]
    assert describe_stale_scales(fixed, found)[0].startswith("tyre_front.lambda_ky of the vehicle file is outdated")
    assert describe_stale_scales(leaf, found) == ()


def test_lambda_is_the_papers_at_the_static_load(leaf):
    car = known(leaf, cornering_stiffness_front=700.0, cornering_stiffness_rear=1060.0)
    found = identify_lambda_ky(car, {"tyre_front": (0.0, "front.csv")})
    front, rear = found["tyre_front.lambda_ky"], found["tyre_rear.lambda_ky"]
    assert front.value == pytest.approx(0.423, abs=1e-3) and rear.value == pytest.approx(0.962, abs=1e-3)
    assert front.standard_uncertainty / front.value == pytest.approx(0.01)  # 700 of 70000 N/rad
    wider = identify_lambda_ky(car, {"tyre_front": (0.02, "front.csv")})["tyre_front.lambda_ky"]
    assert wider.standard_uncertainty / wider.value == pytest.approx(math.hypot(0.01, 0.02))
    assert "No table of tyre_rear" in found.warnings[0]


def test_lambda_is_within_its_interval_and_a_percent(leaf):
    """Stiffness known to 0.3 %, drawn 50 times."""
    random = np.random.default_rng(0)
    hits, errors = 0, []
    for _ in range(50):
        car = replace(leaf, cornering_stiffness_front=70000.0 * (1.0 + random.normal(0.0, 0.003)))
        car = known(car, cornering_stiffness_front=210.0, cornering_stiffness_rear=300.0)
        found = identify_lambda_ky(car, {})["tyre_front.lambda_ky"]
        hits += found.interval95[0] <= leaf.tyre_front.lambda_ky <= found.interval95[1]
        errors.append(abs(found.value / leaf.tyre_front.lambda_ky - 1.0))
    assert hits >= 45 and max(errors) < 0.01


def test_lambda_above_one_is_doubtful_and_without_uncertainty_refused(leaf):
    stiff = known(replace(leaf, cornering_stiffness_rear=150000.0), cornering_stiffness_front=1.0,
                  cornering_stiffness_rear=1500.0)
    assert identify_lambda_ky(stiff, {})["tyre_rear.lambda_ky"].status == "doubtful"
    with pytest.raises(IdentificationError, match="cornering_stiffness_front of the vehicle file has no uncertainty"):
        identify_lambda_ky(leaf, {})


def line(x, y):
    return lambda values: values[..., :1] + values[...,
                                                   1:] * x - y if values.ndim > 1 else values[0] + values[1] * x - y


def test_profile_interval_of_a_straight_line_is_students():
    random = np.random.default_rng(3)
    x = np.linspace(0.0, 10.0, 12)
    y = 1.0 + 0.5 * x + random.normal(0.0, 0.3, len(x))
    residuals = line(x, y)
    fit = fit_curve(residuals, [[0.0, 0.0]], [-10.0, -10.0], [10.0, 10.0])
    slope, cov = np.polyfit(x, y, 1, cov=True)
    assert fit.values[1] == pytest.approx(slope[0], rel=1e-6)
    assert fit.standard_errors[1] == pytest.approx(math.sqrt(cov[0, 0]), rel=1e-4)
    half = 2.228 * math.sqrt(cov[0, 0])  # Student's t, 10 degrees of freedom
    for side in (-1.0, 1.0):
        end, is_open = find_interval_end(residuals, fit, 1, side)
        assert side * (end - slope[0]) == pytest.approx(half, rel=0.05) and not is_open


def test_a_bound_opens_the_interval_and_takes_the_parameter_out_of_the_covariance():
    x = np.linspace(0.0, 10.0, 12)
    y = 1.0 + 0.5 * x + np.random.default_rng(3).normal(0.0, 0.3, len(x))
    fit = fit_curve(line(x, y), [[0.0, 0.1]], [-10.0, -10.0], [10.0, 0.45])
    assert fit.is_at_bound(1) and fit.standard_errors[1] == 0.0
    assert find_interval_end(line(x, y), fit, 1, 1.0) == (0.45, True)


@pytest.mark.parametrize(("parameter", "interval", "status"), [
    ("cornering_stiffness_front", (-1e4, 2e5), "unidentifiable"), ("steering_wheel_offset", (-0.01, 0.02), "doubtful"),
    ("steering_wheel_offset", (0.01, 0.02), "identified"), ("tyre_front.p_ey1", (-0.3, 0.2), "identified")])
def test_a_value_whose_interval_holds_zero_is_not_identified(parameter, interval, status):
    one = Estimate(parameter, sum(interval) / 2, "1", 1.0, interval, "", (), "Fixed.")
    (found,) = Identification("stiffness", (one,), ()).estimates
    assert found.status == status and ("zero" in found.verdict) == (status != "identified")
