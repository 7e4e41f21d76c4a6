"""Is there something, and which names are not worse than the best."""

from collections.abc import Mapping, Sequence

import numpy as np

from .floor import Floor
from .quadratic import Quadratic
from .space import Space
from .study import Fit, Study

TRIALS = 300
STRUCTURE = 2.0  # gains of a healthy car on other roads than the reference, over those on resampled reference blocks
CLOSE = 6.0  # twice the log-likelihood: nearer than that nothing is told apart
RELATIVE = 0.02  # of the gain, for what the library's equations are not the car's
WORSE = 2.0  # standard deviations over blocks


def precision(spread: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Of the deviations from the floor when those in `free` may be anything."""
    rest = np.setdiff1d(np.arange(len(spread)), free)
    result = np.zeros_like(spread)
    result[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    result[free, free] = 1e-6
    return result


def null_gains(q: Quadratic, floor: Floor, space: Space, names: Sequence[str], blocks: int,
               rng: np.random.Generator) -> np.ndarray:
    """(TRIALS,) the largest gain of any effect on `blocks` blocks of healthy driving, drawn again and again, by a car
    that is off the floor as healthy cars are."""
    weights = [precision(floor.spread, np.array([], int))]
    weights += [precision(floor.spread, space.indices(n)) for n in names]
    weights = np.stack(weights)
    gradient = (q.gradient - q.gradient.mean(axis=0)) / floor.inflation
    hessian = q.hessian / floor.inflation
    root = np.linalg.cholesky(floor.spread + 1e-12 * np.eye(len(space)))
    result = np.empty(TRIALS)
    for k in range(TRIALS):
        drawn = rng.integers(0, len(gradient), blocks)
        h = hessian[drawn].sum(axis=0)
        g = gradient[drawn].sum(axis=0) + h @ (root @ rng.standard_normal(len(space)))
        explained = np.linalg.solve(h + weights, np.broadcast_to(g, (len(weights), len(g)))[..., None])[..., 0] @ g
        result[k] = (explained[1:] - explained[0]).max()
    return result


def probability(gain: float, null: np.ndarray) -> float:
    """That healthy data gain as much: counted where there are counts, an exponential tail beyond."""
    scaled = np.sort(STRUCTURE * null)
    if gain < scaled[-len(scaled) // 20]:
        return float((1 + (scaled >= gain).sum()) / (len(scaled) + 1))
    edge = scaled[-len(scaled) // 20]
    beyond = float(np.mean(scaled[scaled >= edge] - edge)) + 1e-9
    return float(0.05 * np.exp(-(gain - edge) / beyond))


def threshold(null: np.ndarray, false_alarm: float) -> float:
    """The gain at which `probability` is false_alarm."""
    scaled = np.sort(STRUCTURE * null)
    edge = scaled[-len(scaled) // 20]
    beyond = float(np.mean(scaled[scaled >= edge] - edge)) + 1e-9
    return float(edge + beyond * max(np.log(0.05 / false_alarm), 0.0))


def behind(fit: Fit, best: Fit, study: Study) -> tuple[float, float]:
    """(how much costlier than the best, the same in standard deviations over blocks)."""
    each = (fit.quadratic.cost - best.quadratic.cost) / study.floor.inflation
    deviation = float(np.sqrt(len(each)) * each.std(ddof=1)) if len(each) > 1 else np.inf
    more = fit.cost - best.cost
    return more, more / max(deviation, 1e-9)


def not_worse(fits: Mapping[str, Fit], best: Fit, gain: float, study: Study) -> list[str]:
    """Names of the fits the data cannot tell from the best, best first."""
    result = []
    for name, fit in fits.items():
        more, deviations = behind(fit, best, study)
        if more <= max(CLOSE, RELATIVE * gain) or deviations < WORSE:
            result.append((more, name))
    return [name for _, name in sorted(result)]
