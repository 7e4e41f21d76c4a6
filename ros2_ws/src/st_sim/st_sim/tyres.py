"""Lateral force of one tyre: Magic Formula with load dependency, and what drive and brake force leave of it."""

from collections.abc import Callable
from math import atan, sin, sqrt

from .car import Tyre

MINIMUM_LOAD = 50.0
"""N. A wheel that lifts keeps this much, so that no formula divides by zero."""

Force = Callable[[float, float, float], tuple[float, float]]


def lateral_force(tyre: Tyre, stiffness_factor: float) -> Force:
    """The force law of one tyre as a function (slip_angle [rad], load [N], friction_factor) -> (force, peak) [N].

        F_y = D sin(C atan(B a - E (B a - atan(B a)))),  D = mu F_z,  B = K / (C D)
        K = p_ky1 F_z0 sin(p_ky4 atan(F_z / (p_ky2 F_z0))) lambda
        mu = p_dy1 + p_dy2 df_z,  E = (p_ey1 + p_ey2 df_z)(1 - p_ey3 sgn a)

    slip_angle positive when the wheel slides to its left; the force is then negative (to the right). The friction
    factor scales the peak D and leaves the slope K alone. peak = |D|. A closure because it runs four times per
    derivative, 1000 times a second.

    Source: the paper's appendix. Checked by: test_tyres.py (slope, peak, load dependency, lambda).
    """
    nominal = tyre.nominal_load
    shape = tyre.p_cy1
    stiffness = tyre.p_ky1 * nominal * tyre.lambda_ky * stiffness_factor
    knee, p_ky4 = 1.0 / (tyre.p_ky2 * nominal), tyre.p_ky4
    p_dy1, p_dy2, p_ey1, p_ey2, p_ey3 = tyre.p_dy1, tyre.p_dy2, tyre.p_ey1, tyre.p_ey2, tyre.p_ey3

    def force(slip_angle: float, load: float, friction_factor: float) -> tuple[float, float]:
        excess = load / nominal - 1.0
        peak = (p_dy1 + p_dy2 * excess) * friction_factor * load
        curvature = p_ey1 + p_ey2 * excess
        if p_ey3:
            curvature *= 1.0 - p_ey3 * ((slip_angle > 0) - (slip_angle < 0))
        # E > 1 at a light load would turn the curve round beyond the peak: outside what was measured on the tyre.
        curvature = min(curvature, 1.0)
        b_alpha = stiffness * sin(p_ky4 * atan(load * knee)) / (shape * peak) * slip_angle
        return peak * sin(shape * atan(b_alpha - curvature * (b_alpha - atan(b_alpha)))), peak

    return force


def left_by_ellipse(longitudinal: float, peak: float) -> float:
    """Share of the lateral force that a longitudinal one leaves: sqrt(1 - (F_x / peak)^2), 0 beyond the peak [N, N]."""
    used = longitudinal / peak
    return sqrt(1.0 - used * used) if -1.0 < used < 1.0 else 0.0
