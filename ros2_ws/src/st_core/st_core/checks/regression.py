"""Robust linear regression of the residual of an identity, and agreement of two estimates of one quantity.

Neighbouring samples share their errors, so intervals come from a bootstrap over blocks of driving
(`st_core.regression`). Causes of a residual are added one at a time, the one that explains most first, all refitted
together, until no further one is significant and relevant.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from ..clock_fit import STEP, Fit, Pair, fit, mean_correlation, resample
from ..clock_types import LONGEST_SPAN
from ..regression import Blocks, symmetric_interval
from .finding import SYSTEMATIC

OUTLIER = 3.0  # robust standard deviations; windows beyond it weigh less (Huber)
DRAWS, SEED = 200, 0  # of the bootstrap
BLOCK = 5.0  # s, as in the alignment of clocks; correlation between neighbouring blocks widens the interval
MIN_FREEDOM = 4.0  # of Student's t
RIDGE = 1e-6  # of the whole normal matrix, which keeps a draw without excitation solvable


@dataclass(frozen=True)
class Estimate:
    """A value with its standard deviation and 95 % interval."""

    value: float
    deviation: float
    interval: tuple[float, float]

    @property
    def significant(self) -> bool:
        """Whether the 95 % interval excludes 0 by another half of its half-width: a dozen causes are tested."""
        low, high = self.interval
        return min(abs(low), abs(high)) > 0.5 * (high - self.value) and low * high > 0.0

    @property
    def half(self) -> float:
        """Half-width of the interval."""
        return 0.5 * (self.interval[1] - self.interval[0])

    def covers(self, value: float) -> bool:
        return self.interval[0] <= value <= self.interval[1]

    def scaled(self, factor: float) -> "Estimate":
        low, high = sorted(factor * end for end in self.interval)
        return Estimate(factor * self.value, abs(factor) * self.deviation, (low, high))

    def inverse(self) -> "Estimate":
        """Estimate of 1 / value, to first order, so that an interval across 0 stays an interval."""
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
    """Robust regression y = sum_k theta_k X_k + residual over windows.

    time: (n,) of the windows [s]. y: (n, m), m components of a window. columns: X_k by name, (n, m) each.
    """

    def __init__(self, time: np.ndarray, y: np.ndarray, columns: Mapping[str, np.ndarray]):
        self.time, self.y, self.columns = time, y, columns
        found, of = np.unique(np.floor(time / BLOCK).astype(np.int64), return_inverse=True)
        self._blocks = Blocks(of, np.zeros(len(found), np.int64), found, f"{len(found)} blocks of {BLOCK:g} s")

    def residual(self, theta: Mapping[str, float]) -> np.ndarray:
        """Residual of y (n, m)."""
        return self.y - sum((value * self.columns[name] for name, value in theta.items()), np.zeros_like(self.y))

    def fit(self, names: Sequence[str]) -> tuple[dict[str, float], float, np.ndarray]:
        """(values by name, median size of the residual over the windows, weights of the windows (n,))."""
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
        size = np.sqrt(np.square(self.residual(theta)).sum(axis=1)) / (OUTLIER * scale)
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
        diagonal = np.diag(np.diag(whole)) + 1e-12 * np.eye(len(names))  # two causes may be collinear on this drive

        def estimator(draws: np.ndarray) -> np.ndarray:
            return np.linalg.solve(np.tensordot(draws, squares, 1) + RIDGE * (whole + diagonal),
                                   (draws @ pulls + RIDGE * pulled)[:, :, None])[:, :, 0]

        spread = self._blocks.bootstrap(estimator, DRAWS, SEED)
        estimates = {}
        for name, deviation, freedom in zip(names, spread.deviations.tolist(), spread.freedom.tolist(), strict=True):
            interval = symmetric_interval(theta[name], deviation, max(freedom, MIN_FREEDOM))
            estimates[name] = Estimate(theta[name], deviation, interval)
        return estimates

    def effect(self, name: str, value: float, seconds: float, window: float) -> float:
        """Root mean square shift by a cause of this size within `seconds`, summed over windows of `window` [s]."""
        count = max(round(seconds / window), 1)
        column = self.columns[name]
        if len(column) < count:
            return float(np.sqrt(np.square(value * column).sum(axis=1).mean())) * count
        sums = np.cumsum(np.vstack([np.zeros((1, column.shape[1])), column]), axis=0)
        moved = value * (sums[count:] - sums[:-count])
        return float(np.sqrt(np.square(moved).sum(axis=1).mean()))

    def causes(self, candidates: Mapping[str, float], always: Sequence[str] = (),
               alongside: Sequence[str] = ()) -> dict[str, Estimate]:
        """The significant and relevant causes, selected one at a time and fitted together.

        candidates: smallest value reported, by name. always: causes that are fitted in any case. alongside: causes with
        which a candidate may become significant; without them they would act as slow noise.
        """
        chosen: list[str] = []
        remaining = [name for name in candidates if np.abs(self.columns[name]).max(initial=0.0) > 0.0]
        while remaining:
            _, scale, _ = self.fit([*always, *chosen])
            losses = {name: self.loss([*always, *chosen, name], scale) for name in remaining}
            best = min(losses, key=losses.__getitem__)
            remaining.remove(best)
            # A cause that makes the previous ones insignificant is collinear with them and is not added.
            for extra in ((), [name for name in alongside if name not in (*always, *chosen, best)]):
                joint = self.estimates([*always, *chosen, best, *extra])
                if all(is_relevant(joint[name], candidates[name]) for name in (*chosen, best)):
                    chosen.append(best)
                    break
        joint = self.estimates([*always, *chosen])
        return {name: joint[name] for name in chosen}


def with_systematic(name: str, estimate: Estimate) -> Estimate:
    """The estimate with the systematic uncertainty of its identity (SYSTEMATIC); name: of the finding."""
    kind = name.rpartition("_")[2]
    half = SYSTEMATIC.get(name, SYSTEMATIC.get(kind, 0.0))
    return estimate.widened(half * abs(estimate.value) if kind in ("scale", "sign") else half)


def is_relevant(estimate: Estimate, least: float) -> bool:
    """Whether an estimate is significant and reaches the smallest value that is reported."""
    return estimate.significant and abs(estimate.value) >= least


MAX_LAG = 1.5  # s; the search goes that far to both sides
MIN_COMMON_TIME = 15.0  # s
ZERO, ONE = Estimate(0.0, 0.0, (0.0, 0.0)), Estimate(1.0, 0.0, (1.0, 1.0))
LAG_TEST_LEVEL = 0.95
LAG_TEST_SHIFT = 0.3  # s; the fit this far to both sides of a lag must be worse, else the drive determines no lag
BIAS_RESIDUAL_RATIO = 1.25  # residual with a scale over that with a bias, from which on a bias is reported instead
MIN_CERTAIN_CORRELATION = 0.98  # from which on noise changes a scale by less than 4 %
MIN_RESIDUAL_SHARE = 1e-4  # of the variance; interpolation and filters alone leave 1 % of a signal
GRID_LOSS = 0.1  # of the variance, by which a maximum half a grid step away is lower, at the cut-offs in use


@dataclass(frozen=True, eq=False)
class Agreement:
    """Lag [s], scale [1] and bias [unit] of a measured quantity against a derived one.

    correlation: at that lag; correlation_now: without a lag. spread: standard deviation of the derived quantity. time,
    measured, derived: the filtered series at that lag, for a figure. alike: other lags [s] that fit equally well within
    chance, since the drive repeats itself. late: whether the usual lag fits significantly worse. carries_lag: whether
    other lags fit significantly worse than this one; a drive that changes slowly determines no lag.
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
    """Agreement of two estimates of a quantity; None where they share less than MIN_COMMON_TIME or are constant.

    time, measured_time: rising [s]; values NaN where unknown. cutoff [Hz]: of the low-pass on both. derived_is_angle:
    the rate of `derived` is compared. biased: whether a bias is possible. usual: lag of a faultless channel [s].
    """
    if max(float(np.ptp(t)) if len(t) else 0.0 for t in (time, measured_time)) > LONGEST_SPAN:
        return None
    reference = resample(time, derived, cutoff, derived_is_angle)
    other = resample(measured_time, measured, cutoff)
    if min(side.known.sum() for side in (reference, other)) * STEP < MIN_COMMON_TIME:
        return None
    pair = Pair("", reference, other)
    try:
        solution, *others = _best_offsets(pair, cutoff)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not abs(solution.offset) <= MAX_LAG:
        return None
    freedom = max(len(reference.time) * STEP / 10.0 - 1.0, 1.0)
    lag = Estimate(-solution.offset, solution.offset_deviation,
                   symmetric_interval(-solution.offset, solution.offset_deviation, freedom))
    rows, x = _common_samples(pair, solution.offset)
    if len(rows) * STEP < MIN_COMMON_TIME or not float(np.std(x)) > 0.0:
        return None
    at, y = other.time[rows], other.values[rows]
    problem = Regression(at, y[:, None], {"scale": x[:, None], "bias": np.ones((len(at), 1))})
    correlation = float(np.corrcoef(x, y)[0, 1]) if float(np.std(y)) > 0.0 else 0.0
    scale, bias = _fit_line(problem, x, correlation, biased)
    neighbours = solution.offset - LAG_TEST_SHIFT, solution.offset + LAG_TEST_SHIFT
    return Agreement(lag, scale, bias, correlation, float(np.std(x)), at, y, x,
                     tuple(-alternative.offset for alternative in others),
                     _fits_worse(pair, -usual, solution.offset, cutoff), _correlation(pair, 0.0),
                     all(_fits_worse(pair, offset, solution.offset, cutoff) for offset in neighbours))


