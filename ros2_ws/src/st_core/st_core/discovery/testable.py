"""What the data can show at all, how sure a value is, and how well two effects are told apart."""

import numpy as np

from ..effects import get_effect
from .result import NotTestable
from .study import Fit, Study

VISIBLE = 3.0  # standard deviations a usual size must make
BIAS = 0.05  # of a change: what the equations of an effect are not those of the car
# Causes the forward acceleration holds already, as it is an input.
ALREADY_GIVEN = {
    "drag": "the measured forward acceleration is an input and holds it already",
    "rolling_resistance": "the measured forward acceleration is an input and holds it already",
    "grade": "the measured forward acceleration is an input and holds it already; pitch is not measured",
    "drive_force": "the measured forward acceleration is an input and holds it already",
}


def deviations(study: Study, fit: Fit) -> np.ndarray:
    """(p,) standard deviations of all parameters in usual sizes; gradients that scatter more than the inflation says
    count as much as they do."""
    scale = study.floor.inflation
    free = study.space.indices(*fit.names)
    weight = study.precision(free)
    h = fit.quadratic.hessian.sum(0) / scale
    inverse = np.linalg.inv(h + weight)
    g = (fit.quadratic.gradient - fit.quadratic.gradient.mean(0)) / scale
    scattered = inverse @ (g.T @ g + weight) @ inverse
    return np.sqrt(np.maximum(np.diag(scattered), np.diag(inverse)))


def deviation(study: Study, fit: Fit, index: int, change: float) -> float:
    """Standard deviation of one parameter [SI], structure bias included."""
    statistical = deviations(study, fit)[index] * study.space.scale[index]
    return float(np.hypot(statistical, BIAS * change))


def not_testable(study: Study) -> tuple[NotTestable, ...]:
    """Effects whose usual size these data would not show, and those no data of this kind show."""
    result = []
    base = study.quadratic.hessian.sum(0) / study.floor.inflation
    for name in study.space.hypotheses:
        free = study.space.indices(name)
        inverse = np.linalg.inv(base + study.precision(free))
        strength = max(1.0 / np.sqrt(inverse[i, i]) for i in free)
        if strength < VISIBLE:
            effect = get_effect(name)
            result.append(NotTestable(name, f"a usual size of it would stand out by {strength:.1f} standard deviations "
                                            f"only; it shows in {effect.excited_by}"))
    for name in study.space.without_signal:
        needed = ", ".join(get_effect(name).signals)
        result.append(NotTestable(name, f"it needs the signal {needed}, which is not there"))
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
