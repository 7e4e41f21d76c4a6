"""Robust linear regression of the residual of an identity, with intervals by resampling blocks of driving.

Neighbouring samples share their errors, so whole blocks are drawn again (st_core.regression), and an
interval is as wide as the blocks are few and alike. Causes are added one at a time, the one that explains most first,
all refitted together, until no further one is significant and large enough to matter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from ..clock_fit import STEP, Fit, Pair, Resampled, fit, mean_correlation, resample
from ..clock_types import LONGEST_SPAN
from ..regression import Blocks, symmetric_interval
from .finding import SYSTEMATIC

OUTLIER = 3.0  # robust standard deviations; windows beyond it count less (Huber)
DRAWS, SEED = 200, 0  # of the resampling
BLOCK = 5.0  # s, as in the alignment of clocks; what is alike in neighbouring blocks widens the interval
FREEDOM = 4.0  # degrees of freedom of Student's t, at least
RIDGE = 1e-6  # of the whole normal matrix: a draw without excitation stays solvable and counts for nothing otherwise


@dataclass(frozen=True)
class Estimate:
    """value with its standard deviation and 95 % interval."""

    value: float
    deviation: float
    interval: tuple[float, float]

    @property
    def significant(self) -> bool:
        """Whether the 95 % interval leaves out 0, and by half its width more: one of a dozen causes is looked for."""
        low, high = self.interval
        return min(abs(low), abs(high)) > 0.5 * (high - self.value) and low * high > 0.0

    @property
    def half(self) -> float:
        """Half the width of the interval."""
        return 0.5 * (self.interval[1] - self.interval[0])

    def covers(self, value: float) -> bool:
        return self.interval[0] <= value <= self.interval[1]

    def scaled(self, factor: float) -> "Estimate":
        low, high = sorted(factor * end for end in self.interval)
        return Estimate(factor * self.value, abs(factor) * self.deviation, (low, high))

    def inverse(self) -> "Estimate":
        """Of 1 / value, to first order: an interval that reaches beyond 0 stays one."""
        value = 1.0 / float(np.copysign(max(abs(self.value), 1e-12), self.value))
        low, high = (value - (end - self.value) * value**2 for end in reversed(self.interval))
        return Estimate(value, self.deviation * value**2, (low, high))

    def widened(self, half: float) -> "Estimate":
        """With another uncertainty, half of a 95 % interval, added in quadrature."""
        low, high = (self.value + sign * float(np.hypot(end - self.value, half))
                     for sign, end in zip((-1.0, 1.0), self.interval, strict=True))
        return Estimate(self.value, float(np.hypot(self.deviation, 0.5 * half)), (low, high))

    def shifted(self, by: float) -> "Estimate":
        return Estimate(self.value + by, self.deviation, (self.interval[0] + by, self.interval[1] + by))


class Regression:
    """y = sum_k theta_k X_k + rest, over windows.

    time: (n,) of the windows [s]. y: (n, m), m components of a window. columns: X_k by name, (n, m) each.
    """

    def __init__(self, time: np.ndarray, y: np.ndarray, columns: Mapping[str, np.ndarray]):
        self.time, self.y, self.columns = time, y, columns
        found, of = np.unique(np.floor(time / BLOCK).astype(np.int64), return_inverse=True)
        self._blocks = Blocks(of, np.zeros(len(found), np.int64), found, f"{len(found)} blocks of {BLOCK:g} s")

    def rest(self, theta: Mapping[str, float]) -> np.ndarray:
        """(n, m) residual of y."""
        return self.y - sum((value * self.columns[name] for name, value in theta.items()), np.zeros_like(self.y))

    def fit(self, names: Sequence[str]) -> tuple[dict[str, float], float, np.ndarray]:
        """(values by name, robust loss per window in robust variances of the rest, weights of the windows)."""
        design = np.stack([self.columns[name] for name in names], axis=-1) if names else np.zeros((*self.y.shape, 0))
        weights, theta = np.ones(len(self.y)), np.zeros(len(names))
        for _ in range(6 if names else 1):
            normal = np.einsum("n,nip,niq->pq", weights, design, design)
            theta = np.linalg.solve(normal + RIDGE * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(names)),
                                    np.einsum("n,nip,ni->p", weights, design, self.y))
            size = np.sqrt(np.square(self.y - design @ theta).sum(axis=1))
            scale = max(float(np.median(size)), 1e-12)
            weights = 1.0 / np.maximum(1.0, size / (OUTLIER * scale))
        return dict(zip(names, theta.tolist(), strict=True)), scale, weights

    def loss(self, names: Sequence[str], scale: float) -> float:
        """Sum of Huber's loss at a common scale, so that two sets of causes can be compared."""
        theta, _, _ = self.fit(names)
        size = np.sqrt(np.square(self.rest(theta)).sum(axis=1)) / (OUTLIER * scale)
        return float(np.where(size <= 1.0, 0.5 * size**2, size - 0.5).sum())

    def estimates(self, names: Sequence[str]) -> dict[str, Estimate]:
        """Joint values of these causes with their intervals."""
        if not names:
            return {}
        theta, _, weights = self.fit(names)
        design = np.stack([self.columns[name] for name in names], axis=-1)
        squares = self._blocks.sums(weights[:, None, None] * np.einsum("nip,niq->npq", design, design))
        pulls = self._blocks.sums(weights[:, None] * np.einsum("nip,ni->np", design, self.y))
        whole, pulled = squares.sum(axis=0), pulls.sum(axis=0)
        held = np.diag(np.diag(whole)) + 1e-12 * np.eye(len(names))  # two causes may be one on this drive

        def estimator(draws: np.ndarray) -> np.ndarray:
            return np.linalg.solve(np.tensordot(draws, squares, 1) + RIDGE * (whole + held),
                                   (draws @ pulls + RIDGE * pulled)[:, :, None])[:, :, 0]

        drawn = self._blocks.bootstrap(estimator, DRAWS, SEED)
        found = {}
        for k, name in enumerate(names):
            deviation = float(np.sqrt(drawn.covariance[k, k]))
            # The covariance is widened by what blocks share already; its degrees of freedom are at least FREEDOM.
            freedom = max(float(drawn.freedom[k]), FREEDOM)
            found[name] = Estimate(theta[name], deviation, symmetric_interval(theta[name], deviation, freedom))
        return found

    def effect(self, name: str, value: float, seconds: float, window: float) -> float:
        """Root mean square over windows of what a cause moves in `seconds`, where windows of `window` [s] add up."""
        count = max(round(seconds / window), 1)
        column = self.columns[name]
        if len(column) < count:
            return float(np.sqrt(np.square(value * column).sum(axis=1).mean())) * count
        sums = np.cumsum(np.vstack([np.zeros((1, column.shape[1])), column]), axis=0)
        moved = value * (sums[count:] - sums[:-count])
        return float(np.sqrt(np.square(moved).sum(axis=1).mean()))

    def causes(self, candidates: Mapping[str, float], always: Sequence[str] = (),
               alongside: Sequence[str] = ()) -> dict[str, Estimate]:
        """The causes that are significant and large enough, found one at a time and fitted together.

        candidates: by name, the smallest value reported. always: causes that are fitted in any case.
        alongside: causes with which a candidate may become significant: left out, they look like slow noise.
        """
        chosen: list[str] = []
        left = [name for name in candidates if np.abs(self.columns[name]).max(initial=0.0) > 0.0]
        while left:
            _, scale, _ = self.fit([*always, *chosen])
            losses = {name: self.loss([*always, *chosen, name], scale) for name in left}
            best = min(losses, key=losses.__getitem__)
            left.remove(best)
            # A cause that makes previous ones insignificant is collinear with them.
            for extra in ((), [name for name in alongside if name not in (*always, *chosen, best)]):
                joint = self.estimates([*always, *chosen, best, *extra])
                if all(matters(joint[name], candidates[name]) for name in (*chosen, best)):
                    chosen.append(best)
                    break
        joint = self.estimates([*always, *chosen])
        return {name: joint[name] for name in chosen}