def _fits_worse(pair: Pair, offset: float, best: float, cutoff: float) -> bool:
    """Whether an offset leaves significantly more unexplained than the best one (F test, 95 %)."""
    if abs(offset - best) < 1e-6:
        return False
    (least, residual), common = _residual_shares(pair, [best, offset])
    return residual > _f_limit(common, cutoff, LAG_TEST_LEVEL) * least


def _correlation(pair: Pair, offset: float) -> float:
    rows, derived = _common_samples(pair, offset)
    values = pair.other.values[rows]
    return float(np.corrcoef(derived, values)[0, 1]) if len(rows) > 2 and np.std(derived) * np.std(values) > 0 else 0.0


def _best_offsets(pair: Pair, cutoff: float) -> list[Fit]:
    """The best offset and all that are as good within chance, the smallest first.

        (1 - r^2) / (1 - r_best^2) <= F(0.975; n, n),   n = 2 cutoff T   independent samples of the residual in T
    """
    curve = mean_correlation([pair], MIN_COMMON_TIME, (-MAX_LAG, MAX_LAG))
    if curve is None or not curve[1].max() > 0.0:
        return [fit([pair], 0.0, 0.0, free_drift=False)]
    lags, residual = curve[0], 1.0 - np.maximum(curve[1], 0.0) ** 2
    best = int(np.argmin(residual))
    peaks = 1 + np.flatnonzero((residual[1:-1] < residual[:-2]) & (residual[1:-1] <= residual[2:]))
    known = min(float(side.known.sum()) for side in (pair.reference, pair.other))
    fits: list[Fit] = []
    for start in (best, *peaks[residual[peaks] <= _f_limit(known, cutoff) * residual[best] + GRID_LOSS]):
        solution = fit([pair], float(lags[start]), 0.0, free_drift=False)
        if all(abs(solution.offset - other.offset) > STEP for other in fits):
            fits.append(solution)
    if len(fits) == 1:
        return fits
    shares, common = _residual_shares(pair, [solution.offset for solution in fits])
    limit = _f_limit(common, cutoff) * min(shares)
    return sorted((solution for solution, share in zip(fits, shares, strict=True) if share <= limit),
                  key=lambda solution: abs(solution.offset))


