"""A healthy car from reference drives: where the search starts, and how firmly everything else is held there."""

from collections.abc import Sequence

import numpy as np

from ..effects import get_effect
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .evidence import inverse
from .fit import Problem
from .loss import Errors, Loss
from .settings import DiscoverySettings
from .space import Space
from .windows import Windows

LOOSE = 3.0  # usual sizes: how far from the vehicle file a healthy car may be before its drives are heard
ROUNDS, SETTLED = 8, 0.02


def learn(runs: Sequence[DriveLog], vehicle: VehicleParameters, space: Space, settings: DiscoverySettings,
          threads: int, tick) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((p,) values of the whole library fitted to the reference, (p, p) curvature of the loss about them, (c,) what is
    left of each column at the end of the horizon [SI]).

    The curvature is what reference drives say of a new drive of the same car: their own, over what dependent windows
    make of it, and beside it how far single reference runs are from each other.
    """
    windows = Windows(runs, vehicle, settings)
    held = np.eye(len(space)) / LOOSE**2
    fits = []
    for start in (space.null, textbook(space)):
        loss = Loss(Errors(windows, space, threads), start)
        fits.append((_fitted(loss, space, windows, held, start, tick), loss))
    vector, loss = min(fits, key=lambda fit: float(np.log(fit[1].scale).sum()))
    problem = Problem(loss, space.null, windows.block, held)
    q = loss.quadratic(problem.errors.at(vector), problem.everything(vector).values)
    h = q.hessian.sum(axis=0) + held
    sure = inverse(h)
    run = q.summed(windows.run, len(windows.names))
    spread = _between(run.gradient, run.hessian, sure, held) if len(windows.names) > 2 else np.zeros(len(space))
    blocks = q.summed(windows.block)
    scatter = np.square(blocks.gradient).sum(axis=0) / np.maximum(np.diag(q.hessian.sum(axis=0)), 1e-12)
    design = max(2.0 * float(np.median(scatter)), 1.0)
    return vector, inverse(design * sure + np.diag(spread)) + held, loss.scale_of(vector)[-len(windows.columns):]


def textbook(space: Space) -> np.ndarray:
    """(p,) the library's usual sizes of what any real car has: physics at the initial values of its effects."""
    vector = space.null.copy()
    for i, free in enumerate(space.free):
        effect = get_effect(free.effect)
        if effect.kind == "physics" and not effect.lifts:
            expected = next(p.initial for p in effect.parameters if p.name == free.parameter)
            vector[i] = expected if expected in free.bounds else vector[i]
    return vector


def _fitted(loss: Loss, space: Space, windows: Windows, held: np.ndarray, vector: np.ndarray, tick) -> np.ndarray:
    """Everything at once from a vector, the scale of the loss renewed, until nothing moves."""
    for _ in range(ROUNDS):
        tick()
        problem = Problem(loss, space.null, windows.block, held)
        fit = problem.fit((), problem.everything(vector), vector, iterations=2)
        step = float(np.abs((fit.vector - vector) / space.scale).max())
        vector = fit.vector
        loss.rescale(vector)
        if step < SETTLED:
            break
    return vector


def _between(gradients: np.ndarray, hessians: np.ndarray, sure: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(p,) variance of each parameter between runs beyond what the curvature of each run explains, in units of the
    inverse curvature (DerSimonian and Laird 1986), others free as far as `held` lets them."""
    h = hessians.sum(axis=0) / len(hessians)
    values, variances = [], []
    for g, own in zip(gradients, hessians, strict=True):
        i = inverse(own + 0.5 * h + held)
        values.append(i @ g)
        variances.append(np.diag(i))
    values, w = np.array(values), 1.0 / np.maximum(np.array(variances), 1e-12)
    mean = (w * values).sum(axis=0) / w.sum(axis=0)
    q = (w * np.square(values - mean)).sum(axis=0)
    beyond = q - (len(values) - 1)
    return np.maximum(beyond / (w.sum(axis=0) - np.square(w).sum(axis=0) / w.sum(axis=0)), 0.0)
