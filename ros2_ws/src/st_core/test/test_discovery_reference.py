"""Fit of the healthy car to its reference drives: prior precision, and gain between those drives."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import linear_problem, recorded
from exact_drive import Sines, exact_drive
from st_core.discovery import DiscoverySettings
from st_core.discovery.library_fit import (
    _gain_between_runs,
    fit_healthy_car,
    theoretical_values,
)
from st_core.discovery.space import Space, find_file_quantities, prior_deviations
from st_core.errors import StCoreError

FEW = ("steering_offset", "mass", "yaw_rate_bias")


def gain_between_runs(problem, vector=None) -> float:
    """The gain, from the quadratic approximation about a vector; by default about the start."""
    vector, size = problem.start if vector is None else vector, len(problem.space)
    q = problem.loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    prior = np.eye(size) / 9.0
    return _gain_between_runs(q.after(problem.distance(vector)), problem.space, problem.errors.windows,
                              np.full((size, size), 1.5**2), prior, prior @ problem.distance(vector))


def leave_one_out_gain(problem) -> float:
    """The gain by direct fits of the least-squares problem: all runs but one, then that run with this fit as prior."""
    q = problem.loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    free, run, gains = problem.space.indices(*FEW), problem.errors.windows.run, []
    by_run = q.select(free).sum_groups(run)
    roots = [np.linalg.cholesky(h).T for h in by_run.hessian]
    targets = [np.linalg.solve(r.T, g) for r, g in zip(roots, by_run.gradient, strict=True)]
    weak = np.eye(len(free)) / 3.0
    for k in range(len(roots)):
        others = [j for j in range(len(roots)) if j != k]
        centre = np.linalg.lstsq(np.vstack([weak, *(roots[j] for j in others)]),
                                 np.concatenate([np.zeros(len(free)), *(targets[j] for j in others)]))[0]

        def loss(free_effect: str = "", k=k, others=others, centre=centre) -> float:
            # A free effect gets a shift of its own, which the prior does not see.
            own = np.eye(len(free))[:, np.isin(free, problem.space.indices(free_effect) if free_effect else [])]
            prior = np.vstack([weak, *(roots[j] / 1.5 for j in others)])
            rows = np.block([[roots[k], roots[k] @ own], [prior, 0.0 * prior @ own]])
            target = np.concatenate([targets[k], prior @ centre])
            residual = target - rows @ np.linalg.lstsq(rows, target)[0]
            return float(residual @ residual)
        gains += [(loss() - loss(effect)) / problem.loss.known[run == k].sum() for effect in FEW]
    return max(gains)


def test_gain_between_runs_is_that_of_direct_fits_without_the_run():
    problem = linear_problem(FEW, {"mass": 2.0}, 1, runs=4)
    assert gain_between_runs(problem) == pytest.approx(leave_one_out_gain(problem), rel=1e-4)


def test_gain_between_runs_does_not_depend_on_the_vector_of_the_approximation():
    problem = linear_problem(FEW, {"mass": 2.0}, 1, runs=4)
    other = problem.start.copy()
    other[problem.space.indices(*FEW)] += 2.0 * problem.space.scale[problem.space.indices(*FEW)]
    assert gain_between_runs(problem, other) == pytest.approx(gain_between_runs(problem), rel=1e-6)


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


def test_reference_drives_without_a_usable_prediction_are_an_error(leaf):
    slow = [replace(log, velocity_x=0.01 * log.velocity_x) for log in recorded(leaf, {}, 3)]
    settings = DiscoverySettings(effects=("yaw_rate_bias",))
    with pytest.raises(StCoreError, match="no prediction of 5 s fits into the reference drives"):
        fit_healthy_car(slow, leaf, Space("nonlinear", settings), settings, 1, lambda: None)


@pytest.mark.slow
def test_values_that_the_reference_drives_do_not_determine_are_as_uncertain_as_in_the_vehicle_file(leaf):
    settings = DiscoverySettings(windows=50, effects=("mass", "cg_position"))
    space = Space("nonlinear", settings)
    runs = [replace(exact_drive(leaf, 30.0, turning=Sines(0.0, ()), seed=k), name=f"straight {k}") for k in range(3)]
    healthy = fit_healthy_car(runs, leaf, space, settings, 1, lambda: None)
    in_file = prior_deviations(find_file_quantities(space, leaf), space.scale)
    for name in settings.effects:
        (index,) = space.indices(name)
        assert 0.95 * in_file[index] < np.sqrt(healthy.covariance[index, index]) < 1.001 * in_file[index]


@pytest.mark.slow
def test_second_start_of_the_fit_is_at_the_theoretical_values():
    space = Space("nonlinear", DiscoverySettings())
    changed = {(space.parameters[i][0], space.parameters[i][1].name): theoretical_values(space)[i]
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
        # The drives determine these values; a prediction for a new drive has twice the variance of the fit.
        variance = healthy.covariance[index, index] * space.scale[index] ** 2
        assert 2.0 * variance == pytest.approx(deviation[index] ** 2, rel=0.1)
    assert (healthy.residual_scale > 0.0).all() and healthy.gain_between_runs < 0.05
