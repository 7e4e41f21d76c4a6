"""Steady-state lateral force of axles and tyres as a function of slip angle and load.

Sign convention of the package: a slip angle is positive when the wheel slides to its left, so the force that opposes it
is negative. Linear: F_y = -C alpha with C > 0. The Magic Formula has p_ky1 < 0 as in SAE axes, so that its stiffness K
is negative and its force opposes alpha without a further minus sign.
"""

from typing import Annotated, NamedTuple

from .ops import absolute, atan, maximum, minimum, sign, sin
from .types import Quantity

GRAVITY = 9.81  # m/s^2, the value in the paper
STANDARD_GRAVITY = 9.80665  # m/s^2, the unit g
MINIMUM_LOAD = 1.0  # N, of one tyre; the load is a divisor, and a jump in speed can imply a lifted axle


class MagicFormula(NamedTuple):
    """Parameters of one tyre for pure lateral slip, named as in the paper's table; p_ky1 < 0 as in SAE axes."""

    nominal_load: Annotated[float, Quantity("N", 1.0, 1.0e5)]  # F_z0
    p_cy1: Annotated[float, Quantity("1", 0.5, 3.0)]
    p_dy1: Annotated[float, Quantity("1", 0.05, 3.0)]
    p_dy2: Annotated[float, Quantity("1", -1.0, 1.0)]
    p_ey1: Annotated[float, Quantity("1", -20.0, 1.0)]
    p_ey2: Annotated[float, Quantity("1", -20.0, 20.0)]
    p_ey3: Annotated[float, Quantity("1", -5.0, 5.0)]
    p_ky1: Annotated[float, Quantity("1", -200.0, -1.0)]
    p_ky2: Annotated[float, Quantity("1", 0.1, 20.0)]
    p_ky4: Annotated[float, Quantity("1", 0.1, 4.0)]
    lambda_ky: Annotated[float, Quantity("1", 0.01, 10.0, required=False)] = 1.0  # factor of the cornering stiffness
    lambda_cy: Annotated[float, Quantity("1", 0.1, 10.0, required=False)] = 1.0  # factor of the shape
    lambda_muy: Annotated[float, Quantity("1", 0.01, 10.0, required=False)] = 1.0  # factor of the friction


def slip_angle(velocity_lateral, velocity_forward, minimum_speed):
    """alpha = atan(v_sy / max(|v_x|, v_eps)) [rad], in wheel axes; positive when the wheel slides to its left.

    velocity_lateral, velocity_forward: velocity of the wheel in wheel axes [m/s]. minimum_speed: v_eps [m/s], > 0;
    below it the angle is deliberately underestimated. Source: paper, slip angle equation.
    """
    return atan(velocity_lateral / maximum(absolute(velocity_forward), minimum_speed))


def linear_force(slip, cornering_stiffness):
    """F_y = -C alpha [N] of an axle; C > 0 per axle [N/rad]."""
    return -cornering_stiffness * slip


def magic_formula_stiffness(load, tyre: MagicFormula):
    """K = p_ky1 F_z0 sin(p_ky4 atan(F_z / (p_ky2 F_z0))) lambda_ky [N/rad], < 0, of one tyre at load [N]."""
    return (tyre.p_ky1 * tyre.nominal_load * tyre.lambda_ky
            * sin(tyre.p_ky4 * atan(load / (tyre.p_ky2 * tyre.nominal_load))))


def magic_formula_peak(load, tyre: MagicFormula):
    """D = (p_dy1 + p_dy2 df) lambda_muy F_z [N] of one tyre at load [N], df = (F_z - F_z0) / F_z0; F_z >= 1 N."""
    load = maximum(load, MINIMUM_LOAD)
    return (tyre.p_dy1 + tyre.p_dy2 * (load / tyre.nominal_load - 1.0)) * tyre.lambda_muy * load


def magic_formula_coefficients(load, tyre: MagicFormula):
    """(B, D, E) of one tyre at load [N], the coefficients that depend only on the load; D: `magic_formula_peak`.

        B = K / (C D),  E = p_ey1 + p_ey2 df,  df = (F_z - F_z0) / F_z0;  F_z >= 1 N
    """
    load = maximum(load, MINIMUM_LOAD)
    peak = magic_formula_peak(load, tyre)
    stiffness_factor = magic_formula_stiffness(load, tyre) / (tyre.p_cy1 * tyre.lambda_cy * peak)
    return stiffness_factor, peak, tyre.p_ey1 + tyre.p_ey2 * (load / tyre.nominal_load - 1.0)


def magic_formula_force(slip, stiffness_factor, peak, curvature, tyre: MagicFormula):
    """F_y = D sin(C atan(B a - min(E (1 - p_ey3 sgn a), 1) (B a - atan(B a)))) [N], a = slip angle [rad].

    Without the limit of 1, the curve would bend back (Pacejka, Tire and Vehicle Dynamics, eq. 4.E24).
    C = p_cy1 lambda_cy; B, D, E from `magic_formula_coefficients`; for an axle, twice D. With p_ky1 < 0 the force
    opposes the slip angle. Source: paper, appendix. Checked by: test_tyres.py.
    """
    x = stiffness_factor * slip
    e = minimum(curvature * (1.0 - tyre.p_ey3 * sign(slip)), 1.0)
    return peak * sin(tyre.p_cy1 * tyre.lambda_cy * atan(x - e * (x - atan(x))))


def tyre_force(slip, load, tyre: MagicFormula):
    """F_y [N] of one tyre at a slip angle [rad] and load [N]."""
    b, d, e = magic_formula_coefficients(load, tyre)
    return magic_formula_force(slip, b, d, e, tyre)


def stiffness_scale(cornering_stiffness: float, static_load: float, tyre: MagicFormula) -> float:
    """lambda_ky = C / (2 |K|) [1], K at lambda_ky = 1 and the static load of ONE tyre [N]; C of the AXLE [N/rad].
    Source: paper, lambda_Ky. Leaf: 0.423 front, 0.962 rear (paper: 0.959). Checked by: test_tyres.py."""
    return cornering_stiffness / (2.0 * abs(magic_formula_stiffness(static_load, tyre._replace(lambda_ky=1.0))))
