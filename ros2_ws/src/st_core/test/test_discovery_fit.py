"""The loss and the joint fits, compared with scipy, finite differences and known true values."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import COLUMNS, fit_problem, linear_problem, recorded
from scipy import optimize, stats
from st_core.augmented import augment
from st_core.channels import CHANNEL_OF_COLUMN
from st_core.discovery import DiscoverySettings, fit_effects
from st_core.discovery.fit import FOLDS, Problem, Sensitivities, minimise_bounded
from st_core.discovery.loss import DIFFERENCE_STEP, MAX_SCALED_ERROR, NU, Errors, Loss, rho, weight
from st_core.discovery.space import ACCELEROMETER_GAIN, Space
from st_core.discovery.windows import LOOKUP_CACHE_SIZE, Signals, Windows
from st_core.log import INS_SIGNALS, LogSignals

FEW = ("steering_offset", "mass", "yaw_inertia")


def reduce_noise(problem: Problem, factor: float) -> Problem:
    """The problem with its noise multiplied by `factor`, and the residual scale of that noise."""
    problem.errors.noise = factor * problem.errors.noise
    problem.loss.rescale(problem.errors.truth)
    return problem


def test_roll_gain_scales_the_specific_force_but_not_the_bias_of_the_accelerometer(leaf):
    bias, gain = 0.3, 0.1
    effects = {"lateral_acceleration_bias": {"bias": bias}}
    logs = [replace(log, acceleration_y=(1.0 + gain) * (log.acceleration_y - bias) + bias)
            for log in recorded(leaf, effects, 1, ("slalom", "lane_change"), noise=0.0)]
    windows = Windows(logs, leaf, DiscoverySettings())
    residual = {g: windows.errors(augment("nonlinear", effects), g)[..., windows.columns.index("acceleration_y")]
            for g in (0.0, gain)}
    size = {g: np.sqrt(np.nanmean(np.square(errors))) for g, errors in residual.items()}
    assert size[gain] < 0.2 * size[0.0]
    assert abs(np.nanmean(residual[gain])) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("time", "values"), [("steering_time_ns", ("road_wheel_angle",)),
                                              ("ins_time_ns", (*INS_SIGNALS, "acceleration_x", "acceleration_y"))])
def test_gap_of_one_second_does_not_raise_the_loss(leaf, time, values):
    (log,) = recorded(leaf, {}, 1, ["slalom"], noise=0.0)
    middle = (int(getattr(log, time)[0]) + int(getattr(log, time)[-1])) // 2
    kept = np.abs(getattr(log, time) - middle) > 500_000_000
    cut = replace(log, **{name: getattr(log, name)[kept] for name in (time, *values)})
    space = Space("nonlinear", DiscoverySettings())
    losses = []
    for one in (log, cut):
        windows = Windows([one], leaf, DiscoverySettings())
        losses.append(Loss(Errors(windows, space), space.null))
    complete, with_gap = losses
    assert 0.3 * complete.residual_count < with_gap.residual_count < 0.95 * complete.residual_count
    assert np.isfinite(with_gap.errors.at(space.null)[with_gap.known]).all()
    loss_per_residual = [loss.total(space.null) / loss.residual_count for loss in losses]
    assert loss_per_residual[1] < 1.5 * loss_per_residual[0]


def test_car_beyond_the_limits_of_a_vehicle_file_is_not_predicted(leaf):
    (log,) = recorded(leaf, {}, 1, ["slalom"])
    stiff = replace(leaf, tyre_rear=leaf.tyre_rear._replace(lambda_ky=9.0))  # the limit is 10
    errors = Errors(Windows([log], stiff, DiscoverySettings()), Space("nonlinear", DiscoverySettings()))
    beyond = errors.space.null.copy()
    beyond[errors.space.indices("rear_stiffness")] = 1.5
    assert np.isnan(errors.at(beyond)).all() and errors.at(beyond).shape == errors.windows.known.shape


@pytest.mark.parametrize("first_side", [1.0, -1.0])
def test_sensitivity_at_a_limit_of_a_vehicle_file_is_that_of_the_other_side(leaf, first_side):
    (log,) = recorded(leaf, {}, 1, ["slalom"])
    at_limit = replace(leaf, tyre_rear=leaf.tyre_rear._replace(lambda_ky=10.0))
    errors = Errors(Windows([log], at_limit, DiscoverySettings()), Space("nonlinear", DiscoverySettings()))
    space = errors.space
    index = space.indices("rear_stiffness")
    space.sign[index] = first_side
    (sensitivity,) = Loss(errors, space.null).sensitivities(space.null, index)
    moved = space.null.copy()
    moved[index] -= DIFFERENCE_STEP * space.scale[index]
    expected = (errors.at(moved) - errors.at(space.null)) / DIFFERENCE_STEP
    assert np.nanmax(np.abs(expected)) > 0.0
    np.testing.assert_allclose(sensitivity, np.nan_to_num(expected), rtol=1e-9, atol=1e-12)


# The loss


def test_cached_interpolation_equals_the_uncached_one(leaf):
    (log,) = recorded(leaf, {}, 1, ["slalom"])
    uncached, cached = LogSignals(log, 0.1, 1.0), Signals(log, 0.1)
    draw = np.random.default_rng(2)
    for _ in range(3 * LOOKUP_CACHE_SIZE):  # arrays of one length may reuse the memory of a released one
        instants = draw.integers(-10**7, int(log.ins_time_ns[-1]) + 10**7, 50)
        for _ in range(2):
            for name in ("x", "yaw_rate"):
                np.testing.assert_array_equal(cached.ins_at(instants, name), uncached.ins_at(instants, name))
        instants += 20_000_000  # changes the values of the same array
        np.testing.assert_array_equal(cached.ins_at(instants, "x"), uncached.ins_at(instants, "x"))


def test_rho_is_the_negative_log_likelihood_of_students_t():
    z = np.linspace(-30.0, 30.0, 121)
    expected = stats.t(NU).logpdf(0.0) - stats.t(NU).logpdf(z)
    np.testing.assert_allclose(rho(z), expected, atol=1e-12)
    slope = (rho(z + 1e-6) - rho(z - 1e-6)) / 2e-6
    np.testing.assert_allclose(2.0 * z * weight(z), slope, atol=1e-6)


def test_residual_scale_is_the_standard_deviation_of_the_errors():
    problem = linear_problem(FEW, {}, 1, count=4000, common=0.0, size=0.02)
    np.testing.assert_allclose(problem.loss.scale, 0.02, rtol=0.06)
    larger = problem.start.copy()
    larger[problem.space.indices("mass")] += 3.0 * problem.space.scale[problem.space.indices("mass")]
    problem.loss.rescale(larger)
    np.testing.assert_allclose(problem.loss.scale, 0.02 * np.sqrt(10.0), rtol=0.06)


def test_residual_scale_has_a_lower_limit():
    problem = reduce_noise(linear_problem(FEW, {}, 1), 1e-9)
    smallest = [CHANNEL_OF_COLUMN[column].min_residual_scale for column in COLUMNS] * 4
    np.testing.assert_array_equal(problem.loss.scale, smallest)


def test_unmeasured_values_do_not_contribute_to_the_loss():
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


def test_diverged_prediction_has_the_maximum_loss_and_no_sensitivities():
    problem = linear_problem(FEW, {}, 3)
    loss = Loss(problem.errors, problem.start)
    before = loss.window_losses(problem.start)
    problem.errors.noise[7] = np.nan  # measured, but the prediction fails at a later vector
    problem.errors.noise[8] = 1e9
    after = loss.window_losses(problem.start)
    assert after[7] == after[8] == pytest.approx(4 * len(COLUMNS) * rho(np.array(MAX_SCALED_ERROR)))
    np.testing.assert_array_equal(np.delete(after, (7, 8)), np.delete(before, (7, 8)))
    q = loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    assert not q.gradient[7:9].any() and not q.hessian[7:9].any()
    assert np.isfinite(loss.scale_of(problem.start)).all()


def test_windows_without_a_prediction_at_the_start_are_left_out():
    problem = linear_problem(FEW, {}, 3)
    problem.errors.noise[7] = np.nan
    loss = Loss(problem.errors, problem.start)
    assert loss.residual_count == (160 - 1) * 4 * len(COLUMNS) and loss.window_losses(problem.start)[7] == 0.0


def test_quadratic_majorises_the_loss():
    """Reweighted least squares: equal slope at the start, and never below the loss for linear errors."""
    problem = linear_problem(FEW, {"mass": 2.0, "yaw_inertia": -1.0}, 4)
    loss, space = problem.loss, problem.space
    q = loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    np.testing.assert_allclose(q.cost, loss.window_losses(problem.start))
    rng = np.random.default_rng(0)
    for size in (1e-4, 0.3, 3.0):
        d = np.where(np.isin(space.effect_names, FEW), size * rng.standard_normal(len(space)), 0.0)
        losses = loss.window_losses(problem.start + d * space.scale)
        quadratic = q.cost - 2.0 * q.gradient @ d + np.einsum("i,nij,j->n", d, q.hessian, d)
        assert (quadratic >= losses - 1e-9).all()
        if size == 1e-4:
            np.testing.assert_allclose(quadratic - q.cost, losses - q.cost, atol=1e-6)


def test_quadratic_of_a_group_is_the_sum_over_its_windows():
    problem = linear_problem(FEW, {}, 5)
    q = problem.loss.quadratic(problem.errors.at(problem.start), problem.errors.signatures)
    groups = np.arange(160) % 3
    sums = q.sum_groups(groups)
    for part in ("cost", "gradient", "hessian"):
        expected = [getattr(q, part)[groups == k].sum(axis=0) for k in range(3)]
        np.testing.assert_allclose(getattr(sums, part), expected)
    indices = problem.space.indices("mass", "yaw_inertia")
    np.testing.assert_array_equal(q.select(indices).hessian, q.hessian[:, indices[:, None], indices])


def test_sensitivities_are_correct_at_a_bound_too():
    problem = linear_problem(FEW, {}, 6)
    indices = problem.space.indices(*FEW)
    for edge in (problem.space.low, problem.space.high):
        vector = problem.start.copy()
        vector[indices] = edge[indices]
        found = problem.loss.sensitivities(vector, indices)
        np.testing.assert_allclose(found, problem.errors.signatures[indices], atol=1e-9)


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_sensitivities_are_correct_if_the_bounds_are_closer_than_the_step(fraction, central):
    """An effect of a user may have two parameters of one unit, of which the larger determines the scale of both."""
    problem = linear_problem(FEW, {}, 1)
    space, (index,) = problem.space, problem.space.indices("mass")
    space.scale[index] = 100.0 * (space.high[index] - space.low[index])
    vector = space.null.copy()
    vector[index] = space.low[index] + fraction * (space.high[index] - space.low[index])
    (sensitivity,) = Loss(problem.errors, space.null, central).sensitivities(vector, np.array([index]))
    np.testing.assert_allclose(sensitivity, problem.errors.signatures[index], atol=1e-9)


def test_sensitivity_to_the_steering_offset_has_the_right_sign_and_size(leaf):
    """The car steers further left than measured: the errors decrease as the offset increases."""
    settings = DiscoverySettings(windows=50)
    space = Space("nonlinear", settings)
    runs = recorded(leaf, {"steering_offset": {"angle": 0.005}}, 1, ("slalom",), noise=0.0)
    loss = Loss(Errors(Windows(runs, leaf, settings), space), space.null)
    index = space.indices("steering_offset")
    lateral = loss.errors.windows.columns.index("position_lateral") - len(loss.errors.windows.columns)
    errors, decrease = loss.errors.at(space.null), loss.sensitivities(space.null, index)[0]
    np.testing.assert_allclose(decrease[:, lateral], errors[:, lateral], rtol=0.1)  # the offset is one typical size


# Solvers


def test_broyden_update_satisfies_the_secant_equation_and_is_unchanged_across_the_step():
    rng = np.random.default_rng(1)
    sensitivities = Sensitivities(np.zeros(3), np.arange(3), rng.standard_normal((3, 5, 4)))
    scale, vector = np.array([0.1, 1.0, 10.0]), np.array([0.05, 0.0, -3.0])
    decrease = rng.standard_normal((5, 4))
    decrease[0, 0] = np.nan
    updated = sensitivities.update(vector, scale, decrease)
    step = vector / scale
    known = np.isfinite(decrease)
    np.testing.assert_allclose(np.tensordot(step, updated.values, 1)[known], decrease[known])
    assert updated.values[:, 0, 0] == pytest.approx(sensitivities.values[:, 0, 0])
    across = np.array([step[2], 5.0, -step[0]])
    np.testing.assert_allclose(np.tensordot(across, updated.values, 1), np.tensordot(across, sensitivities.values, 1))
    assert sensitivities.update(sensitivities.vector, scale, decrease) is sensitivities


# Fits


def test_fit_recovers_the_true_values():
    truth = {"steering_offset": 2.0, "mass": -1.0, "yaw_inertia": 0.5}
    problem = reduce_noise(linear_problem(FEW, truth, 7), 0.05)
    fit = fit_problem(problem, *FEW)
    error = (fit.vector - problem.errors.truth) / problem.space.scale
    assert np.abs(error).max() < 0.01
    assert set(problem.space.effect_names[fit.indices]) == {*FEW, ACCELEROMETER_GAIN}


def test_fit_reaches_the_minimum_that_scipy_finds():
    problem = linear_problem(FEW, {"mass": 1.0}, 8)
    fit = fit_problem(problem, *FEW, iterations=100)

    def total(d):
        vector = problem.start.copy()
        vector[fit.indices] += d * problem.space.scale[fit.indices]
        return problem.loss.total(vector)
    best = optimize.minimize(total, np.zeros(len(fit.indices)), method="BFGS", options={"gtol": 1e-4})
    assert problem.loss.total(fit.vector) <= best.fun + 2e-4 * problem.residual_count


def test_outlier_windows_hardly_change_a_fit():
    problem = reduce_noise(linear_problem(FEW, {"mass": 1.0}, 9), 0.1)
    problem.errors.noise[::10] += 5.0  # a tenth of the windows
    index = problem.space.indices("mass")
    error = (fit_problem(problem, *FEW).vector - problem.errors.truth)[index] / problem.space.scale[index]
    assert np.abs(error).max() < 0.05


def test_fit_respects_the_bounds():
    problem = reduce_noise(linear_problem(("steering_lag", "mass"), {"steering_lag": -2.0}, 10), 0.1)
    fit = fit_problem(problem, "steering_lag", "mass")
    assert fit.vector[problem.space.indices("steering_lag")] == 0.0


def test_without_a_prior_only_the_selected_effects_are_fitted():
    problem = linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 11)
    fit = fit_problem(problem, "mass")
    moved = np.flatnonzero(fit.vector != problem.start)
    assert set(problem.space.effect_names[moved]) <= {"mass", ACCELEROMETER_GAIN}
    other = problem.fit(("yaw_inertia",), fit.sensitivities)  # the mass returns to its start value
    assert (other.vector[problem.space.indices("mass")] == problem.start[problem.space.indices("mass")]).all()


def random_precision_matrix(size: int, seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).standard_normal((size, size))
    return root @ root.T + 5.0 * np.eye(size)


def test_prior_curvature_is_that_of_the_marginal_distribution_of_the_other_parameters():
    """The selected effects are free: the curvature is the inverse of the covariance of all others."""
    problem = linear_problem(FEW, {}, 12)
    prior = random_precision_matrix(len(problem.space), 1)
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    everything = np.arange(len(problem.space))
    free = problem.space.indices("mass", "steering_offset")
    others = np.setdiff1d(everything, free)
    curvature = problem.prior_curvature(("mass", "steering_offset"), everything)
    marginal = np.linalg.inv(np.linalg.inv(prior)[np.ix_(others, others)])
    np.testing.assert_allclose(curvature[np.ix_(others, others)], marginal, rtol=1e-6, atol=1e-7)
    assert not curvature[free].any() and not curvature[:, free].any()
    np.testing.assert_allclose(problem.prior_curvature((), everything), prior)
    problem.design_effect = 3.0  # the loss counts dependent windows as independent; the prior does not
    np.testing.assert_allclose(problem.prior_curvature((), everything), 3.0 * prior)


def test_central_sensitivities_are_exact_where_errors_are_quadratic_in_the_parameters():
    problem = linear_problem(FEW, {}, 15)
    errors, indices, linear = problem.errors, problem.space.indices("mass", "yaw_inertia"), problem.errors.at

    def quadratic(vector: np.ndarray) -> np.ndarray:
        return linear(vector) + 0.5 * float(np.square(problem.distance(vector)[indices]).sum())

    errors.at, errors.at_all = quadratic, lambda vectors: [quadratic(v) for v in vectors]
    vector = problem.start + 0.3 * problem.space.scale * np.isin(np.arange(len(problem.space)), indices)
    exact = errors.signatures[indices] - 0.3
    np.testing.assert_allclose(Loss(errors, vector, central=True).sensitivities(vector, indices), exact, atol=1e-9)
    assert np.abs(Loss(errors, vector).sensitivities(vector, indices) - exact).max() > 0.04


@pytest.mark.parametrize("strength", [1.0, 1e8])
def test_strong_prior_keeps_the_other_parameters_at_the_start(strength):
    problem = reduce_noise(linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 13), 0.1)
    prior = strength * np.eye(len(problem.space))
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    fit = fit_problem(problem, "mass")
    deviation = (fit.vector - problem.start) / problem.space.scale
    mass, inertia = deviation[problem.space.indices("mass")], deviation[problem.space.indices("yaw_inertia")]
    assert mass == pytest.approx(1.0, abs=0.05)
    assert inertia == pytest.approx(1.0 if strength == 1.0 else 0.0, abs=0.05)


def test_prior_adds_to_the_held_out_loss_and_folds_refit_only_the_free_effects():
    problem = reduce_noise(linear_problem(FEW, {"mass": 1.0, "yaw_inertia": 1.0}, 13), 0.1)
    prior = random_precision_matrix(len(problem.space), 2)
    problem = Problem(problem.loss, problem.start, problem.block, prior)
    without, fit = fit_problem(problem), fit_problem(problem, "mass")
    deviation = (without.vector - problem.start) / problem.space.scale
    expected = problem.loss.total(without.vector) + deviation @ prior @ deviation
    assert without.held_out.sum() == pytest.approx(expected, rel=1e-6)
    assert not any(step.any() for step in problem.leave_out_groups(without, problem.fold)[0].values())
    index = problem.space.indices("mass")
    for step in problem.leave_out_groups(fit, problem.fold)[0].values():
        assert step[index].any() and not np.delete(step, index).any()


def test_held_out_loss_agrees_with_separate_fits_without_each_fold():
    """The optimism equals that of single refits except for third-order terms."""
    problem = linear_problem(FEW, {"mass": 1.0}, 14, count=320)
    fit = fit_problem(problem, *FEW, iterations=100)
    inside = problem.loss.window_losses(fit.vector)
    predicted = fit.held_out.sum() - inside.sum()
    refitted = 0.0
    for fold in range(FOLDS):
        in_fold = problem.fold[problem.block] == fold
        loss = Loss(problem.errors, problem.start)
        loss.known, loss.scale = problem.loss.known & ~in_fold[:, None], problem.loss.scale
        training = Problem(loss, problem.start, problem.block)
        vector = training.fit(FEW, problem.all_sensitivities(problem.start), iterations=100).vector
        refitted += float((problem.loss.window_losses(vector) - inside)[in_fold].sum())
    assert predicted > 0.0 and refitted > 0.0
    assert predicted == pytest.approx(refitted, rel=0.25)


def test_held_out_errors_are_those_at_the_parameters_of_the_fold():
    problem = linear_problem(FEW, {"mass": 1.0}, 15)
    fit = fit_problem(problem, *FEW, iterations=100)
    rows = problem.held_out_residuals(fit)
    for group, step in problem.leave_out_groups(fit, problem.held_out_groups)[0].items():
        in_group = problem.held_out_groups[problem.block] == group
        vector = fit.vector.copy()
        vector[fit.indices] += step * problem.space.scale[fit.indices]
        np.testing.assert_allclose(rows[in_group], problem.errors.at(vector)[in_group], atol=1e-8)


@pytest.mark.slow
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


@pytest.mark.slow
def test_windows_do_not_warn_about_the_integration_step_of_trial_models(leaf):
    """A search uses thousands of trial values: the command checks the step once."""
    stiff = replace(leaf, yaw_inertia=0.1 * leaf.yaw_inertia, minimum_slip_speed=0.1)
    settings = DiscoverySettings(windows=50)
    windows = Windows(recorded(leaf, {}, 1, ("step",)), stiff, settings)
    windows._batch._speeds = (0.2, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        windows.errors(Space("linear", settings).model)


@pytest.mark.slow
def test_held_out_loss_is_not_below_the_loss_of_the_fit(leaf):
    """Parameters fitted to the other folds cannot be better than those fitted to all."""
    settings = DiscoverySettings(windows=100)
    space = Space("nonlinear", settings)
    windows = Windows(recorded(leaf, {}, 1, ("sweep", "brake_in_turn", "step")), leaf, settings)
    loss = Loss(Errors(windows, space), space.null)
    problem = Problem(loss, space.null, windows.block)
    fit = problem.fit(("steering_lag", "steering_delay"), problem.all_sensitivities(space.null))
    assert fit.held_out.sum() >= loss.total(fit.vector)


def test_bounded_minimum_agrees_with_scipy():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        k = int(rng.integers(1, 12))
        root = rng.standard_normal((k + 3, k)) * 10.0 ** rng.uniform(-1.0, 1.0, k)
        a, b = root.T @ root + 1e-6 * np.eye(k), root.T @ (3.0 * rng.standard_normal(k + 3))
        low, high = -rng.uniform(0.0, 2.0, k), rng.uniform(0.0, 2.0, k)
        low[rng.uniform(size=k) < 0.3] = 0.0  # starts on a bound
        x = minimise_bounded(a, b, low, high)
        assert ((low <= x) & (x <= high)).all(), seed
        factor = np.linalg.cholesky(a)
        best = optimize.lsq_linear(factor.T, np.linalg.solve(factor, b), (low, high + 1e-12), tol=1e-14).x
        value, least = (float(v @ a @ v - 2.0 * b @ v) for v in (x, best))
        assert value <= least + 1e-6 * max(abs(least), 1.0), seed
