"""The functions of `st_core.ops` for numba, without branches, so that a loop over lanes can be vectorised.

Sine, cosine: x = n pi/2 + r with |r| <= pi/4. pi/2 is split into two parts, the first with 33 bits, so that n times it
is exact up to |n| = 2^20 or 1.6e6 rad. Arc tangent: in each of four ranges atan x = base + atan t with one division and
|t| <= tan(pi/12). The polynomials interpolate at Chebyshev nodes in r^2 or t^2, with relative errors < 6e-17. They are
evaluated by Estrin's scheme, since the longest chain of operations limits the speed. The arc tangent of an infinite
number is NaN here. Checked by: test_backends.py.
"""

import math
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic, overload

from .. import ops

# LLVM fast-math flags, without nnan and ninf, because NaN in a log must give NaN. Callees do not inherit them.
FLAGS = ("contract", "nsz", "arcp")
OPTIONS: Any = {"fastmath": set(FLAGS), "error_model": "numpy", "forceinline": True, "no_cfunc_wrapper": True}

SIGN = np.int64(-(2**63))  # mask of the sign bit
MAGNITUDE = np.int64(2**63 - 1)  # mask of the other bits
ONE = np.int64(0x3FF0000000000000)  # bits of 1.0

ROUND = 1.5 * 2.0**52  # after adding it, the low bits are the nearest integer
TWO_OVER_PI = 0.6366197723675814
HALF_PI_HIGH, HALF_PI_LOW = 1.5707963267341256, 6.077100506506192e-11

# Coefficients of the polynomials: S of the sine, C of the cosine, A of the arc tangent.
S1, S2, S3 = -0.16666666666666666, 0.008333333333330905, -0.00019841269836710015
S4, S5, S6 = 2.755731608182638e-06, -2.5051128069891774e-08, 1.591788278413412e-10
C1, C2, C3 = 0.04166666666666657, -0.0013888888888865072, 2.4801587282473078e-05
C4, C5, C6 = -2.755731205923296e-07, 2.087538637959625e-09, -1.1341301033703834e-11

A1, A2, A3, A4 = -0.3333333333333324, 0.1999999999984203, -0.14285714239428257, 0.11111105932082634
A5, A6, A7, A8 = -0.09090623565675247, 0.0768371258882859, -0.06521798362425968, 0.04577471134842663
LOW, HIGH = 0.2679491924311227, 3.732050807568877  # tan(pi/12), 1 / tan(pi/12)
TAN_PI_6 = 0.5773502691896257
PI_6, PI_3, HALF_PI = 0.5235987755982989, 1.0471975511965979, 1.5707963267948966


def inline(function, implementation=None):
    """Register a plain function, or its implementation, for compiled code, inlined at every call; returns it."""
    @overload(function, jit_options=OPTIONS, strict=False)
    def implement(*args, **kwargs):
        return implementation or function
    return function


@intrinsic
def _to_bits(_, x):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.int64))
    return types.int64(types.float64), generate


@intrinsic
def _from_bits(_, x):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float64))
    return types.float64(types.int64), generate


@inline
def _sine_cosine(x):
    """Sine and cosine of r, and an integer with n in its low bits. Two calls with the same x are computed once."""
    shifted = x * TWO_OVER_PI + ROUND
    n = shifted - ROUND
    r = (x - n * HALF_PI_HIGH) - n * HALF_PI_LOW
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    s = (S1 + z * S2) + z2 * (S3 + z * S4) + z4 * (S5 + z * S6)
    c = (C1 + z * C2) + z2 * (C3 + z * C4) + z4 * (C5 + z * C6)
    return r + r * z * s, (1.0 - 0.5 * z) + z2 * c, _to_bits(shifted)


def _sin(x):
    s, c, n = _sine_cosine(x)
    return _from_bits(_to_bits(c if n & 1 else s) ^ ((n & 2) << 62))


def _cos(x):
    s, c, n = _sine_cosine(x)
    return _from_bits(_to_bits(s if n & 1 else c) ^ (((n + 1) & 2) << 62))


def _atan(x):
    # The sign u = +-1 is applied from the start, since this does not lengthen the chain of operations.
    a = _from_bits(_to_bits(x) & MAGNITUDE)
    u = _from_bits((_to_bits(x) & SIGN) | ONE)
    below_one = a < 1.0
    middle = (a > LOW) & (a < HIGH)
    n = x if below_one else -u
    d = 1.0 if below_one else a
    c = -TAN_PI_6 if below_one else TAN_PI_6
    c = (c if middle else 0.0) * u
    near = PI_6 if below_one else PI_3
    far = 0.0 if below_one else HALF_PI
    base = (near if middle else far) * u
    t = (n + c * d) / (d - c * n)
    z = t * t
    z2 = z * z
    z4 = z2 * z2
    p = ((A1 + z * A2) + z2 * (A3 + z * A4)) + z4 * ((A5 + z * A6) + z2 * (A7 + z * A8))
    return (base + t) + t * z * p


for _function, _compiled in {
        ops.sin: _sin, ops.cos: _cos, ops.tan: lambda x: ops.sin(x) / ops.cos(x), ops.atan: _atan,
        ops.sqrt: lambda x: math.sqrt(x),  # noqa: PLW0108  # numba needs a Python function
        ops.sign: lambda x: 1.0 if x > 0.0 else -1.0 if x < 0.0 else x,
        ops.absolute: lambda x: _from_bits(_to_bits(x) & MAGNITUDE),
        ops.maximum: lambda x, limit: limit if x < limit else x,
        ops.minimum: lambda x, limit: limit if x > limit else x}.items():
    inline(_function, _compiled)