def with_systematic(name: str, one: Estimate) -> Estimate:
    """With the systematic uncertainty of the identity, see SYSTEMATIC; name: of the finding with this value."""
    kind = name.rpartition("_")[2]
    half = SYSTEMATIC.get(name, SYSTEMATIC.get(kind, 0.0)) * (abs(one.value) if kind in ("scale", "sign") else 1.0)
    return one.widened(half)


def matters(estimate: Estimate, least: float) -> bool:
    return estimate.significant and abs(estimate.value) >= least


LONGEST = 1.5  # s of lag that is looked for
LEAST = 15.0  # s in common
NOTHING, UNITY = Estimate(0.0, 0.0, (0.0, 0.0)), Estimate(1.0, 0.0, (1.0, 1.0))
LATE = 0.95  # level of the test for a lag
SHIFT = 0.3  # s to both sides of a lag that must fit worse, or the drive carries none
CLEARLY = 1.25  # ratio of residuals, scale over bias, from which a bias is reported instead
CERTAIN = 0.98  # correlation from which on noise makes less than 4 % of a scale
RESAMPLED = 1e-4  # share of the variance; interpolation and filters leave 1 % of a signal, less is ignored
OFF_GRID = 0.1  # share of the variance by which a maximum is lower half a step away, at the cut-offs in use


