"""Elementary functions: equal on floats and arrays, NaN propagates, other number types can be registered."""

import math

import numpy as np
import pytest
from st_core import ops

VALUES = [-math.inf, -7.0, -1.0, -0.0, 0.0, 0.3, 2.0, 1.0e6, math.inf, math.nan]


@pytest.mark.parametrize("name", ops.NAMES)
def test_floats_and_arrays_give_equal_results(name):
    function = getattr(ops, name)
    limit = [0.5] if name in ("maximum", "minimum") else []
    with np.errstate(invalid="ignore"):
        batch = function(np.array(VALUES), *limit)
    single = [function(v, *limit) for v in VALUES]
    assert all(type(s) is float for s in single)
    np.testing.assert_allclose(single, batch, rtol=1e-15)


@pytest.mark.parametrize("name", ["sin", "cos"])
@pytest.mark.parametrize("size", [3.0, 1.0e4, 1.0e9])
def test_sine_and_cosine_of_long_arrays_are_exact_to_rounding(name, size):
    special = [0.0, math.pi, -math.pi, math.pi / 2]
    angles = np.concatenate([np.random.default_rng(3).uniform(-size, size, 5000), special])
    function = getattr(ops, name)
    np.testing.assert_allclose(function(angles), [function(a) for a in angles.tolist()], rtol=0, atol=3e-16)
    with np.errstate(invalid="ignore"):
        assert np.isnan(function(np.full(1000, math.nan))).all() and np.isnan(function(np.full(1000, math.inf))).all()


class OtherNumber:
    """A number type that is not registered."""

    def __init__(self, value):
        self.value = value


def test_other_number_types_can_be_registered():
    ops.register(OtherNumber, {name: lambda *a, name=name: (name, a[0].value) for name in ops.NAMES})
    assert ops.atan(OtherNumber(3)) == ("atan", 3)
    assert ops.maximum(OtherNumber(3), 1.0) == ("maximum", 3)
    with pytest.raises(KeyError, match="minimum"):
        ops.register(OtherNumber, {name: abs for name in ops.NAMES if name != "minimum"})
