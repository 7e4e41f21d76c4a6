"""Steady state by closed form, simulation and root finding; linear system against the Jacobian; plausibility."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve
from st_core import handling
from st_core.models import MODELS
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState


@pytest.mark.parametrize("model", ["linear", "nonlinear"])
@pytest.mark.parametrize("speed", [6.0, 12.0, 20.0])
def test_steady_state_yaw_rate_by_three_methods(car, model, speed):
    angle = 1e-4  # rad; small enough for the closed form and the initial tyre slope
    # r = v delta / (l (1 + K v^2))
    closed_form = speed * angle / (car.wheelbase * (1.0 + handling.stability_factor(car) * speed * speed))
    simulated = predict(model, car, VehicleState(0.0, 0.0, speed, 0.0, 0.0, 0.0), ControlInput(angle, 0.0), 20.0)
    equations = MODELS[model]
    p = equations.parameters(car)
    w = equations.inputs(angle, 0.0, p)
    root = fsolve(lambda v: [equations.rhs((0.0, 0.0, speed, float(v[0]), 0.0, float(v[1])), w, p)[i] for i in (3, 5)],
                  [0.0, 0.0])
    assert simulated.yaw_rate[-1] == pytest.approx(closed_form, rel=1e-5)
    assert root[1] == pytest.approx(simulated.yaw_rate[-1], rel=1e-8)


@pytest.mark.parametrize("model", ["linear", "nonlinear"])
@pytest.mark.parametrize("speed", [1.0, 4.0, 10.0, 25.0])
def test_linear_system_is_the_jacobian_of_the_model(car, model, speed):
    equations = MODELS[model]
    p = equations.parameters(car)

    def lateral(velocity_y, yaw_rate, angle):
        derivative = equations.rhs((0.0, 0.0, speed, velocity_y, 0.0, yaw_rate), equations.inputs(angle, 0.0, p), p)
        return np.array([derivative[3], derivative[5]])

    small = 1e-6
    columns = [(lateral(*(small * e)) - lateral(*(-small * e))) / (2.0 * small) for e in np.eye(3)]
    a, b = handling.linear_system(speed, car)
    np.testing.assert_allclose(np.column_stack(columns[:2]), a, rtol=1e-6, atol=1e-6)
    if speed > car.minimum_slip_speed:
        np.testing.assert_allclose(columns[2], b, rtol=1e-6)


def test_simulated_decay_rate_is_the_slowest_eigenvalue(leaf):
    speed = 6.0  # both eigenvalues real
    eigenvalues = np.linalg.eigvals(handling.linear_system(speed, leaf)[0])
    assert np.isreal(eigenvalues).all()
    path = predict("linear", leaf, VehicleState(0.0, 0.0, speed, 1e-4, 0.0, 0.0), ControlInput(0.0, 0.0), 2.0, 0.01)
    rate = math.log(abs(path.velocity_y[-1] / path.velocity_y[-51])) / 0.5
    assert rate == pytest.approx(float(eigenvalues.real.max()), rel=1e-3)


def test_oversteering_car_is_unstable_past_its_critical_speed(leaf):
    oversteering = replace(leaf, cornering_stiffness_front=120000.0, cornering_stiffness_rear=60000.0)
    assert handling.stability_factor(leaf) > 0.0 > handling.stability_factor(oversteering)
    critical = math.sqrt(-1.0 / handling.stability_factor(oversteering))
    assert np.linalg.eigvals(handling.linear_system(critical * 0.99, oversteering)[0]).real.max() < 0.0
    assert np.linalg.eigvals(handling.linear_system(critical * 1.01, oversteering)[0]).real.max() > 0.0


@pytest.mark.parametrize(("changes", "key", "number"), [
    ({"cg_to_front_axle": 0.8}, "cg_to_front_axle", "0.704 is outside the range of road cars, 0.35 to 0.68"),
    ({"yaw_inertia": 1500.0}, "yaw_inertia", "k^2 / (l_f l_r) 0.526"),
    ({"cg_height": 0.95}, "cg_height", "0.352"),
    ({"cornering_stiffness_front": 40_000.0}, "cornering_stiffness_front, cornering_stiffness_rear", "8.94 deg/g"),
    ({"steering_ratio": 1.0 / 0.9}, "steering_ratio", "1.11 is outside the range of road cars, 9 to 26"),
    ({"cornering_stiffness_rear": 250_000.0}, "cornering_stiffness_rear", "36.8 1/rad is outside the range"),
])
def test_implausible_value_is_reported_with_its_number(leaf, changes, key, number):
    assert not handling.find_implausible_values(leaf)
    found = handling.find_implausible_values(replace(leaf, **changes))
    assert any(text.startswith(f"{key}: ") and number in text and "(" in text for text in found), found
    # Values that the vehicle file already had are not reported.
    assert not handling.find_implausible_values(replace(leaf, **changes), replace(leaf, **changes))
    assert handling.find_implausible_values(replace(leaf, **changes), leaf) == found


def test_understeer_gradient_is_that_of_both_axles(leaf):
    """Softer tyres on the rear axle only make it oversteer; with softer tyres or compliance in front it does not."""
    rear = replace(leaf, cornering_stiffness_rear=0.4 * leaf.cornering_stiffness_rear)
    both = replace(rear, cornering_stiffness_front=0.5 * leaf.cornering_stiffness_front)
    assert "understeer gradient" in handling.find_implausible_values(rear, leaf, rear)[0]
    assert not handling.find_implausible_values(rear, leaf, both)
