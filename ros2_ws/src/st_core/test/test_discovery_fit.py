"""The loss and the joint fits: against scipy, against finite differences, and against values that were put in."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import COLUMNS, linear_problem, recorded
from scipy import optimize, stats
from st_core.augmented import augment
from st_core.channels import CHANNEL_OF_COLUMN
from st_core.discovery import DiscoverySettings, fit_effects
from st_core.discovery.fit import FOLDS, Problem, Sensitivities, minimise_bounded
from st_core.discovery.loss import MAX_SCALED_ERROR, NU, Errors, Loss, rho, weight
from st_core.discovery.space import ACCELEROMETER_GAIN, Space
from st_core.discovery.windows import LOOKUP_CACHE_SIZE, Signals, Windows
from st_core.log import INS_SIGNALS
from st_core.log_signals import LogSignals

FEW = ("steering_offset", "mass", "yaw_inertia")


def fitted(problem: Problem, names, vector=None, iterations: int = 30):
    start = problem.start if vector is None else vector
    return problem.fit(names, problem.all_sensitivities(start), iterations=iterations)


def small_noise(problem: Problem, share: float) -> Problem:
    """The same with less noise, and a scale of it."""
    problem.errors.noise = share * problem.errors.noise
    problem.loss.rescale(problem.errors.truth)
    return problem


def test_roll_of_the_body_adds_to_what_is_felt_and_not_to_the_bias_of_the_sensor(leaf):
    bias, gain = 0.3, 0.1
    effects = {"lateral_acceleration_bias": {"bias": bias}}
    logs = [replace(log, acceleration_y=(1.0 + gain) * (log.acceleration_y - bias) + bias)
            for log in recorded(leaf, effects, 1, ("slalom", "lane_change"), noise=0.0)]
    windows = Windows(logs, leaf, DiscoverySettings())
    left = {g: windows.errors(augment("nonlinear", effects), g)[..., windows.columns.index("acceleration_y")]
            for g in (0.0, gain)}
    size = {g: np.sqrt(np.nanmean(np.square(errors))) for g, errors in left.items()}
    assert size[gain] < 0.2 * size[0.0]
    assert abs(np.nanmean(left[gain])) < 0.005


@pytest.mark.parametrize(("time", "values"), [("steering_time_ns", ("road_wheel_angle",)),
                                              ("ins_time_ns", (*INS_SIGNALS, "acceleration_x", "acceleration_y"))])
def test_a_gap_of_a_second_is_no_error_of_the_model(leaf, time, values):
    (log,) = recorded(leaf, {}, 1, ["slalom"], noise=0.0)
    middle = (int(getattr(log, time)[0]) + int(getattr(log, time)[-1])) // 2
    kept = np.abs(getattr(log, time) - middle) > 500_000_000
    cut = replace(log, **{name: getattr(log, name)[kept] for name in (time, *values)})
    space = Space("nonlinear", DiscoverySettings())
    losses = []
    for one in (log, cut):
        windows = Windows([one], leaf, DiscoverySettings())
        losses.append(Loss(Errors(windows, space), space.null))
    whole, rest = losses
    assert 0.3 * whole.residual_count < rest.residual_count < 0.95 * whole.residual_count
    assert np.isfinite(rest.errors.at(space.null)[rest.known]).all()
    assert rest.total(space.null) / rest.residual_count < 1.5 * whole.total(space.null) / whole.residual_count


# The loss


def test_instants_that_are_asked_for_again_are_found_again(leaf):
    (log,) = recorded(leaf, {}, 1, ["slalom"])
    plain, kept = LogSignals(log, 0.1, 1.0), Signals(log, 0.1)
    draw = np.random.default_rng(2)
    for _ in range(3 * LOOKUP_CACHE_SIZE):  # arrays of one length, each at the place of one that is gone
        wanted = draw.integers(-10**7, int(log.ins_time_ns[-1]) + 10**7, 50)
        for _ in range(2):
            for name in ("x", "yaw_rate"):
                np.testing.assert_array_equal(kept.ins_at(wanted, name), plain.ins_at(wanted, name))
        wanted += 20_000_000  # the same array with other numbers in it
        np.testing.assert_array_equal(kept.ins_at(wanted, "x"), plain.ins_at(wanted, "x"))


def test_rho_is_the_likelihood_of_students_distribution():
    z = np.linspace(-30.0, 30.0, 121)
    expected = stats.t(NU).logpdf(0.0) - stats.t(NU).logpdf(z)
    np.testing.assert_allclose(rho(z), expected, atol=1e-12)
    slope = (rho(z + 1e-6) - rho(z - 1e-6)) / 2e-6
    np.testing.assert_allclose(2.0 * z * weight(z), slope, atol=1e-6)


def test_scale_is_what_two_thirds_of_the_errors_are_below():
    problem = linear_problem(FEW, {}, 1, count=4000, common=0.0, size=0.02)
    np.testing.assert_allclose(problem.loss.scale, 0.02, rtol=0.06)
    larger = problem.start.copy()
    larger[problem.space.indices("mass")] += 3.0 * problem.space.scale[problem.space.indices("mass")]
    problem.loss.rescale(larger)
    np.testing.assert_allclose(problem.loss.scale, 0.02 * np.sqrt(10.0), rtol=0.06)


def test_scale_stops_at_the_resolution_of_the_sensors():
    problem = small_noise(linear_problem(FEW, {}, 1), 1e-9)
    smallest = [CHANNEL_OF_COLUMN[column].resolution for column in COLUMNS] * 4
    np.testing.assert_array_equal(problem.loss.scale, smallest)


def test_what_was_not_measured_does_not_count():
    problem = linear_problem(FEW, {"mass": 1.0}, 2)
    problem.errors.windows.known[1:, 2::len(COLUMNS)] = False  # one column, at all points
    problem.errors.windows.known[5] = False  # one window
    loss = Loss(problem.errors, problem.start)
    before = loss.total(problem.start)
    assert loss.residual_count == (160 - 1) * 4 * (len(COLUMNS) - 1) + 4
    assert loss.window_losses(problem.start)[5] == 0.0
    scale = loss.scale.copy()
    problem.errors.noise[1:, 2::len(COLUMNS)] = 1e3
    problem.errors.noise[5] = np.nan
    assert loss.total(problem.start) == before
    loss.scale = scale
    q = loss.quadratic(loss.errors.at(problem.start), problem.errors.signatures)
    assert np.isfinite(q.hessian).all() and not q.gradient[5].any() and not q.hessian[5].any()


def test_prediction_that_diverges_is_far_off_and_has_no_sensitivities():
    problem = linear_problem(FEW, {}, 3)
    loss = Loss(problem.errors, problem.start)
    before = loss.window_losses(problem.start)
    problem.errors.noise[7] = np.nan  # measured, lost by a later vector only
    problem.errors.noise[8] = 1e9
    after = loss.window_losses(problem.start)
    assert after[7] == after[8] == pytest.approx(4 * len(COLUMNS) * rho(np.array(MAX_SCALED_ERROR)))
    np.testing.assert_array_equal(np.delete(after, (7, 8)), np.delete(before, (7, 8)))
    q = loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    assert not q.gradient[7:9].any() and not q.hessian[7:9].any()
    assert np.isfinite(loss.scale_of(problem.start)).all()


def test_windows_without_any_prediction_at_the_start_are_left_out():
    problem = linear_problem(FEW, {}, 3)
    problem.errors.noise[7] = np.nan
    loss = Loss(problem.errors, problem.start)
    assert loss.residual_count == (160 - 1) * 4 * len(COLUMNS) and loss.window_losses(problem.start)[7] == 0.0


def test_quadratic_touches_the_loss_and_lies_above_it():
    """Reweighted squares: the slope is that of the loss, and of the errors that are linear it is never below."""
    problem = linear_problem(FEW, {"mass": 2.0, "yaw_inertia": -1.0}, 4)
    loss, space = problem.loss, problem.space
    q = loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    np.testing.assert_allclose(q.cost, loss.window_losses(problem.start))
    rng = np.random.default_rng(0)
    for size in (1e-4, 0.3, 3.0):
        d = np.where(np.isin(space.effect_of, FEW), size * rng.standard_normal(len(space)), 0.0)
        true = loss.window_losses(problem.start + d * space.scale)
        result = q.cost - 2.0 * q.gradient @ d + np.einsum("i,nij,j->n", d, q.hessian, d)
        assert (result >= true - 1e-9).all()
        if size == 1e-4:
            np.testing.assert_allclose(result - q.cost, true - q.cost, atol=1e-6)


def test_quadratic_by_group_is_the_sum_of_its_windows():
    problem = linear_problem(FEW, {}, 5)
    q = problem.loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    groups = np.arange(160) % 3
    for part, whole in zip(("cost", "gradient", "hessian"), (q.cost, q.gradient, q.hessian), strict=True):
        summed = getattr(q.sum_groups(groups), part)
        np.testing.assert_allclose(summed, [whole[groups == k].sum(axis=0) for k in range(3)])
    indices = problem.space.indices("mass", "yaw_inertia")
    np.testing.assert_array_equal(q.only(indices).hessian, q.hessian[:, indices[:, None], indices])


def test_sensitivities_say_how_errors_fall_also_at_a_bound():
    problem = linear_problem(FEW, {}, 6)
    indices = problem.space.indices(*FEW)
    for edge in (problem.space.low, problem.space.high):
        vector = problem.start.copy()
        vector[indices] = edge[indices]
        found = problem.loss.sensitivities(vector, indices)
        np.testing.assert_allclose(found, problem.errors.signatures[indices], atol=1e-9)


def test_sensitivities_of_the_simulation_have_the_sign_of_the_effect(leaf):
    """A car that steers to the left of what is measured: errors fall as the offset rises."""
    settings = DiscoverySettings(windows=50)
    space = Space("nonlinear", settings)
    runs = recorded(leaf, {"steering_offset": {"angle": 0.005}}, 1, ("slalom",), noise=0.0)
    loss = Loss(Errors(Windows(runs, leaf, settings), space), space.null)
    own = space.indices("steering_offset")
    lateral = loss.errors.windows.columns.index("position_lateral") - len(loss.errors.windows.columns)
    rows, fall = loss.errors.at(space.null), loss.sensitivities(space.null, own)[0]
    np.testing.assert_allclose(fall[:, lateral], rows[:, lateral], rtol=0.1)  # one typical size: all of the error


# Solvers


def test_broyden_gives_what_was_lost_for_the_step_and_nothing_else_new():
    rng = np.random.default_rng(1)
    sensitivities = Sensitivities(np.zeros(3), np.arange(3), rng.standard_normal((3, 5, 4)))
    scale, there = np.array([0.1, 1.0, 10.0]), np.array([0.05, 0.0, -3.0])
    taken = rng.standard_normal((5, 4))
    taken[0, 0] = np.nan
    moved = sensitivities.update(there, scale, taken)
    step = there / scale
    known = np.isfinite(taken)
    np.testing.assert_allclose(np.tensordot(step, moved.values, 1)[known], taken[known])
    assert moved.values[:, 0, 0] == pytest.approx(sensitivities.values[:, 0, 0])
    across = np.array([step[2], 5.0, -step[0]])
    np.testing.assert_allclose(np.tensordot(across, moved.values, 1), np.tensordot(across, sensitivities.values, 1))
    assert sensitivities.update(sensitivities.vector, scale, taken) is sensitivities


# Fits


def test_fit_recovers_what_was_put_in():
    """To the noise: what blocks share is a fiftieth of what the effects do."""
    truth = {"steering_offset": 2.0, "mass": -1.0, "yaw_inertia": 0.5}
    problem = small_noise(linear_problem(FEW, truth, 7), 0.05)
    fit = fitted(problem, FEW)
    off = (fit.vector - problem.errors.truth) / problem.space.scale
    assert np.abs(off).max() < 0.01
    assert set(problem.space.effect_of[fit.indices]) == {*FEW, ACCELEROMETER_GAIN}


def test_fit_is_the_minimum_scipy_finds():
    problem = linear_problem(FEW, {"mass": 1.0}, 8)
    fit = fitted(problem, FEW, iterations=100)

    def total(d):
        vector = problem.start.copy()
        vector[fit.indices] += d * problem.space.scale[fit.indices]
        return problem.loss.total(vector)
    best = optimize.minimize(total, np.zeros(len(fit.indices)), method="BFGS", options={"gtol": 1e-4})
    assert problem.loss.total(fit.vector) <= best.fun + 2e-4 * problem.residual_count


def test_windows_that_are_wrong_move_a_fit_little():
    problem = small_noise(linear_problem(FEW, {"mass": 1.0}, 9), 0.1)
    problem.errors.noise[::10] += 5.0  # a tenth of them, metres off
    own = problem.space.indices("mass")
    off = (fitted(problem, FEW).vector - problem.errors.truth)[own] / problem.space.scale[own]
    assert np.abs(off).max() < 0.05


def test_fit_stays_within_bounds():
    problem = small_noise(linear_problem(("steering_lag", "mass"), {"steering_lag": -2.0}, 10), 0.1)
    fit = fitted(problem, ("steering_lag", "mass"))
    assert fit.vector[problem.space.indices("steering_lag")] == 0.0


def test_only_effects_of_the_set_move_without_a_prior():
    problem = linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 11)
    fit = fitted(problem, ("mass",))
    moved = np.flatnonzero(fit.vector != problem.start)
    assert set(problem.space.effect_of[moved]) <= {"mass", ACCELEROMETER_GAIN}
    more = problem.fit(("yaw_inertia",), fit.sensitivities)  # what is not of the set goes back to the start
    assert (more.vector[problem.space.indices("mass")] == problem.start[problem.space.indices("mass")]).all()


def correlated(size: int, seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).standard_normal((size, size))
    return root @ root.T + 5.0 * np.eye(size)


def test_prior_holds_the_rest_as_if_the_set_were_unknown():
    """The curvature that is left is the inverse of the covariance of the rest alone."""
    problem = linear_problem(FEW, {}, 12)
    prior = correlated(len(problem.space), 1)
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    everything = np.arange(len(problem.space))
    free = problem.space.indices("mass", "steering_offset")
    rest = np.setdiff1d(everything, free)
    held = problem.prior_curvature(("mass", "steering_offset"), everything)
    np.testing.assert_allclose(held[np.ix_(rest, rest)], np.linalg.inv(np.linalg.inv(prior)[np.ix_(rest, rest)]),
                               rtol=1e-6, atol=1e-7)
    assert not held[free].any() and not held[:, free].any()
    np.testing.assert_allclose(problem.prior_curvature((), everything), prior)


@pytest.mark.parametrize("strength", [1.0, 1e8])
def test_firm_prior_keeps_the_rest_at_the_start(strength):
    problem = small_noise(linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 13), 0.1)
    prior = strength * np.eye(len(problem.space))
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    fit = fitted(problem, ("mass",))
    by = (fit.vector - problem.start) / problem.space.scale
    mass, inertia = by[problem.space.indices("mass")], by[problem.space.indices("yaw_inertia")]
    assert mass == pytest.approx(1.0, abs=0.05)
    assert inertia == pytest.approx(1.0 if strength == 1.0 else 0.0, abs=0.05)


def test_with_a_prior_leaving_it_costs_and_a_fold_moves_only_what_is_free():
    problem = small_noise(linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 13), 0.1)
    prior = correlated(len(problem.space), 2)
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    without, fit = fitted(problem, ()), fitted(problem, ("mass",))
    away = (without.vector - problem.start) / problem.space.scale
    assert without.held_out.sum() == pytest.approx(problem.loss.total(without.vector) + away @ prior @ away, rel=1e-6)
    assert not any(step.any() for step in problem.leave_out_groups(without, problem.fold)[0].values())
    own = problem.space.indices("mass")
    for step in problem.leave_out_groups(fit, problem.fold)[0].values():
        assert step[own].any() and not np.delete(step, own).any()


def test_held_out_loss_is_that_of_fits_without_the_fold():
    """Their optimism, block by block of a fold, is what single refits show, but for terms of third order."""
    problem = linear_problem(FEW, {"mass": 1.0}, 14, count=320)
    fit = fitted(problem, FEW, iterations=100)
    inside = problem.loss.window_losses(fit.vector)
    promised = fit.held_out.sum() - inside.sum()
    shown = 0.0
    for fold in range(FOLDS):
        mine = problem.fold[problem.block] == fold
        loss = Loss(problem.errors, problem.start)
        loss.known, loss.scale = problem.loss.known & ~mine[:, None], problem.loss.scale
        rest = Problem(loss, problem.start, problem.block)
        vector = rest.fit(FEW, problem.all_sensitivities(problem.start), iterations=100).vector
        shown += float((problem.loss.window_losses(vector) - inside)[mine].sum())
    assert promised > 0.0 and shown > 0.0
    assert promised == pytest.approx(shown, rel=0.25)


def test_held_out_rows_are_those_of_the_fold_values():
    problem = linear_problem(FEW, {"mass": 1.0}, 15)
    fit = fitted(problem, FEW, iterations=100)
    rows = problem.held_out_rows(fit)
    for group, step in problem.leave_out_groups(fit, problem.held_out_groups)[0].items():
        mine = problem.held_out_groups[problem.block] == group
        vector = fit.vector.copy()
        vector[fit.indices] += step * problem.space.scale[fit.indices]
        np.testing.assert_allclose(rows[mine], problem.errors.at(vector)[mine], atol=1e-8)


@pytest.mark.parametrize("values", [
    {"steering_offset": {"angle": 0.006}},
    {"steering_ratio": {"factor": 0.93}, "yaw_inertia": {"factor": 1.2}},
])
def test_effects_of_a_simulated_drive_are_recovered(leaf, values):
    runs = recorded(leaf, values, 2, ("lane_change", "slalom"), noise=0.2)
    model = fit_effects(runs, leaf, "nonlinear", tuple(values), DiscoverySettings(windows=50))
    for name, parameters in values.items():
        for parameter, value in parameters.items():
            assert model.values[name][parameter] == pytest.approx(value, rel=0.02)


def test_a_fit_does_not_check_the_stability_of_each_trial_model(leaf):
    """A search predicts with thousands of trial values: the command checks the step, not the windows."""
    stiff = replace(leaf, yaw_inertia=0.1 * leaf.yaw_inertia, minimum_slip_speed=0.1)
    settings = DiscoverySettings(windows=50)
    windows = Windows(recorded(leaf, {}, 1, ("step",)), stiff, settings)
    windows._batch._speeds = (0.2, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        windows.errors(Space("linear", settings).model)


def test_held_out_loss_is_not_below_the_loss_of_the_fit(leaf):
    """Leaving out cannot help: fold by fold the values fitted to everything else do worse on it."""
    settings = DiscoverySettings(windows=100)
    space = Space("nonlinear", settings)
    w = Windows(recorded(leaf, {}, 1, ("sweep", "brake_in_turn", "step")), leaf, settings)
    loss = Loss(Errors(w, space), space.null)
    p = Problem(loss, space.null, w.block)
    fit = p.fit(("steering_lag", "steering_delay"), p.all_sensitivities(space.null))
    inside = loss.total(fit.vector)
    assert fit.held_out.sum() >= inside


@pytest.mark.parametrize("seed", range(40))
def test_bounded_is_the_minimum_within_bounds(seed):
    rng = np.random.default_rng(seed)
    k = int(rng.integers(1, 12))
    root = rng.standard_normal((k + 3, k)) * 10.0 ** rng.uniform(-1.0, 1.0, k)
    a, b = root.T @ root + 1e-6 * np.eye(k), root.T @ (3.0 * rng.standard_normal(k + 3))
    low, high = -rng.uniform(0.0, 2.0, k), rng.uniform(0.0, 2.0, k)
    low[rng.uniform(size=k) < 0.3] = 0.0  # already on a bound
    x = minimise_bounded(a, b, low, high)
    assert ((low <= x) & (x <= high)).all()
    factor = np.linalg.cholesky(a)
    best = optimize.lsq_linear(factor.T, np.linalg.solve(factor, b), (low, high + 1e-12), tol=1e-14).x
    value, least = (float(v @ a @ v - 2.0 * b @ v) for v in (x, best))
    assert value <= least + 1e-6 * max(abs(least), 1.0)
