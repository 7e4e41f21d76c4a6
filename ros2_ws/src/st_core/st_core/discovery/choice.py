"""Is there something, and which names are not worse than the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects import get_effect
from .floor import Floor, precision
from .quadratic import Quadratic
from .space import Space
from .study import Fit, Study

TRIALS = 200
# Gains of healthy cars on roads of their own over those of a car and blocks drawn at random; these are too small where
# the blocks are of the drives the floor was learnt from.
USUALLY, USUALLY_SEEN = 0.6, 1.2
TAIL = 1.9  # gains of healthy data fall off as exp(-gain / TAIL) above their median, as those of a parameter too many
FALL_KNOWN = 1.0  # healthy runs TAIL counts as much as
FEW = 2.0  # where gains of healthy runs fall off more slowly: how much more slowly others may; a few are all there are
CLOSE = 6.0  # twice the log-likelihood: nearer than that nothing is told apart
RELATIVE = 0.02  # of the gain, for what the library's equations are not the car's
RELATIVE_TWINS = 0.08  # the same for effects that the registry calls twins


@dataclass(frozen=True)
class Null:
    """What healthy data gain: half of them more than `middle`; above it the share falls off as exp(-gain / fall)."""

    middle: float
    fall: float

    def probability(self, gain: float) -> float:
        """That healthy data gain as much."""
        return float(0.5 * np.exp(min(-(gain - self.middle) / self.fall, np.log(2.0))))

    def threshold(self, false_alarm: float) -> float:
        """The gain at which `probability` is false_alarm."""
        return self.middle + self.fall * float(np.log(0.5 / false_alarm))


def null_of(q: Quadratic, run: np.ndarray | None, floor: Floor, space: Space, names: Sequence[str], blocks: int,
            rng: np.random.Generator) -> Null:
    """The largest gain of any effect on healthy drives.

    From `blocks` blocks of them drawn again and again, and by a car that is off the floor as healthy cars are; and from
    what each whole run gains as a new one (`floor.of_a_new_run`).
    """
    weights = np.stack([precision(floor.spread, space.indices(*group)) for group in ((), *((n,) for n in names))])
    scale = floor.inflation

    def gain(g: np.ndarray, h: np.ndarray) -> float:
        explained = np.linalg.solve(h + weights, np.broadcast_to(g, (len(weights), len(g)))[..., None])[..., 0] @ g
        return float((explained[1:] - explained[0]).max())

    hessian = q.hessian / scale
    # About the best point without prior and bounds: a block says nothing of what it does not show.
    best = np.linalg.solve(hessian.sum(axis=0) + 1e-3 * np.eye(len(space)), q.gradient.sum(axis=0) / scale)
    gradient = q.gradient / scale - hessian @ best
    root = np.linalg.cholesky(floor.spread + 1e-12 * np.eye(len(space)))
    drawn = []
    for _ in range(TRIALS):
        some = rng.integers(0, len(gradient), blocks)
        h = hessian[some].sum(axis=0)
        drawn.append(gain(gradient[some].sum(axis=0) + h @ (root @ rng.standard_normal(len(space))), h))
    runs = np.unique(run) if run is not None else np.array([], int)
    middle, fall = (USUALLY if len(runs) > 1 else USUALLY_SEEN) * float(np.median(drawn)), TAIL
    if len(runs) > 1:
        apart = np.array([gain(q.gradient[run == r].sum(axis=0) / scale, hessian[run == r].sum(axis=0)) for r in runs])
        middle = max(middle, float(np.median(apart)))
        beyond = apart[apart > middle] - middle
        known = (FALL_KNOWN * fall + float(beyond.sum())) / (FALL_KNOWN + len(beyond))
        fall += FEW * max(known - fall, 0.0)
    return Null(middle, fall)


def behind(fit: Fit, best: Fit, study: Study) -> tuple[float, float]:
    """(how much costlier than the best, the same in standard deviations over blocks)."""
    each = (fit.quadratic.cost - best.quadratic.cost) / study.floor.inflation
    deviation = float(np.sqrt(len(each)) * each.std(ddof=1)) if len(each) > 1 else np.inf
    more = fit.cost - best.cost
    return more, more / max(deviation, 1e-9)


def unsure(first: str, second: str) -> float:
    """Share of a gain by which two effects must differ to be told apart, however sure the data are."""
    twins = second in get_effect(first).twins or first in get_effect(second).twins
    return RELATIVE_TWINS if twins else RELATIVE


def not_worse(fits: Mapping[str, Fit], best: Fit, instead: str, gain: float, study: Study) -> list[str]:
    """Names of the fits the data cannot tell from the best, best first. instead: the effect of it they replace."""
    result = []
    for name, fit in fits.items():
        more, deviations = behind(fit, best, study)
        if more <= max(CLOSE, unsure(name, instead) * gain) or deviations < study.settings.deviations:
            result.append((more, name))
    return [name for _, name in sorted(result)]
