"""Classical Runge-Kutta integration with a fixed step, for states as tuples of floats or of arrays of equal shape.

`derivative(state, w, p)` returns the time derivative of the state for the inputs w at one instant and constants p.
"""

from collections.abc import Callable, Sequence
from typing import Any

Derivative = Callable[[tuple, Any, Any], tuple]


def rk4(derivative: Derivative, state: tuple, grid: Sequence[Any], p: Any, step: float) -> list[tuple]:
    """States at 0, step, 2 step, ..., the start included: (len(grid) - 1) / 2 steps.

    grid: w at 0, step/2, step, ... (2 * steps + 1). step > 0. Global error O(step^4). Checked by: test_integrate.py.
    """
    advance = _rk4_step_six_states if len(state) == 6 else rk4_step
    states = [state]
    for k in range(0, len(grid) - 2, 2):
        state = advance(derivative, state, grid[k], grid[k + 1], grid[k + 2], p, step)
        states.append(state)
    return states


def rk4_step(derivative: Derivative, state: tuple, w_start: Any, w_middle: Any, w_end: Any, p: Any, step: Any) -> tuple:
    """The state after one step; w at its start, middle and end. Any number of states."""
    half, sixth = 0.5 * step, step / 6.0
    a = derivative(state, w_start, p)
    b = derivative(tuple([s + half * d for s, d in zip(state, a, strict=True)]), w_middle, p)
    c = derivative(tuple([s + half * d for s, d in zip(state, b, strict=True)]), w_middle, p)
    d = derivative(tuple([s + step * d for s, d in zip(state, c, strict=True)]), w_end, p)
    return tuple([s + sixth * (i + 2.0 * (j + k) + m) for s, i, j, k, m in zip(state, a, b, c, d, strict=True)])


def _rk4_step_six_states(derivative: Derivative, state: tuple, w_start: Any, w_middle: Any, w_end: Any, p: Any,
                 step: float) -> tuple:
    # rk4_step written out for six states: twice as fast on floats, which the live predictor uses without numba.
    half, sixth = 0.5 * step, step / 6.0
    s0, s1, s2, s3, s4, s5 = state
    a0, a1, a2, a3, a4, a5 = derivative(state, w_start, p)
    b0, b1, b2, b3, b4, b5 = derivative(
        (s0 + half * a0, s1 + half * a1, s2 + half * a2, s3 + half * a3, s4 + half * a4, s5 + half * a5), w_middle, p)
    c0, c1, c2, c3, c4, c5 = derivative(
        (s0 + half * b0, s1 + half * b1, s2 + half * b2, s3 + half * b3, s4 + half * b4, s5 + half * b5), w_middle, p)
    d0, d1, d2, d3, d4, d5 = derivative(
        (s0 + step * c0, s1 + step * c1, s2 + step * c2, s3 + step * c3, s4 + step * c4, s5 + step * c5), w_end, p)
    return (s0 + sixth * (a0 + 2.0 * (b0 + c0) + d0), s1 + sixth * (a1 + 2.0 * (b1 + c1) + d1),
            s2 + sixth * (a2 + 2.0 * (b2 + c2) + d2), s3 + sixth * (a3 + 2.0 * (b3 + c3) + d3),
            s4 + sixth * (a4 + 2.0 * (b4 + c4) + d4), s5 + sixth * (a5 + 2.0 * (b5 + c5) + d5))
