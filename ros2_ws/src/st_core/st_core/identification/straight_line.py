"""One slope through several groups of points, each with a level of its own: runs are not joined end to end.

    y_jk = a_j + b x_jk + e_jk,    b = sum (x - x_j)(y - y_j) / sum (x - x_j)^2 over all groups,
    u(b)^2 = s^2 / sum (x - x_j)^2,    s^2 = sum e^2 / (n - J - 1)

x_j, y_j: means of group j. Checked by: test_steering_ratio.py, test_cg_height.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from .result import IdentificationError


@dataclass(frozen=True)
class Line:
    """slope b with its standard uncertainty, levels a_j by group, residuals (n,), scatter s, freedom n - J - 1."""

    slope: float
    uncertainty: float
    levels: dict[str, float]
    residuals: np.ndarray
    scatter: float
    freedom: int


def fit_line(x: np.ndarray, y: np.ndarray, groups: Sequence[str]) -> Line:
    """Least squares of the above. groups: a name per point. Raises IdentificationError when x does not vary."""
    names = np.asarray(groups)
    centred_x, centred_y = np.empty(len(x)), np.empty(len(x))
    members = {str(name): names == name for name in dict.fromkeys(groups)}
    for member in members.values():
        centred_x[member] = x[member] - x[member].mean()
        centred_y[member] = y[member] - y[member].mean()
    spread = float(centred_x @ centred_x)
    freedom = len(x) - len(members) - 1
    if freedom < 1 or spread <= 1e-12 * float(x @ x):
        raise IdentificationError(f"{len(x)} rows in {len(members)} series do not fix a slope: {freedom} degrees of "
                                  "freedom are left; more rows, at different settings, are needed")
    slope = float(centred_x @ centred_y) / spread
    residuals = centred_y - slope * centred_x
    scatter = float(np.sqrt(residuals @ residuals / freedom))
    levels = {name: float(y[member].mean() - slope * x[member].mean()) for name, member in members.items()}
    return Line(slope, scatter / float(np.sqrt(spread)), levels, residuals, scatter, freedom)


def cubic_remainder(x: np.ndarray, line: Line, names: Sequence[str]) -> tuple[tuple[float, float], bool]:
    """(linear, cubic) coefficient of the residuals of a line through groups `names`, and whether it is significant:

        e = c_1 x + c_3 x^3,    F = (sum e^2 - sum e_c^2) / 1 / (sum e_c^2 / (freedom - 1))
    """
    groups = np.asarray(names)
    basis = np.stack([x, x**3], axis=1)
    residual = line.residuals.copy()
    for name in line.levels:
        member = groups == name
        basis[member] -= basis[member].mean(axis=0)
    coefficients, *_ = np.linalg.lstsq(basis, residual, rcond=None)
    unexplained = residual - basis @ coefficients
    before, after, freedom = float(residual @ residual), float(unexplained @ unexplained), line.freedom - 1
    if freedom < 1 or before <= 1e-20:
        return (0.0, 0.0), False
    ratio = (before - after) / max(after / freedom, 1e-20)
    significant = bool(fisher.sf(ratio, 1, freedom) < 0.01)
    return (float(coefficients[0]), float(coefficients[1])), significant
