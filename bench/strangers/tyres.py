"""Tyre models of the strangers benchmark: lateral force of one tyre, compiled.

Slip angle positive when the wheel slides to its left; forces positive to the left. No code is shared with the project.
"""

import math

import numpy as np
from numba import njit

from .vehicles import BRUSH, BURCKHARDT, DUGOFF, FIALA, TABLE, TMEASY, TOURING

TABLE_SLIP = np.radians([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 16.0, 24.0])
TABLE_LOAD = np.array([0.25, 0.6, 1.0, 1.4, 1.9])
"""Load over static load [1]."""
TABLE_FORCE = np.array([
    [0.0, 0.150, 0.293, 0.424, 0.540, 0.724, 0.847, 0.925, 0.985, 1.000, 0.985, 0.955, 0.890, 0.800],
    [0.0, 0.136, 0.268, 0.390, 0.500, 0.680, 0.808, 0.894, 0.965, 0.990, 0.988, 0.962, 0.900, 0.812],
    [0.0, 0.119, 0.235, 0.345, 0.446, 0.618, 0.748, 0.842, 0.926, 0.965, 0.975, 0.956, 0.900, 0.815],
    [0.0, 0.101, 0.200, 0.296, 0.386, 0.546, 0.675, 0.774, 0.872, 0.926, 0.950, 0.940, 0.892, 0.812],
    [0.0, 0.082, 0.163, 0.242, 0.318, 0.458, 0.580, 0.680, 0.790, 0.860, 0.905, 0.908, 0.872, 0.800]])
"""Lateral force over grip times load, by load and slip: typical of flat-belt measurements of car tyres."""
TABLE_SLOPE = TABLE_FORCE[2, 1] / TABLE_SLIP[1]


@njit(cache=True)
def tabulated(slip, stretch, load_ratio):
    """Force over grip times load, interpolated linearly in slip angle and load; stretch: factor on the slip angle."""
    a = min(abs(slip) * stretch, TABLE_SLIP[-1] - 1e-9)
    x = min(max(load_ratio, TABLE_LOAD[0]), TABLE_LOAD[-1] - 1e-9)
    i = np.searchsorted(TABLE_SLIP, a, side="right") - 1
    j = np.searchsorted(TABLE_LOAD, x, side="right") - 1
    u = (a - TABLE_SLIP[i]) / (TABLE_SLIP[i + 1] - TABLE_SLIP[i])
    v = (x - TABLE_LOAD[j]) / (TABLE_LOAD[j + 1] - TABLE_LOAD[j])
    low = TABLE_FORCE[j, i] * (1 - u) + TABLE_FORCE[j, i + 1] * u
    high = TABLE_FORCE[j + 1, i] * (1 - u) + TABLE_FORCE[j + 1, i + 1] * u
    return low * (1 - v) + high * v


@njit(cache=True)
def tmeasy(t, slope, peak):
    """Force [N] at lateral slip t = tan(alpha) >= 0. slope: at t = 0 [N]; peak [N]; from three times the slip of the
    peak on, the force is constant."""
    at_peak = 2.2 * peak / slope
    if t <= at_peak:
        s = t / at_peak
        return at_peak * slope * s / (1 + s * (s + at_peak * slope / peak - 2))
    if t < 3 * at_peak:
        s = (t - at_peak) / (2 * at_peak)
        return peak * (1 - 0.15 * s * s * (3 - 2 * s))
    return 0.85 * peak


@njit(cache=True)
def brush(t, stiffness, grip, sliding, load):
    """Force [N] at t = |tan(alpha)| with parabolic pressure. Friction: grip of adhesion, sliding * grip of sliding."""
    limit = grip * load
    if t >= 3 * limit / stiffness:
        return sliding * limit
    x = stiffness * t
    return x - x * x / (3 * limit) * (2 - sliding) + x**3 / (9 * limit * limit) * (1 - 2 * sliding / 3)


