"""Joint fits of the whole library of effects before a search.

The healthy car is fitted to the reference drives; the fit gives the initial vector and a prior of the search.

The steering in a CAN log has its own clock, aligned to the INS in each run with an error of a few milliseconds.
One delay for all runs cannot represent different errors; the fit would change yaw inertia or tyre relaxation instead.
The clock of each run is therefore corrected first.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ..effects import get_effect
from ..effects.steering_delay import SteeringDelay
from ..errors import StCoreError
from ..log import DriveLog
from ..regression import Z95
from ..timeseries import NANOSECOND
from ..vehicle import VehicleParameters
from .evidence import inverse
from .fit import JOINT_DEVIATION, Problem, marginalise
from .loss import Errors, Loss, Quadratic
from .settings import DiscoverySettings
from .space import Quantities, Space, find_file_quantities, prior_deviations
from .windows import MIN_SPEED, Windows

MAX_FITS, FINAL_STEP = 8, 0.02  # maximum number of fits; largest step at convergence [parameter scales]
FIXED_CURVATURE = 1e6  # fixes a parameter; the ridge of `inverse`, 1e-9 of the mean diagonal, remains below 1e-3
MAX_CLOCK_DEVIATION = 0.01  # s, standard deviation up to which a clock counts as exact; steering delays are about 0.04
CLOCK_FITS = 3  # number of joint fits for the correction of clocks, each with the time stamps corrected so far


@dataclass(frozen=True, eq=False)
class HealthyCar:
    """The fitted healthy car."""

    vector: np.ndarray  # (p,) values of the whole library
    covariance: np.ndarray  # (p, p) of the vector [parameter scales]
    prior: np.ndarray  # (p, p) curvature of the prior about the vector
    residual_scale: np.ndarray  # (c,) error scale (`Loss.scale_of`) of each column at the end of the horizon [SI]
    position_error: float  # mean position error there, in the worst run [m]
    gain_between_runs: float  # largest gain per residual of a run if an effect is fitted to it, not to the others [1]


def fit_healthy_car(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space, settings: DiscoverySettings,
                    threads: int, tick: Callable[[], None]) -> HealthyCar:
    """Fit the healthy car to its drives; central difference quotients refine the result of one-sided ones.

    The covariance V of the vector follows from the covariance S of a fit to the drives alone, with their design
    effects, and the covariance F of the weak prior and the vehicle file: V^-1 = S^-1 + F^-1. 2 P, where P is the
    prior, is the inverse covariance of the prediction for a new drive, up to its design effect: 2 P = (2 S)^-1 + F^-1.
    S is doubled because reference and new drive are both uncertain; F is not, because it is common to all drives of the
    car. Raises StCoreError if there is no window."""
    windows = Windows(runs, vehicle, settings)
    if not len(windows):
        raise StCoreError(f"no prediction of {settings.horizon:g} s fits into the reference drives: drive longer, "
                          f"faster than {MIN_SPEED:g} m/s, without gaps")
    prior, quantities = weak_prior(space), find_file_quantities(space, vehicle)
    fits = []
    for start in (space.null, theoretical_values(space)):
        loss = Loss(Errors(windows, space, threads), start)
        vector, _ = fit_library(loss, windows, prior, quantities, start, tick)
        loss.central = True
        fits.append((*fit_library(loss, windows, prior, quantities, vector, tick), loss))
    vector, prior, loss = min(fits, key=lambda fit: float(np.log(fit[2].scale).sum()))
    problem = Problem(loss, space.null, windows.block, prior)
    q = problem.full_quadratic(vector)
    h = q.hessian.sum(axis=0)
    problem.update_design_effect(vector)
    information = np.maximum(np.diag(h), 1e-9 * max(float(np.trace(h)), 1e-30))
    design_effects = np.ones(len(h))  # at least 1; see `Problem.update_design_effect`
    for group in (windows.block, windows.run):
        gradient = q.sum_groups(group).gradient
        if (count := len(gradient)) > 2:
            widening = (float(stats.t.ppf(0.975, count - 1)) / Z95) ** 2  # for few blocks or runs
            variance = widening * 2.0 * count * gradient.var(axis=0, ddof=1)
            design_effects = np.maximum(design_effects, variance / information)
    position = problem.position_error(problem.errors.at(vector))
    by_run = [position[windows.run == k] for k in np.unique(windows.run)]
    position_error = max((float(np.nanmean(error)) for error in by_run if np.isfinite(error).any()), default=0.0)
    divisor = 2.0 * np.sqrt(np.outer(design_effects, design_effects)) / problem.design_effect
    gain = _gain_between_runs(q, space, windows, divisor, prior, prior @ problem.distance(vector))
    covariance = 0.5 * problem.design_effect * inverse(2.0 * h / divisor + prior)
    return HealthyCar(vector, covariance, (h / divisor + prior) / problem.design_effect,
                      loss.scale_of(vector)[-len(windows.columns):], position_error, gain)


def weak_prior(space: Space) -> np.ndarray:
    """(p, p) prior curvature of a joint fit of the whole library; it fixes composite effects."""
    prior = np.eye(len(space)) / JOINT_DEVIATION**2
    composite = space.indices(*(n for n in space.hypotheses if get_effect(n).members))
    prior[composite, composite] = FIXED_CURVATURE  # a composite is collinear with its members
    return prior


def _gain_between_runs(q: Quadratic, space: Space, windows: Windows, divisor: np.ndarray, prior: np.ndarray,
                       prior_gradient: np.ndarray) -> float:
    """`HealthyCar.gain_between_runs` from the quadratic approximation of the loss; 0 with fewer than three runs.
    divisor (p, p): divides the curvature of the other runs. prior_gradient: (p,) half the gradient of the prior."""
    by_run, largest = q.sum_groups(windows.run), 0.0
    if len(windows.names) < 3:
        return largest
    total_h, total_g = by_run.hessian.sum(axis=0), by_run.gradient.sum(axis=0) - prior_gradient
    for k, (h, g) in enumerate(zip(by_run.hessian, by_run.gradient, strict=True)):
        centre = inverse(total_h - h + prior) @ (total_g - g)
        predictive = (total_h - h) / divisor + prior
        shared_loss = _minimum_loss(h, g, centre, predictive)
        residual_count = max(int(windows.known[windows.run == k].sum()), 1)
        for effect in space.hypotheses:
            free_loss = _minimum_loss(h, g, centre, marginalise(predictive, space.indices(effect)))
            largest = max(largest, (shared_loss - free_loss) / residual_count)
    return largest


def _minimum_loss(h: np.ndarray, g: np.ndarray, centre: np.ndarray, prior: np.ndarray) -> float:
    """Minimum over x of x'Hx - 2 g'x + (x - centre)' prior (x - centre)."""
    x = np.linalg.solve(h + prior + 1e-9 * np.eye(len(h)), g + prior @ centre)
    return float(x @ h @ x - 2.0 * g @ x + (x - centre) @ prior @ (x - centre))


