"""The vocabulary: the same answers on floats and arrays, NaN through, nothing raised, other numbers by registration."""

import math

import numpy as np
import pytest
from st_core import ops

VALUES = [-math.inf, -7.0, -1.0, -0.0, 0.0, 0.3, 2.0, 1.0e6, math.inf, math.nan]


@pytest.mark.parametrize("name", ops.NAMES)
def test_float_and_array_agree(name):
    function = getattr(ops, name)
    limit = [0.5] if name in ("maximum", "minimum") else []
    with np.errstate(invalid="ignore"):
        batch = function(np.array(VALUES), *limit)
    single = [function(v, *limit) for v in VALUES]
    assert all(type(s) is float for s in single)
    np.testing.assert_allclose(single, batch, rtol=1e-15)


class Wrapped:
    """A kind of number nothing here knows."""

    def __init__(self, value):
        self.value = value


def test_other_kinds_of_number_are_registered_from_outside():
    ops.register(Wrapped, {name: lambda *a, name=name: (name, a[0].value) for name in ops.NAMES})
    assert ops.atan(Wrapped(3)) == ("atan", 3)
    assert ops.maximum(Wrapped(3), 1.0) == ("maximum", 3)
    with pytest.raises(KeyError, match="minimum"):
        ops.register(Wrapped, {name: abs for name in ops.NAMES if name != "minimum"})
