"""A position that velocity knows nothing of: the displacement between two samples against integrated velocity.

    d = p_k - p_{k-1} - dt (v_{k-1} + v_k) / 2,   v = R(yaw) (v_x, v_y)

RTK lost and found again, another unit on the wire, an origin that was set anew: |d| is then a step, while noise and
what the trapezoid leaves out stay within `allowed`. Checked by: test_position_jumps.py.
"""

import math
from collections.abc import Sequence

from .filtering import NANOSECOND

# Positions with RTK have 2 cm of noise, those of an INS far less from sample to sample; what is above is no noise [m].
LEAST = 0.3
# Of the way driven: scale of the velocity, a heading that is askew.
SHARE = 0.1
# Nothing on tyres accelerates harder [m/s^2]: what the trapezoid can be wrong by over a longer time.
ACCELERATION = 10.0
# After a longer silence a car may be anywhere [s].
LONGEST = 10.0
# Positions may be noisier than RTK's: a jump stands out from the median of the steps before it, of this many at most
# and at least ...
NOISE_STEPS, FEWEST_STEPS, NOISE_FACTOR = 20, 5, 6.0
# ... unless it is so large that noise is no excuse [m].
NO_NOISE = 5.0

X, Y, YAW, VELOCITY_X, VELOCITY_Y = range(5)  # places in a row of alignment.INS_COLUMNS


def excess(spacing: float, before: Sequence[float], after: Sequence[float]) -> float:
    """|d| [m] where it is more than allowed, else 0. spacing: dt [s], > 0. Rows begin with x, y, yaw, v_x, v_y."""
    size, driven = _step(spacing, before, after)
    allowed = LEAST + SHARE * driven + 0.25 * ACCELERATION * spacing**2
    return size if size > allowed and spacing <= LONGEST else 0.0


def stands_out(size: float, times_ns: Sequence[int], rows: Sequence[Sequence[float]]) -> bool:
    """Whether a step of `size` [m] is none of the noise in the samples before it, which end with the one it left."""
    if size > NO_NOISE:
        return True
    if len(times_ns) <= FEWEST_STEPS:
        return False
    usual = sorted(_step((times_ns[i] - times_ns[i - 1]) * NANOSECOND, rows[i - 1], rows[i])[0]
                   for i in range(max(1, len(times_ns) - NOISE_STEPS), len(times_ns)))
    return size > NOISE_FACTOR * usual[len(usual) // 2]


def _step(spacing: float, before: Sequence[float], after: Sequence[float]) -> tuple[float, float]:
    """(|d|, way driven) [m]."""
    east = north = 0.0
    for row in (before, after):
        cosine, sine = math.cos(row[YAW]), math.sin(row[YAW])
        east += 0.5 * spacing * (cosine * row[VELOCITY_X] - sine * row[VELOCITY_Y])
        north += 0.5 * spacing * (sine * row[VELOCITY_X] + cosine * row[VELOCITY_Y])
    return math.hypot(after[X] - before[X] - east, after[Y] - before[Y] - north), math.hypot(east, north)
