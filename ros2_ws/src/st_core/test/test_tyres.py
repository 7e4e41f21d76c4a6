"""Tyre forces: sign, initial slope, published stiffness scales, symmetry, limits."""

import math

import numpy as np
import pytest
from st_core import tyres
from st_core.tyres import magic_formula_coefficients, magic_formula_force, magic_formula_stiffness


def force(slip, load, tyre):
    return magic_formula_force(slip, *magic_formula_coefficients(load, tyre), tyre)


def test_stiffness_scales_of_the_paper(leaf):
    assert leaf.tyre_front.lambda_ky == pytest.approx(0.4231, abs=0.0005)
    # Published: 0.423 and 0.959; the published, rounded parameters give 0.962 for the rear.
    assert leaf.tyre_rear.lambda_ky == pytest.approx(0.9624, abs=0.0005)


def test_stiffness_scale_refers_to_the_static_load(leaf):
    at_nominal = tyres.stiffness_scale(leaf.cornering_stiffness_front, leaf.tyre_front.nominal_load, leaf.tyre_front)
    assert at_nominal == pytest.approx(0.426, abs=0.0005)
    assert abs(at_nominal - leaf.tyre_front.lambda_ky) > 0.002


def test_both_tyre_models_have_the_same_initial_slope(car):
    axles = ((car.tyre_front, car.static_tyre_load_front, car.cornering_stiffness_front),
             (car.tyre_rear, car.static_tyre_load_rear, car.cornering_stiffness_rear))
    for tyre, load, stiffness in axles:
        small = 1e-6
        slope = 2.0 * (force(small, load, tyre) - force(-small, load, tyre)) / (2.0 * small)
        assert slope == pytest.approx(-stiffness, rel=1e-6)
        assert 2.0 * magic_formula_stiffness(load, tyre) == pytest.approx(-stiffness, rel=1e-12)
        assert tyres.linear_force(small, stiffness) == pytest.approx(-stiffness * small)


@pytest.mark.parametrize("slip", [0.001, 0.02, 0.1, 0.5])
@pytest.mark.parametrize("load", [500.0, 3300.0, 4403.0, 7000.0])
def test_force_is_odd_and_opposes_the_slip(leaf, slip, load):
    for tyre in (leaf.tyre_front, leaf.tyre_rear):
        assert force(slip, load, tyre) < 0.0
        assert force(-slip, load, tyre) == -force(slip, load, tyre)


def test_force_stays_below_the_friction_limit(leaf):
    slip = np.linspace(-1.5, 1.5, 301)
    for load in (2000.0, 4250.0, 6000.0):
        tyre = leaf.tyre_front
        friction = tyre.p_dy1 + tyre.p_dy2 * (load - tyre.nominal_load) / tyre.nominal_load
        assert np.abs(force(slip, np.full_like(slip, load), tyre)).max() <= friction * load * (1.0 + 1e-12)


def test_asymmetric_curvature_depends_on_the_sign_of_the_slip(leaf):
    tyre = leaf.tyre_front._replace(p_ey3=0.5)
    b, d, e = magic_formula_coefficients(4250.0, tyre)
    for slip in (0.2, -0.2):
        x, curvature = b * slip, e * (1.0 - 0.5 * math.copysign(1.0, slip))
        expected = d * math.sin(tyre.p_cy1 * math.atan(x - curvature * (x - math.atan(x))))
        assert magic_formula_force(slip, b, d, e, tyre) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("load", [-5000.0, 0.0, 1e-9, 50.0, 40000.0])
def test_any_load_gives_a_finite_force(car, load):
    for tyre in (car.tyre_front, car.tyre_rear):
        assert math.isfinite(force(0.1, load, tyre))


@pytest.mark.parametrize("p_ey3", [-0.5, 0.0, 0.5])
def test_force_opposes_any_slip_angle_with_a_large_curvature_factor(leaf, p_ey3):
    tyre = leaf.tyre_front._replace(p_ey1=1.0, p_ey2=0.0, p_ey3=p_ey3)
    slip = np.linspace(0.01, 1.5, 150)
    assert (force(slip, np.full_like(slip, 4000.0), tyre) < 0.0).all()
    assert (force(-slip, np.full_like(slip, 4000.0), tyre) > 0.0).all()


def test_slip_angle_is_positive_to_the_left_and_bounded_at_standstill():
    assert tyres.slip_angle(0.5, 10.0, 3.0) == math.atan(0.05)
    assert tyres.slip_angle(0.5, -10.0, 3.0) == math.atan(0.05)
    assert tyres.slip_angle(0.5, 0.0, 3.0) == math.atan(0.5 / 3.0)
    assert math.isnan(tyres.slip_angle(0.5, math.nan, 3.0))
