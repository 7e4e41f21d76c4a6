"""Jumps of the position: displacement between two samples that is not explained by integrated velocity.

    d = p_k - p_{k-1} - dt (v_{k-1} + v_k) / 2,   v = R(yaw) (v_x, v_y)

RTK lost and found again, another unit on the network, a new origin: |d| is then a step, while noise and the error
of the trapezoid rule stay within `allowed`. Checked by: test_position_jumps.py.
"""

import math
from collections.abc import Sequence

from .filtering import NANOSECOND

# Positions with RTK have 2 cm of noise, those of an INS far less from sample to sample; a larger step is not noise [m].
LEAST = 0.3
# Share of the distance driven: scale of the velocity, a heading error.
SHARE = 0.1
# Largest acceleration on tyres [m/s^2]: bounds the error of the trapezoid rule over longer steps.
ACCELERATION = 10.0
# Longer gaps are not judged, since the car may be anywhere [s].
LONGEST = 10.0
# Positions may be noisier than RTK's: a jump exceeds NOISE_FACTOR times the median of the previous steps, at most and
# at least of this many, ...
NOISE_STEPS, FEWEST_STEPS, NOISE_FACTOR = 20, 5, 6.0
# ... or is larger than any noise [m].
NO_NOISE = 5.0

X, Y, YAW, VELOCITY_X, VELOCITY_Y = range(5)  # places in a row of alignment.INS_COLUMNS


def excess(spacing: float, before: Sequence[float], after: Sequence[float]) -> float:
    """|d| [m] where it is more than allowed, else 0. spacing: dt [s], > 0. Rows begin with x, y, yaw, v_x, v_y."""
    size, driven = _step(spacing, before, after)
    allowed = LEAST + SHARE * driven + 0.25 * ACCELERATION * spacing**2
    return size if size > allowed and spacing <= LONGEST else 0.0


def exceeds_noise(size: float, times_ns: Sequence[int], rows: Sequence[Sequence[float]]) -> bool:
    """Whether a step of `size` [m] is larger than the noise of the samples before it; the last is where it started."""
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