def _f_limit(samples: float, cutoff: float, level: float = 0.975) -> float:
    """Largest ratio of two equal variances at this probability."""
    freedom = max(2.0 * cutoff * STEP * samples, 1.0)
    return float(fisher.ppf(level, freedom, freedom))


def _residual_shares(pair: Pair, offsets: Sequence[float]) -> tuple[list[float], int]:
    """(1 - r^2 at each offset, number of samples), over the samples common to all: the ends of a filtered derivative
    are its least accurate part."""
    series = [_common_samples(pair, offset) for offset in offsets]
    common = np.flatnonzero(np.bincount(np.concatenate([rows for rows, _ in series])) == len(series))
    values = pair.other.values[common]
    with np.errstate(invalid="ignore", divide="ignore"):  # a constant series, as of a car that stands, explains nothing
        r = [float(np.nan_to_num(np.corrcoef(derived[np.isin(rows, common)], values)[0, 1]))
             for rows, derived in series]
    return [max(1.0 - correlation**2, MIN_RESIDUAL_SHARE) for correlation in r], len(common)


def _fit_line(problem: Regression, derived: np.ndarray, correlation: float, biased: bool) -> tuple[Estimate, Estimate]:
    """(scale, bias). On one long bend the two are confounded, and noise turns one into the other: then the one that
    explains more is estimated, and the other is taken as faultless."""
    confounded = abs(float(derived.mean())) > float(derived.std()) and abs(correlation) < MIN_CERTAIN_CORRELATION
    if biased and not confounded:
        both = problem.estimates(("scale", "bias"))
        return both["scale"], both["bias"]
    scale = problem.estimates(("scale",))["scale"]
    if not biased:
        return scale, ZERO
    shifted = Regression(problem.time, problem.y - derived[:, None], problem.columns)
    if problem.fit(("scale",))[1] <= BIAS_RESIDUAL_RATIO * shifted.fit(("bias",))[1]:
        return scale, ZERO
    return ONE, shifted.estimates(("bias",))["bias"]


def _common_samples(pair: Pair, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """(rows of `other` known on both sides at this offset [s], the reference there)."""
    reference, other = pair.reference, pair.other
    place = (other.time + offset - reference.origin) / STEP
    index = np.clip(np.floor(place).astype(np.int64), 0, max(len(reference.values) - 2, 0))
    inside = (place >= 0) & (place <= len(reference.values) - 1) & other.known
    inside &= reference.known[index] & reference.known[np.minimum(index + 1, len(reference.known) - 1)]
    rows = np.flatnonzero(inside)
    return rows, np.interp(other.time[rows] + offset, reference.time, reference.values)
