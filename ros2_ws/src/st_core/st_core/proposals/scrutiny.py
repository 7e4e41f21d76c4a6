"""What speaks against a law that is sure: a curve at its bound, a car that is no longer stable, runs without it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..contract import unsteady
from ..effects._law import COUNT, HIGHEST
from ..models import get_model
from ..vehicle import VehicleParameters
from .curve_fit import Fitted, Laws

NEAR = 0.02  # of the bound
SHOWN = 0.02  # share of the law's information a run must hold to say whether the law is there
SURE = 1.96


@dataclass(frozen=True)
class Shares:
    """How much of the law each run shows, 1 the same everywhere: (share, one standard deviation) by run. differ [1]:
    chance of shares so different if the law were the same in all."""

    by_run: Mapping[str, tuple[float, float]]
    differ: float

    def absent(self) -> list[str]:
        """Runs that surely show less than half of it."""
        return [name for name, (share, deviation) in self.by_run.items() if share + SURE * deviation < 0.5]


def refused(laws: Laws, fit: Fitted, vehicle: VehicleParameters) -> str:
    """Why a curve is no proposal, "" where nothing speaks against it."""
    assert fit.candidate is not None
    name = fit.candidate.name
    if np.abs(fit.coefficients).max() > (1.0 - NEAR) * HIGHEST:
        return (f"the curve of {name} runs into its bound of {HIGHEST * fit.candidate.usual:.3g} {fit.candidate.unit}, "
                "which is beyond any physical law: see what st check says of the sensors, and the vehicle file")
    model = laws.space_of(fit.candidate).at(fit.vector)
    low, high = np.quantile(laws.windows.speeds[np.isfinite(laws.windows.speeds)], [0.05, 0.95])
    slow = max(float(low), vehicle.minimum_slip_speed)
    problem = unsteady(get_model(model.base), model, vehicle, np.linspace(slow, max(float(high), slow), 4))
    return f"with {name} the simulated car is not stable, so that it cannot predict: {problem}" if problem else ""


def shares(laws: Laws, fit: Fitted) -> Shares:
    """From the quadratic about the law: what each run would multiply it with, everything else following."""
    h = fit.q.hessian.sum(axis=0)
    rest, own = h[:-COUNT, :-COUNT], fit.coefficients
    ridge = (1e-6 * np.trace(rest) / max(len(rest), 1) + 1e-9) * np.eye(len(rest))
    turn = np.concatenate([-np.linalg.solve(rest + ridge, h[:-COUNT, -COUNT:] @ own), own])
    g, hh = fit.q.gradient @ turn, np.einsum("i,bij,j->b", turn, fit.q.hessian, turn)
    run = np.zeros(laws.blocks, int)
    run[laws.block] = laws.windows.run
    seen = [k for k in np.unique(run) if hh[run == k].sum() > SHOWN * hh.sum()]
    if len(seen) < 2:
        return Shares({}, 1.0)
    more = {k: g[run == k].sum() / hh[run == k].sum() for k in seen}
    left = sum(float(np.square(g - more[k] * hh)[run == k].sum()) for k in seen)
    known = np.isin(run, seen)
    design = max(2.0 * left / hh[known].sum() * known.sum() / max(known.sum() - len(seen), 1), 1.0)
    weight = {k: 2.0 * hh[run == k].sum() / design for k in seen}
    mean = sum(more[k] * w for k, w in weight.items()) / sum(weight.values())
    square = sum(w * (more[k] - mean) ** 2 for k, w in weight.items())
    return Shares({laws.windows.names[k]: (1.0 + float(more[k]), float(weight[k] ** -0.5)) for k in seen},
                  float(stats.chi2.sf(square, len(seen) - 1)))


def held_out_positions(laws: Laws, fit: Fitted) -> np.ndarray:
    """(n,) position error at the end of the horizon under values fitted to other driving [m]."""
    rows = fit.rows.copy()
    for k, d in fit.steps.items():
        mine = laws.fold[laws.block] == k
        rows[mine] -= np.einsum("p,pnm->nm", d, fit.slopes[:, mine])
    if "position_lateral" not in laws.windows.columns:
        return np.full(len(rows), np.nan)
    return laws.problem.position(rows)


def cosine(laws: Laws, one: Fitted, other: Fitted) -> float:
    """Of what two laws change in the predictions, what the parameters of the car can do taken out."""
    effects = []
    for fit in (one, other):
        change = np.einsum("p,pnm->nm", fit.coefficients, fit.slopes[-COUNT:]) / laws.loss.scale
        # There may be none: nothing was found, and no accelerometer measured.
        beside = (fit.slopes[:-COUNT] / laws.loss.scale).reshape(len(fit.slopes) - COUNT, change.size)
        change = np.where(laws.loss.known, change, 0.0).ravel()
        beside = np.nan_to_num(beside * laws.loss.known.ravel())
        effects.append(change - np.linalg.lstsq(beside.T, change, rcond=None)[0] @ beside)
    return float(effects[0] @ effects[1] / max(np.linalg.norm(effects[0]) * np.linalg.norm(effects[1]), 1e-30))
