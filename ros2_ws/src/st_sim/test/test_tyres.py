"""The tyre model: cornering stiffness, peak, load, symmetry, and the values of the table of the paper."""

import math
from functools import partial

import pytest
from st_sim.dynamics import GRAVITY, lateral_fraction, make_tyre_coefficients, tyre_force
from st_sim.settings import read_vehicle
from support import LEAF

CAR = read_vehicle(LEAF)
STATIC_FRONT = CAR.mass * GRAVITY * CAR.cg_to_rear_axle / CAR.wheelbase / 2
STATIC_REAR = CAR.mass * GRAVITY * CAR.cg_to_front_axle / CAR.wheelbase / 2


def test_stiffness_scaling_factors_equal_those_of_the_paper():
    assert CAR.tyre_front.lambda_ky == pytest.approx(0.4231, abs=5e-4)
    assert CAR.tyre_rear.lambda_ky == pytest.approx(0.959, abs=5e-3)


@pytest.mark.parametrize(
    ("tyre", "load", "axle_stiffness"),
    [(CAR.tyre_front, STATIC_FRONT, 70000.0), (CAR.tyre_rear, STATIC_REAR, 106000.0)],
)
def test_cornering_stiffness_at_static_load_is_half_that_of_the_axle(tyre, load, axle_stiffness):
    force, _ = tyre_force(make_tyre_coefficients(tyre, 1.0), 1e-5, load, 1.0)
    assert force / 1e-5 == pytest.approx(-axle_stiffness / 2, rel=1e-4)


@pytest.mark.parametrize("tyre", [CAR.tyre_front, CAR.tyre_rear])
def test_force_is_odd_limited_by_its_peak_and_degressive_in_load(tyre):
    force = partial(tyre_force, make_tyre_coefficients(tyre, 1.0))
    angles = [math.radians(0.5 * i) for i in range(1, 60)]
    curve = [force(a, 4000.0, 1.0)[0] for a in angles]
    assert [-f for f in curve] == pytest.approx([force(-a, 4000.0, 1.0)[0] for a in angles])
    peak = force(0.1, 4000.0, 1.0)[1]
    # The sine of the Magic Formula reaches 1, where the force equals D.
    assert 0.95 * peak < max(map(abs, curve)) <= peak
    # Load transfer reduces the lateral force of an axle.
    assert abs(force(0.08, 2500.0, 1.0)[0] + force(0.08, 5500.0, 1.0)[0]) < 0.995 * abs(2 * force(0.08, 4000.0, 1.0)[0])


def test_friction_scales_the_peak_but_not_the_cornering_stiffness():
    force = partial(tyre_force, make_tyre_coefficients(CAR.tyre_front, 1.0))
    assert force(1e-5, 4000.0, 0.5)[0] == pytest.approx(force(1e-5, 4000.0, 1.0)[0], rel=1e-4)
    assert force(0.5, 4000.0, 0.5)[0] == pytest.approx(0.5 * force(0.5, 4000.0, 1.0)[0], rel=0.05)


def test_stiffness_factor_scales_the_cornering_stiffness():
    assert tyre_force(make_tyre_coefficients(CAR.tyre_rear, 1.3), 1e-5, 3000.0, 1.0)[0] == pytest.approx(
        1.3 * tyre_force(make_tyre_coefficients(CAR.tyre_rear, 1.0), 1e-5, 3000.0, 1.0)[0], rel=1e-6
    )


def test_lateral_force_is_limited_by_the_friction_ellipse():
    assert lateral_fraction(0.0, 4000.0) == 1.0
    assert lateral_fraction(2400.0, 4000.0) == pytest.approx(0.8)
    assert lateral_fraction(-4000.0, 4000.0) == lateral_fraction(5000.0, 4000.0) == 0.0
