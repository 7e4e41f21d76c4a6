"""Formulas for a fitted curve: simple shapes that can replace it in the simulation, and textbook causes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ..discovery.loss import Quadratic
from ..regression import add_ridge
from .candidates import NO_PARITY, RELATIONS, Candidate
from .relation_fit import RelationFit, RelationFits

MAX_FORMULAS, POINTS = 3, 61  # largest number of formulas; number of points in the range of a curve
MIN_EXPLAINED_FRACTION = 0.5  # minimum fraction of the curve's gain (quadratic approximation) that a shape must explain
MIN_EXPLAINED_INCREASE = 1e-3  # minimum increase of this fraction over any shape with fewer parameters
EQUAL_GAIN = 0.98  # fraction of the gain of the best shape that a simpler shape must explain to be preferred
SIMILAR_GAIN = 0.9  # the same fraction if the held-out loss of the simpler shape is not significantly higher
MIN_RETAINED_GAIN = 0.9  # minimum fraction of the held-out gain of the curve that a formula must retain in simulation
MAX_VALUE_RATIO = 2.0  # maximum ratio of the largest value of a formula to that of the curve, within its range

ShapeFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Formula:
    """Formula of a relation."""

    shape: str  # name of the shape
    text: str  # y as a function of the quantity u [SI], with numbers
    retained_fraction: float  # of the curve's held-out gain, when the formula is simulated in its place [1]
    causes: str = ""  # possible causes from textbooks


@dataclass(frozen=True, eq=False)
class FittedShape:
    """A shape fitted to a quadratic loss."""

    name: str
    text: str
    function: ShapeFunction
    parameters: np.ndarray  # fitted to all blocks
    parameters_by_fold: Mapping[int, np.ndarray]  # fitted without each fold
    explained_fraction: float  # of the gain of the curve [1]
    held_out: np.ndarray  # (b,) held-out loss minus the loss of the curve fitted to all blocks


SHAPES: dict[str, tuple[str, int, ShapeFunction]] = {
    "constant": ("y = {0:.3g}", 1, lambda u, p: p[0] + 0.0 * u),
    "linear": ("y = {0:.3g} u", 1, lambda u, p: p[0] * u),
    "cubic": ("y = {0:.3g} u^3", 1, lambda u, p: p[0] * u**3),
    "square": ("y = {0:.3g} u |u|", 1, lambda u, p: p[0] * u * np.abs(u)),
    "saturating": ("y = {0:.3g} tanh(u / {1:.3g})", 2, lambda u, p: p[0] * np.tanh(u / _avoid_zero(p[1]))),
    "dead zone": ("y = {0:.3g} (|u| - {1:.3g}) sign u beyond {1:.3g}, 0 within", 2,
                  lambda u, p: p[0] * np.sign(u) * np.maximum(np.abs(u) - np.abs(p[1]), 0.0)),
    "linear and cubic": ("y = {0:.3g} u + {1:.3g} u^3", 2, lambda u, p: p[0] * u + p[1] * u**3),
}
ASYMMETRIC_SHAPES: dict[str, tuple[str, int, ShapeFunction]] = {
    "constant": SHAPES["constant"], "linear": SHAPES["linear"],
    "straight line": ("y = {0:.3g} + {1:.3g} u", 2, lambda u, p: p[0] + p[1] * u),
    "square": ("y = {0:.3g} + {1:.3g} u |u|", 2, lambda u, p: p[0] + p[1] * u * np.abs(u)),
    "dead zone": SHAPES["dead zone"],
    "inverse": ("y = {0:.3g} + {1:.3g} / u", 2, lambda u, p: p[0] + p[1] / np.where(np.abs(u) < 1e-9, 1e-9, u)),
    "saturating": ("y = {0:.3g} + {1:.3g} tanh(u / {2:.3g})", 3,
                   lambda u, p: p[0] + p[1] * np.tanh(u / _avoid_zero(p[2]))),
}
"""(Text, number of parameters, function) by shape, for curves without odd symmetry; SHAPES: for odd curves."""

CONSTANT_CAUSES = {
    "front_steer": "a steering offset, toe", "rear_steer": "a misaligned rear axle",
    "yaw_moment": "unequal drag or brakes", "side_force": "steady wind, a banked road",
    "sensor_yaw_rate": "a bias of the sensor", "sensor_acceleration_y": "a bias or tilt of the sensor",
    "sensor_velocity_y": "a bias of the sensor", "sensor_heading": "a misaligned INS",
}
"""Causes of a constant, by term."""


def fit_shapes(candidate: Candidate, coefficients: np.ndarray, profile: Quadratic,
               fold: np.ndarray) -> Sequence[FittedShape]:
    """At most MAX_FORMULAS shapes, the preferred one first. profile: quadratic approximation of the loss about the
    coefficients (8,), by block, all other parameters profiled out. fold: (b,) fold of each block.

    The parameters of a shape minimise the loss. Only shapes that explain MIN_EXPLAINED_FRACTION are considered; the
    best has the lowest held-out loss. A shape with fewer parameters is preferred if it explains EQUAL_GAIN of the gain
    of the best shape, or SIMILAR_GAIN with a held-out loss at most one standard error above the best, from the paired
    differences of the blocks (Breiman et al. 1984).
    """
    points = np.linspace(candidate.low, candidate.high, POINTS)
    splines = candidate.compute_splines(points)
    to_splines, value = np.linalg.pinv(splines.T, rcond=1e-6), coefficients @ splines
    size, max_u = float(np.abs(value).max()), float(np.abs(points).max())
    sign = float(np.sign(np.sum(value * np.sign(points)))) or 1.0
    starts = [np.array([sign * size / max(max_u, 1e-9), scale * max_u, scale * max_u]) for scale in (0.15, 0.4, 0.8)]
    total = float(profile.rise(-coefficients).sum())
    if total <= 1e-20:
        return ()
    shapes = []
    for shape, (text, count, function) in (SHAPES if candidate.parity != NO_PARITY else ASYMMETRIC_SHAPES).items():
        if shape == "inverse" and np.abs(points).min() < 0.05 * max_u:
            continue

        def fit_parameters(blocks: np.ndarray, count: int = count, function: ShapeFunction = function) -> np.ndarray:
            h, g = add_ridge(profile.hessian[blocks].sum(axis=0)), profile.gradient[blocks].sum(axis=0)
            root, target = np.linalg.cholesky(h), coefficients + np.linalg.solve(h, g)
            return min((least_squares(lambda x: (to_splines @ function(points, x) - target) @ root, start[:count],
                                      x_scale=np.abs(start[:count]) + 1e-9) for start in starts),
                       key=lambda fitted: fitted.cost).x

        def compute_distance(p: np.ndarray, function: ShapeFunction = function) -> np.ndarray:
            return to_splines @ function(points, p) - coefficients

        best = fit_parameters(np.ones(len(fold), bool))
        if shape == "dead zone":
            best[1] = abs(best[1])
        explained_fraction = min(1.0 - float(profile.rise(compute_distance(best)).sum()) / total, 1.0)
        if explained_fraction >= MIN_EXPLAINED_FRACTION:
            by_fold = {int(k): fit_parameters(fold != k) for k in np.unique(fold)}
            held_out = np.zeros(len(fold))
            for k, parameters in by_fold.items():
                held_out[fold == k] = profile.rise(compute_distance(parameters))[fold == k]
            shapes.append(FittedShape(shape, text, function, best, by_fold, explained_fraction, held_out))
    return _sort_shapes(shapes)


def _sort_shapes(shapes: Sequence[FittedShape]) -> Sequence[FittedShape]:
    """The first MAX_FORMULAS shapes that no simpler shape matches: the preferred one, then by held-out loss."""
    order = sorted((shape for shape in shapes if not any(
        len(other.parameters) < len(shape.parameters)
        and other.explained_fraction > shape.explained_fraction - MIN_EXPLAINED_INCREASE
        for other in shapes)), key=lambda shape: float(shape.held_out.sum()))
    if not order:
        return ()
    best = order[0]

    def is_as_good(shape: FittedShape) -> bool:
        loss_increase = shape.held_out - best.held_out
        fraction = shape.explained_fraction / best.explained_fraction
        within_error = float(loss_increase.sum()) <= float(loss_increase.std(ddof=1)) * np.sqrt(len(loss_increase))
        return fraction >= EQUAL_GAIN or (fraction >= SIMILAR_GAIN and within_error)

    first = min(filter(is_as_good, order), key=lambda shape: len(shape.parameters))
    return (first, *(shape for shape in order if shape is not first))[:MAX_FORMULAS]


def simulate_formulas(fits: RelationFits, fit: RelationFit, base_fit: RelationFit) -> tuple[Formula, ...]:
    """Formulas that retain at least MIN_RETAINED_GAIN of the held-out gain of the curve when simulated in its place.

    Each fold is simulated with the formula fitted to the other folds, after one refitting step of the parameters of the
    discovered model. A curve without odd symmetry may be determined only up to a constant, which a parameter of the
    vehicle file can imitate; a formula for such a curve gets an additional constant if it fails without one. Within the
    range of the drives, a formula must correlate positively with the curve, and its magnitude must not exceed
    MAX_VALUE_RATIO times the largest magnitude of the curve. Its held-out position error must not exceed the in-sample
    error of the discovered model.
    """
    assert fit.candidate is not None
    candidate, gain = fit.candidate, float((base_fit.held_out - fit.held_out).sum())
    formulas = []
    for shape in fit_shapes(candidate, fit.coefficients, fits.profile(fit), fits.fold):
        for with_offset in (False, True) if candidate.parity == NO_PARITY and shape.name != "constant" else (False,):
            shape_gain, offset = _simulate_shape(fits, fit, base_fit, shape, with_offset)
            if shape_gain >= MIN_RETAINED_GAIN * gain:
                text = shape.text.format(*shape.parameters).replace("+ -", "- ")
                text += f" {'-' if offset < 0.0 else '+'} {abs(offset):.3g}" if with_offset else ""
                is_constant = shape.name == "constant" and not candidate.factor
                causes = CONSTANT_CAUSES.get(candidate.term, "") if is_constant else RELATIONS[
                    candidate.term, candidate.quantity, candidate.factor]
                formulas.append(Formula(shape.name, text, shape_gain / gain, causes))
                break
    return tuple(formulas)


def _simulate_shape(fits: RelationFits, fit: RelationFit, base_fit: RelationFit, shape: FittedShape,
                    with_offset: bool) -> tuple[float, float]:
    """(held-out gain of a shape, its offset); the gain is -inf for a shape that `simulate_formulas` excludes."""
    candidate = fit.candidate
    assert candidate is not None
    points = np.linspace(candidate.low, candidate.high, POINTS)
    splines = candidate.compute_splines(points)
    loss, to_splines = fits.make_loss(candidate), np.linalg.pinv(splines.T, rcond=1e-6)

    def refit(parameters: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, float]:
        """(vector with the shape in place of the curve, other parameters fitted to the blocks in a mask; offset)."""
        scale = fits.space.scale[fit.indices]
        count = len(fit.coefficients)
        fixed = np.zeros(len(scale))
        fixed[-count:] = (to_splines @ shape.function(points, parameters) - fit.coefficients) / scale[-count:]
        basis = np.eye(len(scale))[:, :len(scale) - count]
        if with_offset:
            constant = np.concatenate([np.zeros(len(scale) - count), (to_splines @ np.ones(POINTS)) / scale[-count:]])
            basis = np.column_stack([basis, constant])
        h, g = fit.quadratic.hessian[blocks].sum(axis=0), fit.quadratic.gradient[blocks].sum(axis=0)
        step = np.linalg.solve(add_ridge(basis.T @ h @ basis), basis.T @ (g - h @ fixed))
        vector = fit.vector.copy()
        vector[fit.indices] += (fixed + basis @ step) * scale
        return loss.space.clip_to_bounds(vector), float(step[-1]) if with_offset else 0.0

    _, offset = refit(shape.parameters, np.ones(fits.blocks, bool))
    value, curve = shape.function(points, shape.parameters) + offset, fit.coefficients @ splines
    if value @ curve <= 0.0 or np.abs(value).max() > MAX_VALUE_RATIO * np.abs(curve).max():
        return -np.inf, offset
    held_out, position_error = np.zeros(fits.blocks), np.full(len(fits.block), np.nan)
    for k, parameters in shape.parameters_by_fold.items():
        in_fold = fits.fold == k
        vector, _ = refit(parameters, ~in_fold)
        held_out[in_fold] = np.bincount(fits.block, loss.window_losses(vector), fits.blocks)[in_fold]
        windows = in_fold[fits.block]
        position_error[windows] = fits.problem.position_error(loss.errors.at(vector))[windows]
    base_error = fits.problem.position_error(base_fit.residuals)
    if np.isfinite(position_error).any() and np.nanmean(position_error) > np.nanmean(base_error):
        return -np.inf, offset
    return float((base_fit.held_out - held_out).sum()), offset


def _avoid_zero(number: float) -> float:
    """The number, or 1e-9 if its magnitude is smaller, for use as a divisor."""
    return number if abs(number) > 1e-9 else 1e-9
