"""Elementary functions for the equations of motion, for every number type.

They use `math` for Python floats and numpy for its arrays and scalars. Symbolic types are added with `register`; numba
has its own versions (`numba_lanes`). On floats no function raises: outside its domain the result is NaN, as in numpy.
"""

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

# numpy computes sines and cosines one by one in the C library, 12 ns each, but vectorises tangents on newer x86, 1 ns.
# Sine and cosine from t = tan(x / 2) have an absolute error of 2.3e-16 for any x. For arrays with fewer elements than
# _VECTOR_SIZE, the additional calls take longer than they save.
_VECTOR_SIZE = 256


@cache
def _has_vector_tangent() -> bool:
    try:
        from numpy.lib import introspect
    except ImportError:  # numpy before 2.1
        return False
    signatures = introspect.opt_func_info(func_name="^tan$", signature="float64").get("tan", {})
    return any(not kind.get("current", "baseline").startswith("baseline") for kind in signatures.values())


def _array_sin(x):
    if np.size(x) < _VECTOR_SIZE or not _has_vector_tangent():
        return np.sin(x)
    t = np.tan(0.5 * x)
    return 2.0 * t / (1.0 + t * t)


def _array_cos(x):
    if np.size(x) < _VECTOR_SIZE or not _has_vector_tangent():
        return np.cos(x)
    t = np.tan(0.5 * x)
    t = t * t
    return (1.0 - t) / (1.0 + t)


_NUMPY: dict[str, Callable] = {
    "sin": _array_sin, "cos": _array_cos, "tan": np.tan, "atan": np.arctan, "sqrt": np.sqrt, "sign": np.sign,
    "absolute": np.abs, "maximum": np.maximum, "minimum": np.minimum}
NAMES = tuple(_NUMPY)
_registered: dict[type, Mapping[str, Callable]] = {}


def register(kind: type, functions: Mapping[str, Callable]) -> None:
    """Register the functions of an additional number type. Raises KeyError if one of NAMES is missing."""
    for name in NAMES:
        functions[name]
    _registered[kind] = functions


def _call_registered(name: str, *arguments: Any):
    for argument in arguments:
        functions = _registered.get(type(argument))
        if functions is not None:
            return functions[name](*arguments)
    return _NUMPY[name](*arguments)


def _make_function(name: str) -> Callable:
    """The function of this name for every number type; NaN where the function of `math` has a domain error."""
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
