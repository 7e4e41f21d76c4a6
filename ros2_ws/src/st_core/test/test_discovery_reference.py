"""Fit of the healthy car to its reference drives: prior precision, and gain between those drives."""

import numpy as np
import pytest
from discovery_drives import linear_problem, recorded
from st_core.discovery import DiscoverySettings
from st_core.discovery.library_fit import _gain_between_runs, fit_healthy_car, theoretical_values
from st_core.discovery.space import Space

FEW = ("steering_offset", "mass", "yaw_rate_bias")


def gain_between_runs(problem) -> float:
    q = problem.loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    size = len(problem.space)
    return _gain_between_runs(q, problem.space, problem.errors.windows, np.ones(size), np.eye(size) / 9.0)


def test_gain_of_healthy_drives_is_larger_if_one_run_differs():
    problem = linear_problem(FEW, {}, 1, runs=4)
    equal_runs = gain_between_runs(problem)
    assert 0.0 <= equal_runs < 0.1
    first = problem.errors.windows.run == 0
    mass = int(problem.space.indices("mass")[0])
    problem.errors.noise[first] += 2.0 * problem.errors.signatures[mass][first]
    assert gain_between_runs(problem) > 5.0 * max(equal_runs, 0.02)


def test_two_runs_are_too_few_for_a_gain_between_runs():
    assert gain_between_runs(linear_problem(FEW, {}, 1, runs=2)) == 0.0


@pytest.mark.slow
def test_second_start_of_the_fit_is_at_the_theoretical_values():
    space = Space("nonlinear", DiscoverySettings())
    changed = {(space.free[i][0], space.free[i][1].name): theoretical_values(space)[i]
             for i in np.flatnonzero(theoretical_values(space) != space.null)}
    assert changed == {("combined_slip", "share"): 1.0}


@pytest.mark.slow
def test_healthy_car_fit_recovers_the_true_values_within_its_uncertainty(leaf):
    effects = {"steering_lag": {"time_constant": 0.06}, "heading_misalignment": {"angle": 0.01}}
    settings = DiscoverySettings(windows=60, effects=("steering_lag", "heading_misalignment", "yaw_rate_bias"))
    space = Space("nonlinear", settings)
    healthy = fit_healthy_car(recorded(leaf, effects, 3), leaf, space, settings, 1, lambda: None)
    deviation = np.sqrt(0.5 * np.diag(np.linalg.inv(healthy.prior))) * space.scale
    for name, values in effects.items():
        (truth,), index = values.values(), int(space.indices(name)[0])
        assert abs(healthy.vector[index] - truth) < 4.0 * deviation[index] < 0.2 * truth
    assert (healthy.residual_scale > 0.0).all() and healthy.gain_between_runs < 0.05
