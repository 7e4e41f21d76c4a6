"""Axle force curves: of models against closed forms, with uncertainty bands, and against measured forces."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import fit_problem, linear_problem
from driven import SILENT, drive, weave
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.discovery.axles import Axles, _combination_values
from st_core.discovery.evidence import approximate_joint_fit
from st_core.errors import StCoreError
from st_core.identification.axle_forces import (
    compute_axle_force,
    compute_force_error,
    draw_models,
    fit_axle_regressions,
    identify_stiffness,
    make_axle_curve,
)
from st_core.tyres import GRAVITY, magic_formula_coefficients, magic_formula_force

SLIP = np.linspace(0.0, 0.12, 9)


def tyre_pair_force(leaf, axle):
    tyre, load = getattr(leaf, f"tyre_{axle}"), getattr(leaf, f"static_tyre_load_{axle}")
    return -2.0 * magic_formula_force(SLIP, *magic_formula_coefficients(load, tyre), tyre)


@pytest.fixture(scope="module")
def limit_drives(leaf):
    """Weaving up to 7 m/s^2 with Magic Formula tyres."""
    return [drive(leaf, speed, weave(angle), 30.0, model="nonlinear", sensors=SILENT)
            for speed, angle in ((9.0, 0.2), (12.0, 0.15), (15.0, 0.1))]


def test_combinations_do_not_depend_on_a_steering_offset(leaf):
    with_offset = augment("linear", {"steering_offset": {"angle": 0.01}})
    np.testing.assert_allclose(_combination_values(with_offset, leaf), _combination_values(augment("linear", {}), leaf))


def test_load_and_tyres_that_are_stiffer_by_the_axle_loads_have_the_same_combinations(leaf):
    """Steady slip angles are m l_r a_y / (l C_f) and m l_f a_y / (l C_r): they show C over the axle load, not over the
    mass, which a load over the rear axle changes in another ratio."""
    load = {"load": {"mass": 300.0}}
    laden = augment("linear", load).effective_vehicle(leaf)
    stiffer = {f"{axle}_stiffness": {"factor": getattr(laden, load) / getattr(leaf, load)}
               for axle, load in (("front", "static_tyre_load_front"), ("rear", "static_tyre_load_rear"))}
    values = _combination_values(augment("linear", load | stiffer), leaf)
    np.testing.assert_allclose(values, _combination_values(augment("linear", {}), leaf), rtol=1e-9)


def test_interval_of_a_combination_includes_sets_that_fit_nearly_as_well(leaf, limit_drives):
    problem = linear_problem(["front_stiffness"], {"front_stiffness": 1.0}, seed=1)
    object.__setattr__(problem.errors.windows, "settings", DiscoverySettings())
    fit, other = fit_problem(problem, "front_stiffness"), problem.start.copy()
    other[problem.space.indices("front_stiffness")] = 1.4
    axles = Axles(problem, fit, approximate_joint_fit(problem, fit), limit_drives, leaf, 1.0,
                  [(("front_stiffness",), other)])
    front, *_ = axles.combinations(problem.space.at(problem.start))
    assert front.value < 1.2 * front.file and front.interval[1] == pytest.approx(1.4 * front.file, rel=0.02)


@pytest.mark.parametrize("axle", ["front", "rear"])
def test_axle_force_of_a_model_equals_its_tyre_force(leaf, axle):
    force = compute_axle_force("nonlinear", leaf, axle, SLIP)
    np.testing.assert_allclose(force, tyre_pair_force(leaf, axle), rtol=1e-9, atol=1e-6)
    stiffness = getattr(leaf, f"cornering_stiffness_{axle}")
    np.testing.assert_allclose(compute_axle_force("linear", leaf, axle, SLIP), stiffness * SLIP, rtol=1e-9, atol=1e-6)
    # Effects outside the tyres do not change their force.
    moved = augment("nonlinear", {"road_bank": {"angle": 0.05}, "steering_lag": {"time_constant": 0.1}})
    force = compute_axle_force(moved, leaf, axle, SLIP)
    np.testing.assert_allclose(force, tyre_pair_force(leaf, axle), rtol=1e-4, atol=1e-6)
    with pytest.raises(StCoreError, match="kinematic: this model has no axle forces"):
        compute_axle_force("kinematic", leaf, axle, SLIP)


@pytest.mark.parametrize("gradient", [-0.003, 0.002])
def test_roll_steer_changes_the_front_curve(leaf, gradient):
    model = augment("linear", {"roll_steer": {"gradient": gradient}})
    front, rear = (compute_axle_force(model, leaf, axle, SLIP) for axle in ("front", "rear"))
    a_y = (front + rear) / leaf.mass
    np.testing.assert_allclose(front, leaf.cornering_stiffness_front * (SLIP - gradient * a_y), rtol=2e-3, atol=1.0)
    np.testing.assert_allclose(rear, leaf.cornering_stiffness_rear * SLIP, rtol=2e-3, atol=1.0)


def test_saturation_limits_and_compliance_softens_the_axle(leaf):
    stiff = augment("linear", {"front_saturation": {"saturation": 1.0}})
    soft = augment(stiff, {"steering_compliance": {"compliance": 2e-6}})
    load = GRAVITY * leaf.mass * leaf.cg_to_rear_axle / leaf.wheelbase
    assert compute_axle_force(stiff, leaf, "front", np.array([1.4]))[0] == pytest.approx(load, rel=0.02)
    soft_force, stiff_force = (compute_axle_force(model, leaf, "front", SLIP[1:]) for model in (soft, stiff))
    assert (soft_force < stiff_force).all()


def test_curve_band_spans_the_draws_over_the_measured_slip(leaf):
    model = augment("nonlinear", {"front_tyre_curve": {"peak": 0.8, "curvature": 1.0},
                                   "front_stiffness": {"factor": 1.1}})
    spread = np.diag([{"peak": 0.1, "curvature": 0.0, "factor": 0.0}[p.name] ** 2 for _, p in model.free_parameters])
    driven = np.random.default_rng(1).normal(0.0, 0.02, 5000)
    curve = make_axle_curve(model, leaf, "front", driven, "nonlinear", draw_models(model, spread, leaf, 400))
    assert curve.slip[-1] == pytest.approx(np.quantile(np.abs(driven), 0.995)) and curve.slip[0] == 0.0
    assert curve.force[1] / curve.file[1] == pytest.approx(1.1, rel=0.02) and sum(curve.density) == pytest.approx(1.0)
    assert curve.density[0] > 5 * curve.density[-1]
    ends = [compute_axle_force(model.with_values({"front_tyre_curve": {"peak": 0.8 + side * 0.1645}}), leaf, "front",
                               curve.slip[-1:])[0] for side in (-1, 1)]
    assert [curve.low[-1], curve.high[-1]] == pytest.approx(ends, rel=0.02)
    alternative = model.with_values({"front_stiffness": {"factor": 1.5}})
    stiff = make_axle_curve(model, leaf, "front", driven, "nonlinear", alternatives=[alternative])
    assert stiff.low == stiff.force and stiff.high[1] / stiff.file[1] == pytest.approx(1.5, rel=0.02)
    assert (np.diff(np.subtract(curve.high, curve.low)) > -1e-9).all()
    assert curve.low[1] == pytest.approx(curve.high[1], rel=1e-3)
    with pytest.raises(StCoreError, match="0 measured slip angles"):
        make_axle_curve(model, leaf, "front", np.zeros(0), "nonlinear")


def test_measured_forces_match_the_tyre_curve(leaf, limit_drives):
    for regression in fit_axle_regressions(limit_drives, leaf):
        assert regression.usable, regression.reasons
        slip, force = regression.samples.bin_forces()
        assert slip[-1] > 0.04 and len(slip) >= 10
        expected = compute_axle_force("nonlinear", leaf, regression.axle, slip)
        np.testing.assert_allclose(force, expected, rtol=0.02, atol=30.0)


def test_force_error_distinguishes_models(leaf, limit_drives):
    front, rear = fit_axle_regressions(limit_drives, leaf)
    stiff = replace(leaf, cornering_stiffness_front=1.5 * leaf.cornering_stiffness_front).with_derived_scales()
    for regression in (front, rear):
        assert compute_force_error("nonlinear", leaf, regression.samples) < 0.01
        assert compute_force_error("linear", leaf, regression.samples) > 0.03
    stiff_error, true_error = (compute_force_error("nonlinear", car, front.samples) for car in (stiff, leaf))
    assert stiff_error > 10 * true_error


def test_steering_offset_does_not_bias_the_forces(leaf, limit_drives):
    moved = replace(leaf, steering_wheel_offset=leaf.steering_wheel_offset + 0.1)
    shifted = fit_axle_regressions(limit_drives, moved)[0]
    assert shifted.stiffness == pytest.approx(fit_axle_regressions(limit_drives, leaf)[0].stiffness, rel=0.02)
    assert compute_force_error("nonlinear", leaf, shifted.samples) < 0.03


def test_slope_of_the_wrong_sign_is_a_failed_fit(leaf, limit_drives):
    reversed_steering = [
        replace(log, steering_wheel_angle=None, road_wheel_angle=-log.road_wheel_angle) for log in limit_drives]
    front = fit_axle_regressions(reversed_steering, leaf)[0]
    assert np.isnan(front.stiffness) and not front.usable and "the fit failed" in front.reasons[-1]
    estimate = identify_stiffness(reversed_steering, leaf)["cornering_stiffness_front"]
    assert estimate.status == "unidentifiable" and np.isnan(estimate.value) and "The fit failed" in estimate.verdict


def test_too_little_excitation_is_a_reason_not_an_exception(leaf):
    circle = drive(leaf, 8.0, lambda t: np.full_like(t, 0.08), 40.0, name="circle")
    for regression in fit_axle_regressions([circle], leaf):
        assert "too little excitation: lateral acceleration: 1 of 11 bins" in regression.reasons[0]