def theoretical_values(space: Space) -> np.ndarray:
    """(p,) theoretical values; null values where they are unknown, and for effects that convert the base model."""
    theory = [None if get_effect(effect).converts else parameter.theory for effect, parameter in space.parameters]
    return np.array([n if t is None else t for n, t in zip(space.null, [*theory, None], strict=True)])


def fit_library(loss: Loss, windows: Windows, prior: np.ndarray, quantities: Quantities, vector: np.ndarray,
                tick: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
    """Fit all parameters from an initial vector and update the scale of the loss, until convergence. Returns the vector
    (p,) and the curvature (p, p) of `prior` plus the priors of the vehicle file."""
    space = loss.space
    deviations = prior_deviations(quantities, space.scale)  # inf for a load, which these drives may include
    for _ in range(MAX_FITS):
        tick()
        with_priors = Problem(loss, space.null, windows.block, quantities=quantities)  # has a new cache
        with_priors.update_design_effect(vector)
        full_prior = prior + np.diag(0.5 * with_priors.design_effect / np.square(deviations))
        problem = Problem(loss, space.null, windows.block, full_prior)
        before, vector = vector, problem.fit((), with_priors.all_sensitivities(vector), vector, iterations=2).vector
        loss.rescale(vector)
        if np.abs((vector - before) / space.scale).max() < FINAL_STEP:
            break
    return vector, full_prior


def estimate_clock_corrections(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space,
                               settings: DiscoverySettings, deviations: Mapping[str, float], threads: int,
                               tick: Callable[[], None]) -> dict[str, float]:
    """Correction of the steering time stamps [s], > 0 if they are early, by run with an uncertain clock; empty for a
    single run, and for a base model without the effect `steering_delay`. deviations [s]: standard deviation of the
    steering clock by run, used as a prior; up to MAX_CLOCK_DEVIATION a clock counts as exact. The corrections are
    fitted together with all parameters of the library; `steering_delay` absorbs an error common to all runs."""
    prior_deviation = np.array([deviations.get(run.name, 0.0) for run in runs])
    free = np.flatnonzero(prior_deviation > MAX_CLOCK_DEVIATION).tolist()
    if len(runs) < 2 or not free or not len(space.indices(SteeringDelay.name)):
        return {}
    k, correction = int(space.indices(SteeringDelay.name)[0]), np.zeros(len(free))
    scale, vector, quantities = space.scale[k], space.null, find_file_quantities(space, vehicle)
    for _ in range(CLOCK_FITS):
        by_run = {runs[i].name: float(c) for i, c in zip(free, correction, strict=True)}
        windows = Windows(apply_clock_corrections(runs, by_run), vehicle, settings)
        if not len(windows):  # the caller reports this error
            return {}
        loss = Loss(Errors(windows, space, threads), vector)
        vector, prior = fit_library(loss, windows, weak_prior(space), quantities, vector, tick)
        problem = Problem(loss, space.null, windows.block, prior)
        problem.update_design_effect(vector)
        q, member = problem.full_quadratic(vector), (windows.run == np.array(free)[:, None]).astype(float)
        cross = member @ q.hessian[:, :, k]
        clock_prior = 0.5 * problem.design_effect * np.square(scale / prior_deviation[free])
        h = np.block([[q.hessian.sum(axis=0) + prior, cross.T], [cross, np.diag(cross[:, k] + clock_prior)]])
        g = np.concatenate([q.gradient.sum(axis=0) - prior @ problem.distance(vector),
                            member @ q.gradient[:, k] - clock_prior * correction / scale])
        correction = correction + (inverse(h) @ g)[len(space):] * scale
    return {runs[i].name: float(c) for i, c in zip(free, correction, strict=True)}


def apply_clock_corrections(runs: Sequence[DriveLog], corrections: Mapping[str, float]) -> list[DriveLog]:
    """The runs with steering time stamps corrected by the result of `estimate_clock_corrections`."""
    return [replace(run, steering_time_ns=run.steering_time_ns + round(corrections[run.name] / NANOSECOND))
            if corrections.get(run.name) else run for run in runs]