@njit(cache=True)
def side_force(kind, slip, stiffness, load, longitudinal, grip, sliding, load_ratio):
    """Lateral force of one tyre [N]. longitudinal: its drive or brake force [N]; load_ratio: over static load."""
    limit = grip * load
    if kind == DUGOFF:
        tangent = math.tan(slip)
        ratio = limit / (2 * math.hypot(longitudinal, stiffness * tangent) + 1e-9)
        return -stiffness * tangent * (ratio * (2 - ratio) if ratio < 1 else 1.0)
    available = math.sqrt(max(limit * limit - longitudinal * longitudinal, 0.01 * limit * limit))
    if kind == BURCKHARDT:
        s = math.sin(abs(slip))
        return -math.copysign(available * (1.02 * (1 - math.exp(-stiffness / limit * 1.05 * s)) - 0.1 * s), slip)
    tangent = math.tan(slip)
    if kind == FIALA:
        if abs(tangent) >= 3 * available / stiffness:
            return -math.copysign(available, slip)
        scaled = stiffness * tangent
        return -scaled + scaled * abs(scaled) / (3 * available) - scaled**3 / (27 * available * available)
    reduced = available / limit
    if kind == BRUSH:
        return -math.copysign(brush(abs(tangent), stiffness, grip * reduced, sliding, load), slip)
    if kind == TMEASY:
        return -math.copysign(tmeasy(abs(tangent), stiffness, available), slip)
    if kind == TABLE:
        stretch = stiffness * load_ratio / (limit * TABLE_SLOPE)
        return -math.copysign(available * tabulated(slip, stretch, load_ratio), slip)
    return 0.0


MAGIC_1994 = np.array([  # by tyre: a0 to a12, b3 to b5, gy1, gy2 [kN, deg]
    [1.55, -55.0, 1450.0, 1900.0, 7.2, 0.014, -0.24, 1.0, -0.03, -0.0013, -0.15, -8.5, -0.29, 23.3, 410.0, 0.075, 11.14,
     10.14],
    [1.6, -38.0, 1201.0, 1914.0, 8.7, 0.014, -0.24, 1.0, -0.03, -0.0013, -0.15, -8.5, -0.29, 23.3, 300.0, 0.0, 11.14,
     10.14]])
"""Coefficients of tyre files of VDrift, TOURING and S2000."""


@njit(cache=True)
def magic_slope(kind, load):
    """Cornering stiffness of one tyre without camber [N/rad], a3 sin(2 atan(F_z / a4))."""
    a = MAGIC_1994[int(kind) - TOURING]
    return a[3] * math.sin(2 * math.atan(load / 1000 / a[4])) * 180 / math.pi


@njit(cache=True)
def magic_1994(kind, slip, lean, load, longitudinal, scale, grip):
    """Lateral force of one tyre [N]. lean: of the wheel to the left [rad]; longitudinal: its drive or brake force [N];
    scale: factor on the cornering stiffness.

        F = -(D sin(C atan(B S - E (B S - atan(B S)))) + S_v) G,  S = alpha + S_h,  B C D = slope
    """
    a = MAGIC_1994[int(kind) - TOURING]
    z, tilt = min(load / 1000, 30.0), math.degrees(lean)
    peak = grip * (a[1] * z + a[2]) * z
    slope = scale * a[3] * math.sin(2 * math.atan(z / a[4])) * (1 - a[5] * abs(tilt))
    bs = slope / (a[0] * peak) * (math.degrees(slip) + a[8] * tilt + a[9] * z + a[10])
    curved = bs - (a[6] * z + a[7]) * (bs - math.atan(bs))
    kappa = longitudinal / (100 * (a[13] * z + a[14]) * z * math.exp(-a[15] * z))
    c = 1 + (a[17] * slip) ** 2
    combined = math.sqrt(c / (c + (a[16] * kappa) ** 2))
    return -combined * (peak * math.sin(a[0] * math.atan(curved)) + grip * (a[11] * z + a[12]) * tilt * z)
