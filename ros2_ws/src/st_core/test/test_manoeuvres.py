"""Manoeuvres have the stated directions, speeds, lateral accelerations, frequencies and paths."""

import math
from dataclasses import replace

import numpy as np
import pytest
from st_core import manoeuvres
from st_core.manoeuvres import CATALOGUE, Manoeuvre, PiecewiseLinear, SineSweep

DT = 0.005
BY_NAME = {m.name: m for m in CATALOGUE}


def times(manoeuvre: Manoeuvre) -> np.ndarray:
    return DT * np.arange(round(manoeuvre.period / DT))


def path(manoeuvre: Manoeuvre) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y [m] and heading [rad] at constant initial speed over one period."""
    step = manoeuvre.speed * DT
    heading = np.cumsum(manoeuvre.curvature(times(manoeuvre) + DT / 2)) * step
    middle = heading - np.diff(heading, prepend=0.0) / 2
    return np.cumsum(np.cos(middle)) * step, np.cumsum(np.sin(middle)) * step, heading


@pytest.mark.parametrize("m", CATALOGUE, ids=[m.name for m in CATALOGUE])
def test_manoeuvre_is_periodic_and_consistent(m):
    t = times(m)
    assert np.abs(m.curvature(t)).max() * m.speed**2 == pytest.approx(abs(m.lateral_acceleration), rel=0.01)
    # The next period is equal and starts at the same speed.
    np.testing.assert_allclose(m.curvature(t + m.period), m.curvature(t), atol=0.003)
    assert m.speed_at(m.period - 1e-9) == pytest.approx(m.speed)
    # Speed is the integral of the acceleration.
    integrated = m.speed + np.cumsum(m.acceleration_at(t)) * DT
    np.testing.assert_allclose(integrated, m.speed_at(t + DT), atol=0.05)
    # Long enough for predictions of 5 s, short enough to be driven three times.
    assert 20.0 <= m.duration <= 70.0 and m.duration == m.repetitions * m.period
    assert m.description


def test_names_in_the_catalogue_are_unique():
    assert len(BY_NAME) == len(CATALOGUE)


def test_lateral_acceleration_does_not_depend_on_the_car():
    """Steady cornering of the linear car: a_y = v^2 delta / (L + K v^2)."""
    m = BY_NAME["step"]
    for wheelbase, understeer in ((2.4, 0.0), (2.7, 0.004), (3.3, 0.008)):
        angle = m.steering(5.0, wheelbase, understeer)
        assert m.speed**2 * angle / (wheelbase + understeer * m.speed**2) == pytest.approx(m.lateral_acceleration)


def test_negative_lateral_acceleration_mirrors_the_manoeuvre():
    for m in CATALOGUE:
        mirrored = replace(m, lateral_acceleration=-m.lateral_acceleration)
        np.testing.assert_array_equal(mirrored.curvature(times(m)), -m.curvature(times(m)))
    left, right = manoeuvres.lane_change(12.0, 4.0), manoeuvres.lane_change(12.0, -4.0)
    assert left.period == right.period
    assert manoeuvres.brake_in_turn(10.0, -4.0).speed_at(9.0) == manoeuvres.brake_in_turn(10.0, 4.0).speed_at(9.0)


@pytest.mark.parametrize("name", ["step", "ramp_to_limit", "slalom", "weave", "circle", "S1"])
def test_manoeuvre_turns_equally_to_both_sides(name):
    m = BY_NAME[name]
    assert m.curvature(times(m)).mean() * m.speed**2 == pytest.approx(0.0, abs=0.06)


def test_piecewise_linear_and_sine_sweep():
    lines = PiecewiseLinear(((1.0, 0.0, 2.0), (0.0, 5.0, 5.0), (2.0, 1.0, 1.0)))
    np.testing.assert_allclose(lines(np.array([0.0, 0.5, 0.999999, 1.0, 2.9, 3.0, 9.0])),
                               [0.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0], atol=1e-5)
    assert lines.duration == 3.0
    t = np.arange(0.0, 9.0, 0.001)
    steady, rising = SineSweep(0.5, 0.5, 8.0)(t), SineSweep(0.2, 2.8, 8.0)(t)
    np.testing.assert_allclose(steady[t < 8.0], np.sin(np.pi * t[t < 8.0]), atol=1e-9)
    assert not steady[t >= 8.0].any() and not rising[t >= 8.0].any()
    crossings = t[1:][np.diff(np.sign(rising)) != 0]
    assert 0.2 < 0.5 / np.diff(crossings)[0] < 0.4 and 0.5 / np.diff(crossings)[-2] == pytest.approx(2.8, rel=0.15)


def test_braking_ends_at_the_given_speed_and_driving_restores_the_initial_one():
    m = manoeuvres.brake_in_turn(11.0, 4.0, cruise_time=2.0, deceleration=4.0, end_speed=3.0, acceleration=2.0,
                                 acceleration_time=6.0)
    assert m.period == 10.0
    np.testing.assert_allclose(m.speed_at(np.array([0.0, 2.0, 3.0, 4.0, 5.0, 8.0, 9.9])), [11, 11, 7, 3, 5, 11, 11])
    np.testing.assert_allclose(m.acceleration_at(np.array([1.0, 2.1, 3.9, 4.1, 7.9, 8.1])), [0, -4, -4, 2, 2, 0],
                               atol=1e-9)
    short = manoeuvres.brake_in_turn(11.0, 4.0, 2.0, 4.0, 5.4, 2.5, 1.6)
    assert short.speed_at(short.period - 1e-9) == pytest.approx(9.4)


def test_lane_change_is_one_lane_wide_and_returns():
    _, y, heading = path(BY_NAME["lane_change"])
    assert y.max() == pytest.approx(3.5, rel=0.03)
    assert y[-1] == pytest.approx(0.0, abs=0.01) and heading[-1] == pytest.approx(0.0, abs=1e-3)


def test_there_and_back_drives_both_directions_and_is_closed():
    m = BY_NAME["there_and_back"]
    x, y, heading = path(m)
    straight = m.curvature(times(m)) == 0.0
    east, west = straight & (np.cos(heading) > 0.999), straight & (np.cos(heading) < -0.999)
    assert east.sum() * DT == pytest.approx(10.0, abs=0.1) and west.sum() * DT == pytest.approx(10.0, abs=0.1)
    assert math.hypot(x[-1], y[-1]) < 0.5 and heading[-1] == pytest.approx(2 * math.pi, abs=0.01)


def test_figure_eight_is_closed():
    x, y, heading = path(BY_NAME["S1"])
    assert math.hypot(x[-1], y[-1]) < 0.1 and heading[-1] == pytest.approx(0.0, abs=1e-3)
    assert np.ptp(heading) == pytest.approx(math.radians(240.0), abs=0.01)
