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
        return f"the curve of {name} runs into its bound of {HIGHEST:g} usual sizes: nothing physical was found"
    model = laws.space_of(fit.candidate).at(fit.vector)
    low, high = np.quantile(laws.windows.speeds[np.isfinite(laws.windows.speeds)], [0.05, 0.95])
    slow = max(float(low), vehicle.minimum_slip_speed)
    problem = unsteady(get_model(model.base), model, vehicle, np.linspace(slow, max(float(high), slow), 4))
    return f"with {name} the simulated car is not stable: {problem}" if problem else ""


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
