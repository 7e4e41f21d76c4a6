"""Next drive for a relation: the manoeuvres that best reduce its uncertainty or separate it from its alternatives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..discovery.loss import Errors, Loss
from ..discovery.next_manoeuvre import MIN_SEPARATION, REPETITIONS, simulate_manoeuvres
from ..discovery.windows import Windows
from ..effects._relation import SPLINES
from ..manoeuvres import Manoeuvre
from ..regression import add_ridge
from .candidates import ODD, compute_quantities
from .relation_fit import RIDGE, RelationFit, RelationFits

MIN_IMPROVEMENT = 1.3  # smallest factor by which a suggested manoeuvre increases the separation or the precision
SPARSE_DENSITY = 0.1  # a range has few samples if its density is below this fraction of a uniform density
INDEPENDENT_OF_MANOEUVRE = ("run_time", "position_x", "position_y", "north", "east")
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Option:
    """Expected result after REPETITIONS further drives of one manoeuvre."""

    manoeuvre: Manoeuvre
    deviation: np.ndarray  # (k,) standard deviation of the curve [its unit]
    separation: Mapping[str, float]  # from each alternative [standard deviations]
    seconds: Sequence[float]  # per drive, in each sparse range


@dataclass(frozen=True, eq=False)
class NextDrives:
    """Results of simulated further drives."""

    sparse_ranges: Sequence[Range] = ()  # ranges that the runs hardly cover
    current_separation: Mapping[str, float] = field(default_factory=dict)  # from each alternative, in the runs
    options: Sequence[Option] = ()  # all simulated manoeuvres; none for quantities in INDEPENDENT_OF_MANOEUVRE

    def find_most_precise(self, deviation: np.ndarray) -> Option | None:
        """The option with the lowest maximum deviation; None without options, or if the improvement is below
        MIN_IMPROVEMENT. deviation: (k,) in the existing runs."""
        best = min(self.options, key=lambda option: float(option.deviation.max()), default=None)
        return best if best is not None and MIN_IMPROVEMENT * best.deviation.max() <= deviation.max() else None

    def find_most_separating(self) -> tuple[Option, str] | None:
        """The option with the largest separation from its nearest alternative, and the alternative's name; None without
        alternatives, below MIN_SEPARATION, or below MIN_IMPROVEMENT times the current separation."""
        options = [option for option in self.options if option.separation]
        if not options:
            return None
        best = max(options, key=lambda option: min(option.separation.values()))
        nearest = min(best.separation, key=best.separation.__getitem__)
        required = max(MIN_SEPARATION, MIN_IMPROVEMENT * self.current_separation[nearest])
        return (best, nearest) if best.separation[nearest] >= required else None


def find_sparse_ranges(points: np.ndarray, density: np.ndarray, parity: float) -> list[Range]:
    """Ranges with few samples, >= 0 for an odd curve, from densities averaged over 3 points. points, density: (k,)."""
    if parity == ODD:
        density = 0.5 * (density + density[::-1])
    smoothed = np.convolve(np.pad(density, 1, mode="edge"), np.ones(3) / 3.0, mode="valid")
    sparse = (smoothed < SPARSE_DENSITY / len(points)) & ((points >= 0.0) | (parity != ODD))
    ends = np.flatnonzero(np.diff(np.concatenate([[False], sparse, [False]]).astype(int)))
    half_spacing = 0.5 * (points[1] - points[0])
    return [(float(points[first] - half_spacing), float(points[last - 1] + half_spacing))
            for first, last in ends.reshape(-1, 2)]


def simulate_drives(fits: RelationFits, fit: RelationFit, alternatives: Mapping[str, RelationFit], design_effect: float,
                   points: np.ndarray, deviation: np.ndarray, sparse_ranges: Sequence[Range]) -> NextDrives:
    """Simulate each manoeuvre as an addition to the runs. alternatives: equally good relations. design_effect: see
    `ScreenedCandidate`. points: (k,) of the quantity. deviation: (k,) of the curve."""
    candidate = fit.candidate
    assert candidate is not None
    if candidate.quantity in INDEPENDENT_OF_MANOEUVRE:
        return NextDrives(sparse_ranges)
    splines = candidate.compute_splines(points)
    alternatives = {name: other for name, other in alternatives.items()
                    if other.candidate is not None and other.candidate.quantity not in INDEPENDENT_OF_MANOEUVRE}
    recorded_curvature = {name: _compute_joint_curvature(fits.loss, fit.residuals, fit.sensitivities,
                                                         other.sensitivities[-SPLINES:], fit)
                          for name, other in alternatives.items()}
    curvature = fit.quadratic.hessian.sum(axis=0)
    variance = _compute_variance(curvature + fit.penalty, splines)
    options = []
    for manoeuvre, windows in simulate_manoeuvres(fits.windows, fits.model.base):
        loss = _make_loss(fits, windows, fit)
        residuals = np.zeros_like(loss.errors.at(fit.vector))
        sensitivities = loss.sensitivities(fit.vector, fit.indices)
        added_curvature = REPETITIONS * loss.quadratic(residuals, sensitivities).hessian.sum(axis=0)
        new_variance = _compute_variance(curvature + added_curvature + fit.penalty, splines)
        ratio = np.sqrt(new_variance / np.maximum(variance, 1e-30))
        separation = {}
        for name, other in alternatives.items():
            other_sensitivities = _make_loss(fits, windows, other).sensitivities(other.vector, fits.relation_indices)
            joint_curvature = _compute_joint_curvature(loss, residuals, sensitivities, other_sensitivities, fit)
            separation[name] = _compute_separation(recorded_curvature[name] + REPETITIONS * joint_curvature, fit, other,
                                                   design_effect)
        u = compute_quantities(windows)[candidate.quantity]
        size = np.abs(u) if candidate.parity == ODD else u
        seconds = [manoeuvre.duration * float(((size >= low) & (size <= high)).mean()) for low, high in sparse_ranges]
        options.append(Option(manoeuvre, deviation * np.minimum(ratio, 1.0), separation, seconds))
    current = {name: _compute_separation(h, fit, alternatives[name], design_effect)
               for name, h in recorded_curvature.items()}
    return NextDrives(sparse_ranges, current, options)


def _make_loss(fits: RelationFits, windows: Windows, fit: RelationFit) -> Loss:
    assert fit.candidate is not None
    loss = Loss(Errors(windows, fits.make_space(fit.candidate), fits.threads), fit.vector)
    loss.scale = fits.loss.scale
    return loss


def _compute_joint_curvature(loss: Loss, residuals: np.ndarray, sensitivities: np.ndarray,
                             other_sensitivities: np.ndarray, fit: RelationFit) -> np.ndarray:
    """Curvature of the loss in the effect parameters, the coefficients of an alternative, and a factor that multiplies
    the relation."""
    scale_sensitivity = np.einsum("p,pnm->nm", fit.coefficients, sensitivities[-SPLINES:])
    all_sensitivities = np.concatenate([sensitivities[:-SPLINES], other_sensitivities, scale_sensitivity[None]])
    return loss.quadratic(residuals, all_sensitivities).hessian.sum(axis=0)


def _compute_separation(h: np.ndarray, fit: RelationFit, other: RelationFit, design_effect: float) -> float:
    """Separation of a relation from an alternative, in standard deviations. h: result of `_compute_joint_curvature`."""
    effect_count = len(fit.indices) - SPLINES
    penalty = np.zeros((len(h) - 1, len(h) - 1))
    penalty[effect_count:, effect_count:] = other.penalty[-SPLINES:, -SPLINES:]
    unexplained = float(h[-1, -1] - h[-1, :-1] @ np.linalg.solve(add_ridge(h[:-1, :-1] + penalty), h[:-1, -1]))
    return float(np.sqrt(max(2.0 * unexplained / design_effect, 0.0)))


def _compute_variance(h: np.ndarray, splines: np.ndarray) -> np.ndarray:
    """(k,) variance of the curve at the points of `splines`, up to a constant factor. h: curvature with the penalty."""
    inverse = np.linalg.inv(h + RIDGE * np.eye(len(h)))[-SPLINES:, -SPLINES:]
    return np.einsum("ik,ij,jk->k", splines, inverse, splines)
