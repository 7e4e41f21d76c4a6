"""What the data can show at all, how sure a value is, and how well two effects are told apart."""

import numpy as np

from ..effects import get_effect
from .quadratic import Quadratic
from .result import NotTestable
from .study import Fit, Study

VISIBLE = 4.0  # standard deviations a usual size must make
BIAS = 0.05  # of a change: what the equations of an effect are not those of the car
# Causes the forward acceleration holds already, as it is an input.
ALREADY_GIVEN = {
    "drag": "the measured forward acceleration is an input and holds it already",
    "rolling_resistance": "the measured forward acceleration is an input and holds it already",
    "grade": "the measured forward acceleration is an input and holds it already; pitch is not measured",
    "drive_force": "the measured forward acceleration is an input and holds it already",
}


def change_of(spread: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(f, p) and (f,): what a deviation says of the change of each freed parameter, and the variance that is left.

    A healthy car is off the floor by e, spread S; the suspect one by e + change. Of e in the freed parameters the rest
    tells S_fr S_rr^-1 times its deviation: change = d_f - S_fr S_rr^-1 d_r.
    """
    rest = np.setdiff1d(np.arange(len(spread)), free)
    told = np.linalg.solve(spread[np.ix_(rest, rest)], spread[np.ix_(rest, free)]).T
    row = np.zeros((len(free), len(spread)))
    row[np.arange(len(free)), free] = 1.0
    row[:, rest] = -told
    return row, np.diag(spread[np.ix_(free, free)] - told @ spread[np.ix_(rest, free)])


def deviations(study: Study, quadratic: Quadratic, names: tuple[str, ...], scattered: bool = True) -> np.ndarray:
    """Standard deviations of the changes of the freed parameters, in usual sizes and in the order of their indices.

    scattered: gradients that scatter more from block to block than the inflation says count as much as they do.
    """
    free = study.space.indices(*names)
    weight = study.precision(free)
    inverse = np.linalg.inv(quadratic.hessian.sum(0) / study.floor.inflation + weight)
    row, left = change_of(study.floor.spread, free)
    variance = np.einsum("fi,ij,fj->f", row, inverse, row)
    if scattered:
        g = (quadratic.gradient - quadratic.gradient.mean(0)) / study.floor.inflation
        spread = row @ inverse
        variance = np.maximum(variance, np.einsum("fi,ij,fj->f", spread, g.T @ g + weight, spread))
    return np.sqrt(variance + np.maximum(left, 0.0))


def deviation(study: Study, fit: Fit, index: int, change: float) -> float:
    """Standard deviation of one parameter [SI], structure bias included."""
    free = study.space.indices(*fit.names)
    of_all = deviations(study, fit.quadratic, fit.names)
    statistical = of_all[int(np.flatnonzero(free == index)[0])] * study.space.scale[index]
    return float(np.hypot(statistical, BIAS * change))


def not_testable(study: Study, limit: float) -> tuple[NotTestable, ...]:
    """Effects whose usual size these data would not show, and those no data of this kind show. limit: the gain below
    which nothing is said; that of an effect is the square of the standard deviations it stands out by."""
    needed = max(VISIBLE, limit**0.5)
    result = []
    for name in study.space.hypotheses:
        strength = float((1.0 / deviations(study, study.quadratic, (name,), scattered=False)).max())
        if strength < needed:
            effect = get_effect(name)
            result.append(NotTestable(name, f"a usual size of it would stand out by {strength:.1f} standard deviations "
                                            f"({needed:.1f} are needed); it shows in {effect.excited_by}"))
    for name in study.space.without_signal:
        signals = ", ".join(get_effect(name).signals)
        result.append(NotTestable(name, f"it needs the signal {signals}, which is not there"))
    return (*result, *(NotTestable(name, reason) for name, reason in ALREADY_GIVEN.items()))


def separable(study: Study, first: Fit, second: Fit) -> tuple[float, float]:
    """(cosine of the signatures, what the second leaves of the first in standard deviations) in these data."""
    q, scale = study.quadratic, study.floor.inflation
    h = q.hessian.sum(0) / scale
    a = (first.vector - study.floor.vector) / study.space.scale
    own = np.zeros_like(a)
    own[study.space.indices(*first.names)] = a[study.space.indices(*first.names)]
    b = (second.vector - study.floor.vector) / study.space.scale
    other = np.zeros_like(b)
    other[study.space.indices(*second.names)] = b[study.space.indices(*second.names)]
    sizes = np.sqrt(max(own @ h @ own, 1e-12) * max(other @ h @ other, 1e-12))
    g = h @ own
    weight = study.precision(study.space.indices(*second.names))
    left = own @ h @ own - g @ np.linalg.solve(h + weight, g)
    return float(np.clip(own @ h @ other / sizes, -1.0, 1.0)), float(np.sqrt(max(left, 0.0)))
