"""Checks of a single parameter; nodes that refuse to start test `declare` as a whole."""

import math

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from st_ros.parameters import ConfigurationError, Parameter

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(("default", "given", "expected"), [
    (1.0, 2, 2.0), (1.0, 2.5, 2.5), (1, 3, 3), (True, False, False), ("a", "b", "b"),
    ([], None, []), ([], ["x"], ["x"]), (["a"], ["b", "c"], ["b", "c"]), ([0.0], [1.0, 2.0], [1.0, 2.0]),
])
def test_value_is_converted_to_the_declared_type(default, given, expected) -> None:
    value = Parameter("p", default, "").check(given)
    assert value == expected
    assert type(value) is type(expected)


@pytest.mark.parametrize(("default", "given"), [
    (1.0, "fast"), (1.0, True), (1, 1.5), (1, True), ("a", 5), (["a"], "a"), (True, 1), (1.0, None),
])
def test_wrong_type_is_rejected(default, given) -> None:
    with pytest.raises(ConfigurationError, match=r"^p: "):
        Parameter("p", default, "").check(given)


def test_range_is_inclusive_and_reported_with_its_unit() -> None:
    parameter = Parameter("p", 1.0, "", "m/s", 0.5, 2.0)
    assert [parameter.check(v) for v in (0.5, 2.0)] == [0.5, 2.0]
    for value in (0.499, 2.001, math.inf, math.nan):
        with pytest.raises(ConfigurationError, match=r"outside 0\.5 to 2 m/s"):
            parameter.check(value)


def test_nan_default_means_not_set() -> None:
    parameter = Parameter("p", math.nan, "", "1", 1.0, 60.0)
    assert math.isnan(parameter.check(math.nan))
    with pytest.raises(ConfigurationError, match="outside 1 to 60"):
        parameter.check(0.0)


def test_value_outside_the_choices_is_rejected() -> None:
    parameter = Parameter("p", "a", "", choices=("a", "b"))
    assert parameter.check("b") == "b"
    with pytest.raises(ConfigurationError, match="one of a, b"):
        parameter.check("c")
