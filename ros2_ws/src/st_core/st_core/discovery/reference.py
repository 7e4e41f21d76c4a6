"""Fit of the healthy car to reference drives: initial vector of a search, and prior of the unselected effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import stats

from ..effects import get_effect
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .evidence import TWO_SIDED, inverse
from .fit import Problem, marginalise
from .loss import Errors, Loss, Quadratic
from .settings import DiscoverySettings
from .space import Quantities, Space, known_quantities, prior_deviations
from .windows import Windows

JOINT_DEVIATION = 3.0  # parameter scales, prior standard deviation of every parameter of the healthy car
MAX_FITS, FINAL_STEP = 8, 0.02  # maximum number of fits; largest step at convergence [parameter scales]
FIXED_CURVATURE = 1e6  # prior curvature that fixes a parameter


@dataclass(frozen=True, eq=False)
class Healthy:
    """The fitted healthy car. vector: (p,) values of the whole library. prior: (p, p) curvature of the prior about
    them. residual: (c,) scale (`Loss.scale_of`) of the errors of each column at the end of the horizon [SI]. position
    [m]: mean position error there, in the run where it is largest. gain [1]: largest reduction of the loss per residual
    by an effect in one run, with a prior from the other runs; smaller gains may be false alarms."""

    vector: np.ndarray
    prior: np.ndarray
    residual: np.ndarray
    position: float
    gain: float


def healthy_car(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space, settings: DiscoverySettings,
                threads: int, tick: Callable[[], None]) -> Healthy:
    """Fit the healthy car to its drives. The prior is the predictive distribution for a new drive of the same car. Its
    covariance is the covariance of the values times the design effect, and times 2 because both the reference and the
    new drive are uncertain."""
    windows = Windows(runs, vehicle, settings)
    prior, quantities = weak_prior(space), known_quantities(space, vehicle)
    fits = []
    for start in (space.null, theoretical_values(space)):
        loss = Loss(Errors(windows, space, threads), start)
        fits.append((*fit_library(loss, windows, prior, quantities, start, tick), loss))
    vector, prior, loss = min(fits, key=lambda fit: float(np.log(fit[2].scale).sum()))
    problem = Problem(loss, space.null, windows.block, prior)
    q = problem.quadratic_of_all(vector)
    h = q.hessian.sum(axis=0) + prior
    design_effects = np.ones(len(h))  # at least 1; see `Problem.update_design_effect`
    for part in (windows.block, windows.run):
        gradient = q.summed(part).gradient
        number = len(gradient)
        if number > 2:
            wider = (float(stats.t.ppf(0.975, number - 1)) / TWO_SIDED) ** 2  # for few blocks or runs
            variance = wider * 2.0 * number * gradient.var(axis=0, ddof=1)
            design_effects = np.maximum(design_effects, variance / np.diag(h))
    spread = np.sqrt(2.0 * design_effects)
    position = problem.position_error(problem.errors.at(vector))
    by_run = [position[windows.run == k] for k in np.unique(windows.run)]
    largest = max((float(np.nanmean(error)) for error in by_run if np.isfinite(error).any()), default=0.0)
    return Healthy(vector, _predictive_prior(h, spread, prior), loss.scale_of(vector)[-len(windows.columns):], largest,
                   _gain_between_runs(q, space, windows, spread, prior))


def weak_prior(space: Space) -> np.ndarray:
    """(p, p) prior curvature of a joint fit of the whole library; it fixes composite effects."""
    prior = np.eye(len(space)) / JOINT_DEVIATION**2
    composite = space.indices(*(n for n in space.hypotheses if get_effect(n).members))
    prior[composite, composite] = FIXED_CURVATURE  # a composite is collinear with its members
    return prior


def _predictive_prior(h: np.ndarray, spread: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """(p, p) curvature h of the loss, with the standard deviations multiplied by `spread` (p,), plus `prior`."""
    return inverse(spread[:, None] * inverse(h) * spread) + prior


def _gain_between_runs(q: Quadratic, space: Space, windows: Windows, spread: np.ndarray, prior: np.ndarray) -> float:
    """`Healthy.gain` from the quadratic approximation of the loss; 0 with fewer than three runs."""
    run, largest = q.summed(windows.run), 0.0
    if len(windows.names) < 3:
        return largest
    h, g = run.hessian.sum(axis=0) + prior, run.gradient.sum(axis=0)
    for k in range(len(windows.names)):
        other = h - run.hessian[k]
        centre = inverse(other) @ (g - run.gradient[k])
        predictive = _predictive_prior(other, spread, prior)
        minimum = partial(_minimum, run.hessian[k], run.gradient[k], centre)
        number = max(int(windows.known[windows.run == k].sum()), 1)
        largest = max(largest, *((minimum(predictive) - minimum(marginalise(predictive, space.indices(n)))) / number
                                 for n in space.hypotheses))
    return largest


def _minimum(h: np.ndarray, g: np.ndarray, centre: np.ndarray, prior: np.ndarray) -> float:
    """Minimum over x of x'Hx - 2 g'x + (x - centre)' prior (x - centre)."""
    x = np.linalg.solve(h + prior + 1e-9 * np.eye(len(h)), g + prior @ centre)
    return float(x @ h @ x - 2.0 * g @ x + (x - centre) @ prior @ (x - centre))


def theoretical_values(space: Space) -> np.ndarray:
    """(p,) theoretical values where known, else the null; effects that convert the base model keep their null."""
    vector = space.null.copy()
    for i, free in enumerate(space.free):
        if free.theory is not None and not get_effect(free.effect).converts:
            vector[i] = free.theory
    return vector


def fit_library(loss: Loss, windows: Windows, prior: np.ndarray, quantities: Quantities, vector: np.ndarray,
                tick: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
    """Fit all parameters from an initial vector and update the scale of the loss, until convergence. Returns (vector
    (p,), curvature (p, p) of `prior` plus the priors of the vehicle file)."""
    space = loss.space
    with_priors = Problem(loss, space.null, windows.block, quantities=quantities)
    deviations = prior_deviations(quantities, space.scale)  # none for a load: the drives already include it
    for _ in range(MAX_FITS):
        tick()
        with_priors.update_design_effect(vector)
        full_prior = prior + np.diag(0.5 * with_priors.design_effect / np.square(deviations))
        problem = Problem(loss, space.null, windows.block, full_prior)
        fit = problem.fit((), with_priors.all_sensitivities(vector), vector, iterations=2)
        step = float(np.abs((fit.vector - vector) / space.scale).max())
        vector = fit.vector
        loss.rescale(vector)
        if step < FINAL_STEP:
            break
    return vector, full_prior
