"""Lateral force of one tyre: Magic Formula with load dependency, and what drive and brake force leave of it."""

from math import atan, sin, sqrt
from typing import NamedTuple

from .car import Tyre

MINIMUM_LOAD = 50.0
"""N. A wheel that lifts keeps this much, so that no formula divides by zero."""


class TyreLaw(NamedTuple):
    """Coefficients of `tyre_force`: those of the tyre, K's factors joined. knee: 1 / (p_ky2 F_z0) [1/N]."""

    nominal: float
    shape: float
    stiffness: float
    knee: float
    p_ky4: float
    p_dy1: float
    p_dy2: float
    p_ey1: float
    p_ey2: float
    p_ey3: float


def tyre_law(tyre: Tyre, stiffness_factor: float) -> TyreLaw:
    """Coefficients of one tyre whose slope K is scaled by the factor."""
    nominal = tyre.nominal_load
    stiffness = tyre.p_ky1 * nominal * tyre.lambda_ky * stiffness_factor
    return TyreLaw(
        nominal,
        tyre.p_cy1,
        stiffness,
        1.0 / (tyre.p_ky2 * nominal),
        tyre.p_ky4,
        tyre.p_dy1,
        tyre.p_dy2,
        tyre.p_ey1,
        tyre.p_ey2,
        tyre.p_ey3,
    )


def tyre_force(law: TyreLaw, slip_angle: float, load: float, friction_factor: float) -> tuple[float, float]:
    """(F_y, peak) [N] of one tyre; slip_angle [rad], load [N].

        F_y = D sin(C atan(B a - E (B a - atan(B a)))),  D = mu F_z,  B = K / (C D)
        K = p_ky1 F_z0 sin(p_ky4 atan(F_z / (p_ky2 F_z0))) lambda
        mu = p_dy1 + p_dy2 df_z,  E = (p_ey1 + p_ey2 df_z)(1 - p_ey3 sgn a)

    slip_angle positive when the wheel slides to its left; the force is then negative (to the right). The friction
    factor scales the peak D and leaves the slope K alone. peak = |D|. It runs four times per derivative, 1000 times a
    second, and compiled in bench/discovery.

    Source: the paper's appendix. Checked by: test_tyres.py (slope, peak, load dependency, lambda).
    """
    nominal, shape, stiffness, knee, p_ky4, p_dy1, p_dy2, p_ey1, p_ey2, p_ey3 = law
    excess = load / nominal - 1.0
    peak = (p_dy1 + p_dy2 * excess) * friction_factor * load
    curvature = p_ey1 + p_ey2 * excess
    if p_ey3 != 0.0:
        curvature *= 1.0 - p_ey3 * ((slip_angle > 0) - (slip_angle < 0))
    # E > 1 at a light load would turn the curve round beyond the peak: outside what was measured on the tyre.
    curvature = min(curvature, 1.0)
    b_alpha = stiffness * sin(p_ky4 * atan(load * knee)) / (shape * peak) * slip_angle
    return peak * sin(shape * atan(b_alpha - curvature * (b_alpha - atan(b_alpha)))), peak


def left_by_ellipse(longitudinal: float, peak: float) -> float:
    """Share of the lateral force that a longitudinal one leaves: sqrt(1 - (F_x / peak)^2), 0 beyond the peak [N, N]."""
    used = longitudinal / peak
    return sqrt(1.0 - used * used) if -1.0 < used < 1.0 else 0.0
