"""Elementary functions for the equations of motion, for every number type.

They use `math` for Python floats and numpy for numpy arrays and scalars. Symbolic types are added with `register`;
compiled code has its own versions (`numba_lanes`). A float outside the domain of a function gives NaN, as in numpy.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

_NUMPY: dict[str, Callable] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "atan": np.arctan, "sqrt": np.sqrt, "sign": np.sign,
    "absolute": np.abs, "maximum": np.maximum, "minimum": np.minimum}
NAMES = tuple(_NUMPY)
_registered: dict[type, Mapping[str, Callable]] = {}


def register(number_type: type, functions: Mapping[str, Callable]) -> None:
    """Register the functions of an additional number type. Raises KeyError if one of NAMES is missing."""
    _registered[number_type] = {name: functions[name] for name in NAMES}


def _call_registered(name: str, *arguments: Any):
    for argument in arguments:
        functions = _registered.get(type(argument))
        if functions is not None:
            return functions[name](*arguments)
    return _NUMPY[name](*arguments)


def _make_function(name: str) -> Callable:
    """The function with this name for every number type; NaN where the function of `math` has a domain error."""
    math_function, nan = getattr(math, name), math.nan

    def function(x):
        if type(x) is float:
            try:
                return math_function(x)
            except ValueError:
                return nan
        return _call_registered(name, x)
    return function


sin, cos, tan, atan, sqrt = map(_make_function, ("sin", "cos", "tan", "atan", "sqrt"))  # angles in rad


def sign(x):
    """-1, 0 or 1; NaN if x is NaN."""
    if type(x) is float:
        return 1.0 if x > 0.0 else -1.0 if x < 0.0 else x
    return _call_registered("sign", x)


def absolute(x):
    """Absolute value."""
    if type(x) is float:
        return -x if x < 0.0 else x
    return _call_registered("absolute", x)


def maximum(x, limit):
    """The larger of x and a number `limit`; NaN if x is NaN, but `limit` with CasADi."""
    if type(x) is float:
        return limit if x < limit else x
    return _call_registered("maximum", x, limit)


def minimum(x, limit):
    """The smaller of x and a number `limit`; NaN if x is NaN, but `limit` with CasADi."""
    if type(x) is float:
        return limit if x > limit else x
    return _call_registered("minimum", x, limit)
