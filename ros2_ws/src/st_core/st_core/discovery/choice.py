"""Is there something, and which names are not worse than the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ..effects import get_effect
from .floor import Floor, gains, precisions, runs_of
from .quadratic import Quadratic
from .space import Space
from .study import Fit, Study

TRIALS = 200
# Gains of healthy cars on roads of their own over those of a car and blocks drawn at random; these are too small where
# the blocks are of the drives the floor was learnt from.
USUALLY, USUALLY_SEEN = 0.6, 1.2
# Gains of healthy data fall off as exp(-gain / TAIL) above their median, as those of a parameter too many; TAIL_AGREED
# where a gain loses that runs do not agree in (`by_chance`), up to SLOWER times as slowly where car and road change;
# what is built in does not change by itself, and its gains fall off SLOWER_BUILT_IN times as slowly there.
TAIL, TAIL_AGREED = 1.9, 0.85
SLOWER, SLOWER_BUILT_IN = 6.0, 3.0
# An effect that alone explains less than LITTLE, over what healthy driving costs: as many times as slowly, until they
# fall off LITTLE_SLOWER times as slowly or this much is LITTLE_MORE; as much faster, to MUCH_FASTER, where it explains
# more. Not asked of what acts in a few moments only, and what no healthy drive imitates.
LITTLE, LITTLE_SLOWER, LITTLE_MORE, MUCH_FASTER = 0.75, 5.2, 1.5, 0.6
MOMENTARY = {"combined_slip"}
BUILT_IN = {"steering_delay", "steering_lag", "sensor_lever_arm", "yaw_rate_scale", "speed_scale"}
AGREED = 0.005  # probability of what runs say by chance: below that they agree in it
DISAGREED = 0.6  # what a gain loses for each factor e above that, times as much where gains fall off more slowly
CLOSE = 6.0  # twice the log-likelihood: nearer than that nothing is told apart
RELATIVE = 0.02  # of the gain, for what the library's equations are not the car's
RELATIVE_TWINS = 0.08  # the same for effects that the registry calls twins


@dataclass(frozen=True)
class Null:
    """What healthy data gain: half of them more than `middle`; above it the share falls off as exp(-gain / fall).

    built_in: times as fast for what is built into the car. loss: of a gain, for each factor e of `by_chance` above
    AGREED; 0 where that cannot be known.
    """

    middle: float
    fall: float
    built_in: float = 1.0
    loss: float = 0.0

    @property
    def slower(self) -> float:
        """Times as slowly as where car and road stay the same."""
        return self.fall / TAIL_AGREED

    def probability(self, gain: float) -> float:
        """That healthy data gain as much."""
        return float(0.5 * np.exp(min(-(gain - self.middle) / self.fall, np.log(2.0))))

    def comparable(self, gain: float, names: Sequence[str], chance: float, explained: float = LITTLE) -> float:
        """A gain as one in which the runs agree, of an effect that is not built in and explains enough.

        chance: see `by_chance`. explained: by the effect alone, over what healthy driving costs (`gap.explained`)."""
        over = gain - self.middle - self.loss * float(np.log(max(chance, AGREED) / AGREED))
        usual = self.slower / (self.built_in if BUILT_IN.issuperset(names) else 1.0)
        if over > 0.0 and not MOMENTARY.issuperset(names):
            usual *= np.clip(LITTLE / max(explained, 1e-9), MUCH_FASTER, max(LITTLE_SLOWER / usual, LITTLE_MORE))
        return self.middle + float(over * self.slower / usual)

    def threshold(self, false_alarm: float) -> float:
        """The gain at which `probability` is false_alarm."""
        return self.middle + self.fall * float(np.log(0.5 / false_alarm))


def null_of(q: Quadratic, run: np.ndarray | None, floor: Floor, space: Space, names: Sequence[str], blocks: int,
            rng: np.random.Generator) -> Null:
    """The largest gain of any effect on healthy drives.

    From `blocks` blocks of them drawn again and again, and by a car that is off the floor as healthy cars are; and from
    what each whole run gains as a new one (`floor.of_a_new_run`).
    """
    scale, weights = floor.inflation, precisions(floor.spread, [space.indices(n) for n in names])
    hessian = q.hessian / scale
    # About the best point without prior and bounds: a block says nothing of what it does not show.
    best = np.linalg.solve(hessian.sum(axis=0) + 1e-3 * np.eye(len(space)), q.gradient.sum(axis=0) / scale)
    gradient = q.gradient / scale - hessian @ best
    root = np.linalg.cholesky(floor.spread + 1e-12 * np.eye(len(space)))
    drawn = []
    for _ in range(TRIALS):
        some = rng.integers(0, len(gradient), blocks)
        h = hessian[some].sum(axis=0)
        g = gradient[some].sum(axis=0) + h @ (root @ rng.standard_normal(len(space)))
        drawn.append(gains(g, h, weights).max())
    if run is None or len(np.unique(run)) < 2:
        return Null(USUALLY_SEEN * float(np.median(drawn)), TAIL)
    apart = [gains(g, h, weights).max() for g, h in runs_of(q, run, scale)]
    slower, slower_built_in = (1.0 + floor.restless * (most - 1.0) for most in (SLOWER, SLOWER_BUILT_IN))
    middle = max(USUALLY * float(np.median(drawn)), float(np.median(apart)))
    return Null(middle, TAIL_AGREED * slower, slower / slower_built_in, DISAGREED * slower)


def by_chance(fit: Fit, study: Study) -> float:
    """Probability that runs of one car differ as much as those of the suspect and of the reference do.

    Along the change d a fit makes of its own parameters each run says how much of it there is, 1 + d'g / d'Hd in a
    suspect run and d'g / d'Hd in one of the reference, with variance inflation / d'Hd and what runs differ among
    themselves (DerSimonian and Laird 1986). Two-sided t-test of the difference of the means. Of an effect with several
    parameters d is chosen by the suspect runs, which makes it a little small. Needs two reference runs or more.
    """
    own = study.space.indices(*fit.names)
    d = study.deviation(fit)[own]
    first = np.unique(study.windows.block, return_index=True)[1]
    suspect = _said(fit.quadratic, study.windows.run[first], own, d, study.floor.inflation)
    healthy = _said(study.floor.quadratic, study.floor.run, own, d, study.floor.inflation)
    between, freedom = _between([suspect, healthy])
    means = [np.average(v, weights=1.0 / (between + 1.0 / w)) for v, w in (suspect, healthy)]
    variance = sum(1.0 / (1.0 / (between + 1.0 / w)).sum() for _, w in (suspect, healthy))
    return float(2.0 * stats.t.sf(abs(1.0 + means[0] - means[1]) / np.sqrt(variance), freedom))


def _said(q: Quadratic, run: np.ndarray, own: np.ndarray, d: np.ndarray, inflation: float):
    """(values, their weights) of the runs."""
    gradient, hessian = q.gradient[:, own] @ d, d @ q.hessian[:, own][:, :, own] @ d
    runs = np.unique(run, return_inverse=True)[1]
    weight = np.maximum(np.bincount(runs, hessian), 1e-12)
    return np.bincount(runs, gradient) / weight, weight / inflation


def _between(groups) -> tuple[float, int]:
    """(variance between the runs of a group beyond what their weights say, degrees of freedom)."""
    beyond, weight = 0.0, 0.0
    for values, w in groups:
        beyond += float(w @ np.square(values - np.average(values, weights=w))) - (len(w) - 1)
        weight += float(w.sum() - np.square(w).sum() / w.sum())
    return max(beyond / max(weight, 1e-12), 0.0), sum(len(w) - 1 for _, w in groups)


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
        if more <= max(CLOSE, unsure(name, instead) * gain) or deviations < study.settings.deviations_above:
            result.append((more, name))
    return [name for _, name in sorted(result)]
