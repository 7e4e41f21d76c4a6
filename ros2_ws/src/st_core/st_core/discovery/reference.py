"""A healthy car from reference drives: where the search starts, and how firmly everything else is held there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import stats

from ..effects import get_effect
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .evidence import TWO_SIDED, inverse
from .fit import Problem, freed
from .loss import Errors, Loss, Quadratic
from .settings import DiscoverySettings
from .space import Quantities, Space, known_quantities, prior_deviations
from .windows import Windows

JOINT_DEVIATION = 3.0  # usual sizes: how far from the vehicle file a healthy car may be before its drives are used
MAX_FITS, FINAL_STEP = 8, 0.02  # fits, and the step in usual sizes that ends the fit
FIXED_CURVATURE = 1e6  # curvature of what stays


@dataclass(frozen=True, eq=False)
class Healthy:
    """vector: (p,) values of the whole library fitted to the reference. prior: (p, p) curvature of the loss about them.
    left: (c,) error of each column at the end of the horizon [SI], two thirds are below. position [m]: mean error
    there, of the run where that is most. gain: for each scored error, the largest that any effect shows of one of its
    runs against the others."""

    vector: np.ndarray
    prior: np.ndarray
    left: np.ndarray
    position: float
    gain: float


def learn(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space, settings: DiscoverySettings,
          threads: int, tick: Callable[[], None]) -> "Healthy":
    """A healthy car from its drives.

    The curvature is what reference drives predict of a new drive of the same car: their own, over what windows that
    depend on each other and drives that differ make of the variance of each value, once for them and once for the new
    drive.
    """
    windows = Windows(runs, vehicle, settings)
    held = np.eye(len(space)) / JOINT_DEVIATION**2
    composite = space.indices(*(n for n in space.hypotheses if get_effect(n).members))
    held[composite, composite] = FIXED_CURVATURE  # its members describe the same
    quantities = known_quantities(space, vehicle)
    fits = []
    for start in (space.null, textbook(space)):
        loss = Loss(Errors(windows, space, threads), start)
        fits.append((*_fitted(loss, windows, held, quantities, start, tick), loss))
    vector, held, loss = min(fits, key=lambda fit: float(np.log(fit[2].scale).sum()))
    problem = Problem(loss, space.null, windows.block, held)
    q = loss.quadratic(problem.errors.at(vector), problem.everything(vector).values)
    h = q.hessian.sum(axis=0) + held
    spread = np.sqrt(2.0 * _design(q, np.diag(h), windows))
    far = problem.position(problem.errors.at(vector))
    of_runs = [float(np.nanmean(far[windows.run == k])) for k in np.unique(windows.run) if np.isfinite(
        far[windows.run == k]).any()]
    return Healthy(vector, _prior(h, spread, held), loss.scale_of(vector)[-len(windows.columns):],
                   max(of_runs, default=0.0),
                   _between_runs(q, space, windows, spread, held))


def _prior(h: np.ndarray, spread: np.ndarray, held: np.ndarray) -> np.ndarray:
    return inverse(spread[:, None] * inverse(h) * spread) + held


def _between_runs(q: Quadratic, space: Space, windows: Windows, spread: np.ndarray, held: np.ndarray) -> float:
    """Largest gain for each scored error any effect shows of a run against the other runs, by the quadratic."""
    run, most = q.summed(windows.run), 0.0
    if len(windows.names) < 3:
        return most
    h, g = run.hessian.sum(axis=0) + held, run.gradient.sum(axis=0)
    for k in range(len(windows.names)):
        other = h - run.hessian[k]
        there = inverse(other) @ (g - run.gradient[k])
        prior = _prior(other, spread, held)
        least = partial(_least, run.hessian[k], run.gradient[k], there)
        number = max(int(windows.known[windows.run == k].sum()), 1)
        most = max(most, *((least(prior) - least(freed(prior, space.indices(n)))) / number for n in space.hypotheses))
    return most


def _least(h: np.ndarray, g: np.ndarray, there: np.ndarray, prior: np.ndarray) -> float:
    """Of x'Hx - 2 g'x and the penalty of a prior about `there`."""
    x = np.linalg.solve(h + prior + 1e-9 * np.eye(len(h)), g + prior @ there)
    return float(x @ h @ x - 2.0 * g @ x + (x - there) @ prior @ (x - there))


def _design(q: Quadratic, curvature: np.ndarray, windows: Windows) -> np.ndarray:
    """(p,) what the variance of each value is over that of independent windows, 1 at least: the larger of what blocks
    and what runs show; of a few it is not well known, so that Student's quantile counts."""
    design = np.ones(len(curvature))
    for part in (windows.block, windows.run):
        gradient = q.summed(part).gradient
        number = len(gradient)
        if number > 2:
            wider = (float(stats.t.ppf(0.975, number - 1)) / TWO_SIDED) ** 2
            design = np.maximum(design, wider * 2.0 * number * gradient.var(axis=0, ddof=1) / curvature)
    return design


def textbook(space: Space) -> np.ndarray:
    """(p,) values by theory for any car; the base stays of the requested kind."""
    vector = space.null.copy()
    for i, free in enumerate(space.free):
        if free.theory is not None and not get_effect(free.effect).lifts:
            vector[i] = free.theory
    return vector


def _fitted(loss: Loss, windows: Windows, held: np.ndarray, quantities: Quantities, vector: np.ndarray,
            tick: Callable[[], None]) -> tuple[np.ndarray, np.ndarray]:
    """((p,) everything at once from a vector, the scale of the loss renewed, until nothing moves; (p, p) curvature that
    held it: `held` and the prior of the vehicle file)."""
    space = loss.space
    file = Problem(loss, space.null, windows.block, quantities=quantities)
    deviations = prior_deviations(quantities, space.scale)  # a load of the healthy car is known from its drives alone
    for _ in range(MAX_FITS):
        tick()
        file.renew_design(vector)
        whole = held + np.diag(0.5 * file.design / np.square(deviations))
        problem = Problem(loss, space.null, windows.block, whole)
        fit = problem.fit((), file.everything(vector), vector, iterations=2)
        step = float(np.abs((fit.vector - vector) / space.scale).max())
        vector = fit.vector
        loss.rescale(vector)
        if step < FINAL_STEP:
            break
    return vector, whole
