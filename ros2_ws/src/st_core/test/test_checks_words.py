"""What a finding says is understood at first reading: a side instead of a sign, and what it may come from."""

from dataclasses import replace

import pytest
from exact_drive import Sines, exact_drive
from exact_faults import mounted, plus, times
from st_core.checks import check
from st_core.checks.across_runs import across_runs

WINDING = Sines(0.05, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7)))  # goes all ways round


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, 90.0, turning=WINDING)


def said(log, name, car=None):
    return next(one.text for one in check(log, car).findings if one.name == name)


@pytest.mark.parametrize(("shear", "verb"), [(0.03, "grows"), (-0.03, "shrinks")])
def test_a_sheared_map(log, shear, verb):
    text = said(replace(log, x=log.x + shear * log.y), "map_shear")
    assert text.startswith(f"x {verb} by 0.0") and "for each metre north" in text


def test_a_spherical_earth(log):
    assert said(times(0.997, "x")(log), "x_scale").endswith("projected on a spherical earth?")


@pytest.mark.parametrize(("bias", "side"), [(0.6, "high"), (-0.6, "low")])
def test_an_accelerometer_that_leans(log, bias, side):
    text = said(plus(bias, "acceleration_y")(log), "acceleration_y_bias")
    assert text.endswith(f"too {side} against velocity and yaw rate: mounted askew, or the road is not level?")


def test_a_point_at_the_rear_axle_is_called_so_and_another_is_not(leaf, log):
    rear = -(leaf.cg_to_rear_axle + leaf.cg_to_ins_x)
    assert said(mounted(rear)(log), "measuring_point", leaf).endswith(": at the rear axle?")
    assert "rear axle" not in said(mounted(rear + 0.7)(log), "measuring_point", leaf)


def test_what_differs_between_runs_may_be_a_fault_of_some(leaf, log):
    runs = [check(one, leaf) for one in (log, mounted(-1.5)(log), mounted(-1.5)(log))]
    text = next(one.text for one in across_runs(runs) if one.name == "measuring_point")
    assert text.endswith("the load or the day, or to a fault of some of the runs")


def test_what_no_prediction_depends_on_is_not_the_gravest(leaf, log):
    findings = check(plus(0.6, "acceleration_y")(times(0.97, "x")(log)), leaf).findings
    assert [one.name for one in findings if one.severity == "warning"] == ["x_scale", "acceleration_y_bias"]
