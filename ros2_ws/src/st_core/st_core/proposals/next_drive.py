"""The drive to do next for a law: which manoeuvre of the catalogue pins its curve down, which tells it from others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..discovery.following import TIMES, TOLD, simulated
from ..discovery.loss import Errors, Loss
from ..discovery.windows import Windows
from ..effects._law import COUNT
from ..manoeuvres import Manoeuvre
from .curve_fit import RIDGE, Fitted, Laws
from .places import ODD, Candidate, driven

CLEARER = 1.3  # times as strong, or as sure, as now: a manoeuvre that brings less tells hardly more
SPARSE = 0.1  # of the driving that falls on a point if all of the range is driven alike: less is thin
OF_A_PLACE = ("run_time", "position_x", "position_y", "north", "east")  # no manoeuvre reaches them by itself
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Option:
    """One manoeuvre, driven TIMES times and added to the runs. deviation: (k,) expected of the curve [unit of the
    curve]. apart: by law that the runs do not tell from it, what that leaves of it in standard deviations of the noise.
    seconds: of one drive in each thin range."""

    manoeuvre: Manoeuvre
    deviation: np.ndarray
    apart: Mapping[str, float]
    seconds: Sequence[float]


@dataclass(frozen=True, eq=False)
class NextDrives:
    """thin: ranges of the quantity with hardly any driving. now: `apart` in the runs at hand. options: every manoeuvre
    that was tried, none for a law of time or place."""

    thin: Sequence[Range] = ()
    now: Mapping[str, float] = field(default_factory=dict)
    options: Sequence[Option] = ()

    def pins_down(self, deviation: np.ndarray) -> Option | None:
        """What makes the least sure point of the curve surest; None where nothing does by CLEARER. deviation: (k,) now.
        """
        best = min(self.options, key=lambda o: float(o.deviation.max()), default=None)
        return best if best is not None and CLEARER * best.deviation.max() <= deviation.max() else None

    def tells_apart(self) -> tuple[Option, str] | None:
        """The largest smallest strength over all laws not told apart, and that law; None below TOLD, and where it is
        hardly larger than now."""
        weakest = [(option, min(option.apart, key=option.apart.__getitem__)) for option in self.options if option.apart]
        best = max(weakest, key=lambda pair: pair[0].apart[pair[1]], default=None)
        if best is None:
            return None
        option, law = best
        return best if option.apart[law] >= max(TOLD, CLEARER * self.now[law]) else None


def thin_ranges(at: np.ndarray, density: np.ndarray, parity: float) -> list[Range]:
    """Where hardly anything was driven, a point and its two neighbours taken together. at, density: (k,) as in
    `Proposal`. Of a curve with a mirror image, the side of positive values."""
    if parity == ODD:
        density = 0.5 * (density + density[::-1])
    around = np.convolve(np.pad(density, 1, mode="edge"), np.ones(3) / 3.0, mode="valid")
    thin = (around < SPARSE / len(at)) & ((at >= 0.0) | (parity != ODD))
    ends = np.flatnonzero(np.diff(np.concatenate([[False], thin, [False]]).astype(int)))
    half = 0.5 * (at[1] - at[0])
    return [(float(at[first] - half), float(at[last - 1] + half)) for first, last in ends.reshape(-1, 2)]


def next_drives(laws: Laws, candidate: Candidate, fit: Fitted, rivals: Mapping[str, Fitted], design: float,
                at: np.ndarray, deviation: np.ndarray, thin: Sequence[Range]) -> NextDrives:
    """What each manoeuvre would add. rivals: laws that are not told from it. design: of the scores of the law. at,
    deviation: (k,) of the curve. Expected deviations fall as the curvature of the loss about the fit grows."""
    if candidate.quantity in OF_A_PLACE:
        return NextDrives(thin)
    splines = candidate.splines(at)
    rivals = {name: other for name, other in rivals.items()
              if other.candidate is not None and other.candidate.quantity not in OF_A_PLACE}
    recorded = {name: _joint(laws.loss, fit.rows, fit.slopes, other.slopes[-COUNT:], fit)
                for name, other in rivals.items()}
    curvature = fit.q.hessian.sum(axis=0)
    variance = _variance(curvature + fit.penalty, splines)
    options = []
    for manoeuvre, windows in simulated(laws.windows, laws.answer.base):
        loss = _loss(laws, windows, candidate, fit)
        rows = 0.0 * np.nan_to_num(loss.errors.at(fit.vector))
        slopes = loss.slopes(fit.vector, fit.which)
        more = TIMES * loss.quadratic(rows, slopes).hessian.sum(axis=0)
        surer = np.sqrt(_variance(curvature + more + fit.penalty, splines) / np.maximum(variance, 1e-30))
        apart = {}
        for name, other in rivals.items():
            assert other.candidate is not None
            theirs = _loss(laws, windows, other.candidate, other).slopes(other.vector, laws.law)
            apart[name] = _strength(recorded[name] + TIMES * _joint(loss, rows, slopes, theirs, fit), fit, other,
                                    design)
        u = driven(windows, windows.vehicle)[candidate.quantity]
        size = np.abs(u) if candidate.parity == ODD else u
        seconds = [manoeuvre.duration * float(((size >= low) & (size <= high)).mean()) for low, high in thin]
        options.append(Option(manoeuvre, deviation * np.minimum(surer, 1.0), apart, seconds))
    return NextDrives(thin, {name: _strength(h, fit, rivals[name], design) for name, h in recorded.items()}, options)


def _loss(laws: Laws, windows: Windows, candidate: Candidate, fit: Fitted) -> Loss:
    """Of other windows, at the scale of the runs."""
    loss = Loss(Errors(windows, laws.space_of(candidate), laws.threads), fit.vector)
    loss.scale = laws.loss.scale
    return loss


def _joint(loss: Loss, rows: np.ndarray, slopes: np.ndarray, theirs: np.ndarray, fit: Fitted) -> np.ndarray:
    """Curvature in everything beside the law, the coefficients of another law, and the size of the law."""
    own = np.einsum("p,pnm->nm", fit.coefficients, np.nan_to_num(slopes[-COUNT:], posinf=0.0, neginf=0.0))
    return loss.quadratic(rows, np.concatenate([slopes[:-COUNT], theirs, own[None]])).hessian.sum(axis=0)


def _strength(h: np.ndarray, fit: Fitted, other: Fitted, design: float) -> float:
    """What the other law leaves of the law, in standard deviations. h: of `_joint`."""
    beside = len(fit.which) - COUNT
    held = np.zeros((len(h) - 1, len(h) - 1))
    held[beside:, beside:] = other.penalty[-COUNT:, -COUNT:]
    free = h[:-1, :-1] + held
    free = free + (RIDGE * np.trace(free) / len(free) + 1e-9) * np.eye(len(free))
    left = float(h[-1, -1] - h[-1, :-1] @ np.linalg.solve(free, h[:-1, -1]))
    return float(np.sqrt(max(2.0 * left / design, 0.0)))


def _variance(h: np.ndarray, splines: np.ndarray) -> np.ndarray:
    """(k,) of the curve, but for a factor."""
    inverse = np.linalg.inv(h + RIDGE * np.eye(len(h)))[-COUNT:, -COUNT:]
    return np.einsum("ik,ij,jk->k", splines, inverse, splines)