@dataclass(frozen=True, eq=False)
class Agreement:
    """lag [s], scale [1] and bias [unit], measured against derived. correlation: at that lag. spread: standard
    deviation of the derived quantity. time, measured, derived: the filtered series at that lag, for the eye.
    alike: other lags [s] that fit as well but for chance, because the drive repeats itself. late: whether no lag (the
    usual one) fits significantly worse; a drive that changes slowly carries no lag, whatever the fit returns.
    correlation_now: without a lag. carries_lag: whether other lags fit significantly worse than this one.
    """

    lag: Estimate
    scale: Estimate
    bias: Estimate
    correlation: float
    spread: float
    time: np.ndarray
    measured: np.ndarray
    derived: np.ndarray
    alike: tuple[float, ...] = ()
    late: bool = True
    correlation_now: float = 0.0
    carries_lag: bool = True


def agreement(time: np.ndarray, derived: np.ndarray, measured_time: np.ndarray, measured: np.ndarray, cutoff: float,
              derived_is_angle: bool = False, biased: bool = True, usual: float = 0.0) -> Agreement | None:
    """None where they are known together for less than LEAST seconds or do not vary.

    time, measured_time: rising [s]; values NaN where unknown. cutoff [Hz]: of the low-pass on both, so that it shifts
    neither. derived_is_angle: its rate is compared. biased: False where a bias is out of the question.
    usual: lag of a channel that is in order [s].
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > LONGEST_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < LEAST:
        return None
    pair = Pair("", reference, other)
    try:
        solution, *others = _solutions(pair, cutoff)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not abs(solution.offset) <= LONGEST:
        return None
    lag = _lag(-solution.offset, solution.offset_deviation, len(reference.time) * STEP)
    rows, derived_there = _at(reference, other, -lag.value)
    if len(rows) * STEP < LEAST or not float(np.std(derived_there)) > 0.0:
        return None
    at, there = other.time[rows], other.values[rows]
    problem = Regression(at, there[:, None], {"scale": derived_there[:, None], "bias": np.ones((len(at), 1))})
    correlation = float(np.corrcoef(derived_there, there)[0, 1]) if float(np.std(there)) > 0.0 else 0.0
    scale, bias = _line(problem, derived_there, correlation, biased)
    return Agreement(lag, scale, bias, correlation, float(np.std(derived_there)), at, there, derived_there,
                     tuple(-one.offset for one in others), _is_late(pair, solution.offset, -usual, cutoff),
                     _correlation(pair, 0.0),
                     all(_is_late(pair, solution.offset, solution.offset + by, cutoff) for by in (-SHIFT, SHIFT)))


def _is_late(pair: Pair, offset: float, usual: float, cutoff: float) -> bool:
    """Whether the usual offset leaves significantly more unexplained than the best one (F test, 95 %)."""
    if abs(offset - usual) < 1e-6:
        return False
    (best, other), common = _rest(pair, [offset, usual])
    return other > _chance(common, cutoff, LATE) * best


def _correlation(pair: Pair, offset: float) -> float:
    rows, derived = _at(pair.reference, pair.other, offset)
    values = pair.other.values[rows]
    return float(np.corrcoef(derived, values)[0, 1]) if len(rows) > 2 and np.std(derived) * np.std(values) > 0 else 0.0


def _solutions(pair: Pair, cutoff: float) -> list[Fit]:
    """The best one and all that chance could have made better, the least offset first.

        (1 - r^2) / (1 - r_best^2) <= F(0.975; n, n),   n = 2 cutoff T   independent samples of what is left in T
    """
    curve = mean_correlation([pair], LEAST, (-LONGEST, LONGEST))
    if curve is None or not curve[1].max() > 0.0:
        return [fit([pair], 0.0, 0.0, free_drift=False)]
    lags, left = curve[0], 1.0 - np.maximum(curve[1], 0.0) ** 2
    best = int(np.argmin(left))
    peaks = 1 + np.flatnonzero((left[1:-1] < left[:-2]) & (left[1:-1] <= left[2:]))
    known = min(float(side.known.sum()) for side in (pair.reference, pair.other))
    found: list[Fit] = []
    for start in (best, *peaks[left[peaks] <= _chance(known, cutoff) * left[best] + OFF_GRID]):
        one = fit([pair], float(lags[start]), 0.0, free_drift=False)
        if all(abs(one.offset - other.offset) > STEP for other in found):
            found.append(one)
    if len(found) == 1:
        return found
    rest, common = _rest(pair, [one.offset for one in found])
    alike = [one for one, size in zip(found, rest, strict=True) if size <= _chance(common, cutoff) * min(rest)]
    return sorted(alike, key=lambda one: abs(one.offset))


def _chance(samples: float, cutoff: float, level: float = 0.975) -> float:
    """Ratio that two variances of one size differ by at most, with this probability."""
    freedom = max(2.0 * cutoff * STEP * samples, 1.0)
    return float(fisher.ppf(level, freedom, freedom))


def _rest(pair: Pair, offsets: Sequence[float]) -> tuple[list[float], int]:
    """(1 - r^2 at each offset, samples), over the same samples: the ends of a filtered derivative are its worst."""
    there = [_at(pair.reference, pair.other, offset) for offset in offsets]
    common = np.flatnonzero(np.bincount(np.concatenate([rows for rows, _ in there])) == len(there))
    values = pair.other.values[common]
    r = [float(np.corrcoef(derived[np.isin(rows, common)], values)[0, 1]) for rows, derived in there]
    return [max(1.0 - one**2, RESAMPLED) for one in r], len(common)


def _line(problem: Regression, derived: np.ndarray, correlation: float, biased: bool) -> tuple[Estimate, Estimate]:
    """(scale, bias). On one long bend a factor and a bias look alike, and noise makes the one of the other: then the
    one that explains more is findings, the other taken as right."""
    alike = abs(float(derived.mean())) > float(derived.std()) and abs(correlation) < CERTAIN
    if biased and not alike:
        both = problem.estimates(("scale", "bias"))
        return both["scale"], both["bias"]
    scale = problem.estimates(("scale",))["scale"]
    if not biased:
        return scale, NOTHING
    shifted = Regression(problem.time, problem.y - derived[:, None], problem.columns)
    if problem.fit(("scale",))[1] <= CLEARLY * shifted.fit(("bias",))[1]:
        return scale, NOTHING
    return UNITY, shifted.estimates(("bias",))["bias"]


def _lag(value: float, deviation: float, seconds: float) -> Estimate:
    low, high = symmetric_interval(value, deviation, max(seconds / 10.0 - 1.0, 1.0))
    return Estimate(value, deviation, (low, high))


def _at(reference: Resampled, other: Resampled, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """(rows of `other` known on both sides, `reference` there)."""
    place = (other.time + offset - reference.origin) / STEP
    index = np.clip(np.floor(place).astype(np.int64), 0, max(len(reference.values) - 2, 0))
    inside = (place >= 0) & (place <= len(reference.values) - 1) & other.known
    inside &= reference.known[index] & reference.known[np.minimum(index + 1, len(reference.known) - 1)]
    rows = np.flatnonzero(inside)
    return rows, np.interp(other.time[rows] + offset, reference.time, reference.values)
