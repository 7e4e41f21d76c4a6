"""First-order consequence of each effect, sign and magnitude, against analytic formulas.

Steady cornering of the linear car, small angles: delta = l r / v + K v r, K = m (l_r C_r - l_f C_f) / (l C_f C_r).
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve
from st_core.augmented import augment
from st_core.composition import compose
from st_core.models import MODELS, motion, nonlinear_tyre, slip_angles
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState
from st_core.tyres import GRAVITY, magic_formula_coefficients, magic_formula_force

SPEED, ANGLE = 15.0, 1e-4  # m/s; rad, small enough for the closed forms
STRAIGHT = (0.0, 0.0, SPEED, 0.0, 0.0, 0.0)  # heading east
DYNAMIC = pytest.mark.parametrize("base", ["linear", "nonlinear"])


def state_derivative(model, car, state, angle=0.0, acceleration=0.0):
    """At a road wheel angle [rad] and a longitudinal acceleration [m/s^2]."""
    p = model.parameters(car)
    return model.rhs(state, model.inputs(angle, acceleration, p), p)


def specific_force(model, car, state):
    """(a_x, a_y) [m/s^2] of an accelerometer at the CG at constant speed with straight wheels."""
    p = model.parameters(car)
    w, added = model.inputs(0.0, 0.0, p), compose(model.base, model.effects).specific_force
    rates, (a_x, a_y) = model.rhs(state, w, p), added(state, w, p) if added else (0.0, 0.0)
    return a_x + rates[2] - state[3] * rates[4], a_y + rates[3] + state[2] * rates[4]


def steady_yaw_rate(model, car, angle=ANGLE):
    """Yaw rate [rad/s] at SPEED with v_y_dot = r_dot = 0, heading east, extra states constant."""
    def residual(unknown):
        velocity_y, yaw_rate, *extra = unknown.tolist()
        derivative = state_derivative(model, car, (0.0, 0.0, SPEED, velocity_y, 0.0, yaw_rate, *extra), angle)
        return [derivative[3], *derivative[5:]]

    root = fsolve(residual, np.zeros(2 + len(model.extra_states)), xtol=1e-11)
    assert np.abs(residual(root)).max() < 1e-9
    return float(root[1])


def understeer_gradient(model, car):
    """Understeer gradient K [rad s^2/m] from the steady state."""
    rate = steady_yaw_rate(model, car)
    return (ANGLE - car.wheelbase * rate / SPEED) / (SPEED * rate)


def analytic_gradient(car, front=1.0, rear=1.0, mass=1.0, shift=0.0):
    c_f, c_r = front * car.cornering_stiffness_front, rear * car.cornering_stiffness_rear
    l_f, l_r = car.cg_to_front_axle - shift, car.cg_to_rear_axle + shift
    return mass * car.mass / car.wheelbase * (l_r / c_f - l_f / c_r)


def test_linear_model_has_the_analytic_understeer_gradient(car):
    assert understeer_gradient(MODELS["linear"], car) == pytest.approx(analytic_gradient(car), rel=1e-5)


@DYNAMIC
def test_compliance_adds_to_understeer_gradient(leaf, base):
    c = 1.5e-6  # rad/N
    model = augment(base, {"steering_compliance": {"compliance": c}})
    change = understeer_gradient(model, leaf) - understeer_gradient(MODELS[base], leaf)
    assert change == pytest.approx(c * leaf.mass * leaf.cg_to_rear_axle / leaf.wheelbase, rel=1e-4)


@DYNAMIC
def test_roll_steer_adds_to_understeer_gradient(leaf, base):
    model = augment(base, {"roll_steer": {"gradient": 0.0007}})
    change = understeer_gradient(model, leaf) - understeer_gradient(MODELS[base], leaf)
    assert change == pytest.approx(0.0007, rel=1e-4)


@DYNAMIC
@pytest.mark.parametrize(("effect", "values", "scaled"), [
    ("front_stiffness", {"factor": 0.8}, {"front": 0.8}),
    ("rear_stiffness", {"factor": 0.8}, {"rear": 0.8}),
    ("tyre_stiffness", {"factor": 0.8}, {"front": 0.8, "rear": 0.8}),
])
def test_stiffness_factor_changes_understeer_gradient(leaf, base, effect, values, scaled):
    model = augment(base, {effect: values})
    assert understeer_gradient(model, leaf) == pytest.approx(analytic_gradient(leaf, **scaled), rel=1e-4)


@pytest.mark.parametrize(("effect", "values", "scaled"), [
    ("mass", {"factor": 1.2}, {"mass": 1.2}),
    ("cg_position", {"shift": 0.1}, {"shift": 0.1}),
])
def test_mass_and_cg_change_understeer_gradient_of_linear_tyres(leaf, effect, values, scaled):
    model = augment("linear", {effect: values})
    assert understeer_gradient(model, leaf) == pytest.approx(analytic_gradient(leaf, **scaled), rel=1e-4)


def test_cg_shift_keeps_axles_and_ins_in_place(leaf):
    car = augment("linear", {"cg_position": {"shift": 0.1}}).effective_vehicle(leaf)
    assert car.wheelbase == leaf.wheelbase
    assert leaf.cg_to_front_axle - car.cg_to_front_axle == pytest.approx(0.1)  # closer to the front axle
    front_axle_to_ins = [v.cg_to_front_axle - v.cg_to_ins_x for v in (car, leaf)]
    assert front_axle_to_ins[0] == pytest.approx(front_axle_to_ins[1])


def test_load_is_a_point_mass_over_the_rear_axle(leaf):
    car = augment("linear", {"load": {"mass": 200.0}}).effective_vehicle(leaf)
    assert car.mass == leaf.mass + 200.0
    assert car.mass * car.cg_to_front_axle == pytest.approx(leaf.mass * leaf.cg_to_front_axle + 200.0 * leaf.wheelbase)
    inertia_about_front = [v.yaw_inertia + v.mass * v.cg_to_front_axle**2 for v in (car, leaf)]
    assert inertia_about_front[0] == pytest.approx(inertia_about_front[1] + 200.0 * leaf.wheelbase**2)
    assert car.cg_to_front_axle - car.cg_to_ins_x == pytest.approx(leaf.cg_to_front_axle - leaf.cg_to_ins_x)


@DYNAMIC
def test_yaw_inertia_slows_turn_in_but_not_steady_state(leaf, base):
    model = augment(base, {"yaw_inertia": {"factor": 1.25}})
    assert steady_yaw_rate(model, leaf) == pytest.approx(steady_yaw_rate(MODELS[base], leaf), rel=1e-9)
    changed, plain = (state_derivative(m, leaf, STRAIGHT, 0.02)[5] for m in (model, MODELS[base]))
    assert changed == pytest.approx(plain / 1.25, rel=1e-12) and changed > 0.0


@DYNAMIC
def test_steering_ratio_and_offset_act_on_the_road_wheel_angle(leaf, base):
    plain = steady_yaw_rate(MODELS[base], leaf)
    slower = augment(base, {"steering_ratio": {"factor": 1.1}})
    assert steady_yaw_rate(slower, leaf) == pytest.approx(plain / 1.1, rel=1e-6)
    with_offset = augment(base, {"steering_offset": {"angle": 2e-4}})
    assert steady_yaw_rate(with_offset, leaf, angle=0.0) == pytest.approx(2.0 * plain, rel=1e-6)  # left


@DYNAMIC
def test_bank_accelerates_downhill_without_specific_force(leaf, base):
    bank = 0.001
    model = augment(base, {"road_bank": {"angle": bank}})
    k = understeer_gradient(MODELS[base], leaf)
    expected = -k * GRAVITY * math.sin(bank) * SPEED / (leaf.wheelbase + k * SPEED**2)
    assert steady_yaw_rate(model, leaf, angle=0.0) == pytest.approx(expected, rel=1e-4) and expected < 0.0
    # In free fall along the slope the accelerometer measures nothing.
    assert state_derivative(model, leaf, STRAIGHT)[3] == pytest.approx(-GRAVITY * math.sin(bank))
    assert specific_force(model, leaf, STRAIGHT) == pytest.approx((0.0, 0.0), abs=1e-12)


@DYNAMIC
@pytest.mark.parametrize("yaw", [0.0, 1.1, math.pi / 2, math.pi, -2.0])
def test_road_slope_accelerates_downhill_in_the_map_without_lateral_specific_force(leaf, base, yaw):
    east, north = 0.03, -0.02
    model = augment(base, {"road_slope": {"slope_x": east, "slope_y": north}})
    state = (5.0, -3.0, SPEED, 0.0, yaw, 0.0)
    rise_left = -math.sin(east) * math.sin(yaw) + math.sin(north) * math.cos(yaw)
    derivative = state_derivative(model, leaf, state)
    assert derivative[3] == pytest.approx(-GRAVITY * rise_left, rel=1e-9)
    assert derivative[5] == pytest.approx(0.0, abs=1e-12)
    # In free fall along y; along x the speed is constant, so a drive force balances gravity.
    rise_ahead = math.sin(east) * math.cos(yaw) + math.sin(north) * math.sin(yaw)
    assert specific_force(model, leaf, state) == pytest.approx((GRAVITY * rise_ahead, 0.0), abs=1e-9)


def test_road_slope_equals_bank_for_a_car_heading_east(leaf):
    slope = augment("linear", {"road_slope": {"slope_x": 0.0, "slope_y": 1e-4}})
    bank = augment("linear", {"road_bank": {"angle": 1e-4}})
    paths = [predict(model, leaf, VehicleState(*STRAIGHT), ControlInput(0.0, 0.0)).states for model in (slope, bank)]
    np.testing.assert_allclose(*paths, atol=1e-5)


@pytest.mark.parametrize("base", MODELS)
def test_steering_map_is_cubic_in_the_angle_from_straight_ahead(leaf, base):
    model, plain = augment(base, {"steering_map": {"curvature": 0.05 / 0.3**2}}), MODELS[base]
    state = (0.0, 0.0, 3.5, 0.0, 0.2, 0.0)
    for angle in (-0.3, 0.01, 0.3):
        mapped = angle * (1.0 + 0.05 * (angle / 0.3) ** 2)
        expected = state_derivative(plain, leaf, state, mapped, 0.3)
        assert state_derivative(model, leaf, state, angle, 0.3) == pytest.approx(expected, rel=1e-12)
    # The angle of the map is that after ratio and offset.
    with_offset = augment(base, {"steering_map": {"curvature": 1.0}, "steering_offset": {"angle": 0.1},
                                 "steering_ratio": {"factor": 0.5}})
    expected = state_derivative(plain, leaf, state, 0.3 * (1.0 + 0.3**2))
    assert state_derivative(with_offset, leaf, state, 0.1) == pytest.approx(expected, rel=1e-12)


@DYNAMIC
def test_tyre_stiffness_equals_front_and_rear_stiffness_together(leaf, base):
    state, inputs = VehicleState(0.0, 0.0, SPEED, 0.1, 0.3, 0.2), ControlInput(0.05, -0.5)
    both = augment(base, {"tyre_stiffness": {"factor": 0.8}})
    separate = augment(base, {"front_stiffness": {"factor": 0.8}, "rear_stiffness": {"factor": 0.8}})
    np.testing.assert_array_equal(predict(both, leaf, state, inputs).states,
                                  predict(separate, leaf, state, inputs).states)


def test_tyre_stiffness_does_not_change_the_peak_force(leaf):
    softer, base = augment("nonlinear", {"tyre_stiffness": {"factor": 0.8}}), MODELS["nonlinear"]
    for axle in (0, 1):
        assert peak_force(softer, leaf, axle) == pytest.approx(peak_force(base, leaf, axle), rel=1e-3)


@DYNAMIC
def test_wind_from_the_right_pushes_left_with_specific_force(leaf, base):
    wind = 0.02  # m/s towards north, heading east; so weak that slip stays small
    area, arm = leaf.side_area, leaf.side_force_arm
    model = augment(base, {"crosswind": {"wind_x": 0.0, "wind_y": wind}})
    force = 0.5 * 1.2 * area * SPEED * wind
    derivative = state_derivative(model, leaf, STRAIGHT)
    assert derivative[3] == pytest.approx(force / leaf.mass, rel=1e-4)
    assert derivative[5] == pytest.approx(arm * force / leaf.yaw_inertia, rel=1e-4)
    assert specific_force(model, leaf, STRAIGHT)[1] == pytest.approx(force / leaf.mass, rel=1e-4)
    # l r / v = -F_f / C_f + F_r / C_r with F_f = (l_r (m v r - F) - e F) / l, F_r = (l_f (m v r - F) + e F) / l.
    # The side force in still air is not part of the effect; the force due to the car's own sideslip adds 1 % here.
    l_f, l_r = leaf.cg_to_front_axle, leaf.cg_to_rear_axle
    arms = (l_r + arm) / leaf.cornering_stiffness_front - (l_f - arm) / leaf.cornering_stiffness_rear
    k = understeer_gradient(MODELS[base], leaf)
    expected = force * arms / (leaf.wheelbase * (leaf.wheelbase / SPEED + k * SPEED))
    assert steady_yaw_rate(model, leaf, angle=0.0) == pytest.approx(expected, rel=0.01) and expected > 0.0


def test_headwind_does_not_steer(leaf):
    model = augment("linear", {"crosswind": {"wind_x": -10.0, "wind_y": 0.0}})
    assert steady_yaw_rate(model, leaf, angle=0.0) == pytest.approx(0.0, abs=1e-12)


def axle_force(model, car, slip, acceleration=0.0):
    """(front, rear) [N] of a dynamic base at equal slip angles."""
    p = model.parameters(car)
    return nonlinear_tyre.axle_forces(slip, slip, model.inputs(0.0, acceleration, p), p)


def peak_force(model, car, axle):
    return np.abs(axle_force(model, car, np.linspace(-3.0, 0.0, 3000))[axle]).max()


def test_friction_scales_peak_force_but_not_stiffness(leaf):
    wet, dry = augment("nonlinear", {"friction": {"factor": 0.7}}), MODELS["nonlinear"]
    for axle in (0, 1):
        assert peak_force(wet, leaf, axle) == pytest.approx(0.7 * peak_force(dry, leaf, axle), rel=1e-3)
        slopes = [axle_force(m, leaf, -1e-6)[axle] for m in (wet, dry)]
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-6)


@pytest.mark.parametrize(("name", "axle"), [("front_tyre_curve", 0), ("rear_tyre_curve", 1)])
def test_tyre_curve_changes_peak_and_curvature_of_its_axle_only(leaf, name, axle):
    base = MODELS["nonlinear"]
    low_peak, curved = (augment("nonlinear", {name: values}) for values in (
        {"peak": 0.7, "curvature": 1.0}, {"peak": 1.0, "curvature": 3.0}))
    assert peak_force(low_peak, leaf, axle) == pytest.approx(0.7 * peak_force(base, leaf, axle), rel=1e-3)
    for acceleration in (-4.0, 0.0, 3.0):
        slopes = [axle_force(m, leaf, -1e-6, acceleration)[axle] for m in (low_peak, curved, base)]
        assert slopes == pytest.approx([slopes[2]] * 3, rel=1e-6)
        e_curved, e_base = (m.inputs(0.0, acceleration, m.parameters(leaf))[(5, 8)[axle]] for m in (curved, base))
        assert 1.0 - e_curved == pytest.approx(3.0 * (1.0 - e_base))
    assert abs(axle_force(curved, leaf, -0.08)[axle]) > abs(axle_force(base, leaf, -0.08)[axle])
    for model in (low_peak, curved):
        assert axle_force(model, leaf, -0.08)[1 - axle] == axle_force(base, leaf, -0.08)[1 - axle]


def test_load_sensitivity_changes_stiffness_around_static_load(leaf):
    sensitive, base = augment("nonlinear", {"tyre_load_sensitivity": {"factor": 3.0}}), MODELS["nonlinear"]
    for axle, sign in ((0, -1.0), (1, 1.0)):
        at_rest, base_at_rest = (axle_force(m, leaf, -1e-6)[axle] for m in (sensitive, base))
        assert at_rest == pytest.approx(base_at_rest, rel=1e-9)
        loaded = [axle_force(m, leaf, -1e-6, 2.0 * sign)[axle] for m in (sensitive, base)]
        assert loaded[0] > loaded[1] > base_at_rest
    heavy = augment("nonlinear", {"tyre_load_sensitivity": {"factor": 3.0}, "mass": {"factor": 1.2}})
    plain = augment("nonlinear", {"mass": {"factor": 1.2}})
    assert axle_force(heavy, leaf, -1e-6)[0] > axle_force(plain, leaf, -1e-6)[0]


@pytest.mark.parametrize(("name", "axle"), [("front_saturation", 0), ("rear_saturation", 1)])
def test_saturation_limits_force_of_a_linear_axle(leaf, name, axle):
    base, friction = MODELS["linear"], 0.8
    model = augment("linear", {name: {"saturation": 1.0 / friction**2}})
    load = GRAVITY * leaf.mass * (leaf.cg_to_rear_axle, leaf.cg_to_front_axle)[axle] / leaf.wheelbase

    def force(of, slip):
        return axle_forces_in_rhs(of, leaf, (0.0, 0.0, 20.0, 20.0 * math.tan(slip), 0.0, 0.0))

    assert force(model, 1e-3)[axle] == pytest.approx(force(base, 1e-3)[axle], rel=1e-3)
    slip = friction * load / (leaf.cornering_stiffness_front, leaf.cornering_stiffness_rear)[axle]
    assert force(model, slip)[axle] == pytest.approx(-friction * load / 3.0**0.25)
    assert force(model, 1.5)[axle] == pytest.approx(-friction * load, rel=0.01)
    assert force(model, slip)[1 - axle] == pytest.approx(force(base, slip)[1 - axle], abs=1e-6)


def axle_forces_in_rhs(model, car, state, acceleration=0.0, angle=0.0):
    p = model.parameters(car)
    w = model.inputs(angle, acceleration, p)
    return axle_forces_in_rates(car, state, model.rhs(model.start_state(state, w, p), w, p))


def axle_forces_in_rates(car, state, derivative):
    """(front, rear) [N] of a car on level ground with a small steering angle, from its state derivative."""
    total = car.mass * (derivative[3] + state[2] * state[5])
    moment = car.yaw_inertia * derivative[5]
    return ((car.cg_to_rear_axle * total + moment) / car.wheelbase,
            (car.cg_to_front_axle * total - moment) / car.wheelbase)


SLIDING = (0.0, 0.0, 12.0, -0.9, 0.0, 0.1)


def test_lateral_load_transfer_reduces_force_by_second_derivative_over_load(leaf):
    share, track, front_part = 0.3, leaf.track_width, leaf.load_transfer_front
    model = augment("nonlinear", {"lateral_load_transfer": {"share": share}})
    plain = axle_forces_in_rhs(MODELS["nonlinear"], leaf, SLIDING)
    load_transfer = share * sum(plain) * leaf.cg_height / track
    p = nonlinear_tyre.parameters(leaf)
    slips = slip_angles(SLIDING, MODELS["nonlinear"].inputs(0.0, 0.0, p), p)
    loads = [0.5 * load for load in nonlinear_tyre.axle_loads(0.0, p)]
    changed = axle_forces_in_rhs(model, leaf, SLIDING)
    for axle, (tyre, part) in enumerate(((p.tyre_front, front_part), (p.tyre_rear, 1.0 - front_part))):
        def tyre_force(load, slip=slips[axle], tyre=tyre):
            return magic_formula_force(slip, *magic_formula_coefficients(load, tyre), tyre)

        step = 20.0
        curvature = (tyre_force(loads[axle] + step) - 2.0 * tyre_force(loads[axle])
                     + tyre_force(loads[axle] - step)) / step**2
        loss = curvature * (part * load_transfer) ** 2
        assert changed[axle] - plain[axle] == pytest.approx(loss, rel=0.02)
        assert abs(changed[axle]) < abs(plain[axle])


def test_lateral_load_transfer_has_the_yaw_moment_of_four_wheels(leaf):
    """Yaw moment of the four tyre forces about the CG, each at its wheel's steering angle, against the model."""
    angle, state = 0.3, (0.0, 0.0, 6.0, -0.1, 0.0, 0.55)
    track, front_part = leaf.track_width, leaf.load_transfer_front
    model = augment("nonlinear", {"lateral_load_transfer": {"share": 1.0}})
    p = nonlinear_tyre.parameters(leaf)
    w = MODELS["nonlinear"].inputs(angle, 0.0, p)
    slips = slip_angles(state, w, p)
    load_transfer = sum(nonlinear_tyre.axle_forces(*slips, w, p)) * leaf.cg_height / track
    moment = lateral_force = 0.0
    for axle, (tyre, part, x, wheel_angle) in enumerate((
            (p.tyre_front, front_part, leaf.cg_to_front_axle, angle),
            (p.tyre_rear, 1.0 - front_part, -leaf.cg_to_rear_axle, 0.0))):
        load = 0.5 * nonlinear_tyre.axle_loads(0.0, p)[axle]
        for side in (1.0, -1.0):  # left, right; in a left turn the load moves to the right
            force = 0.5 * magic_formula_axle(slips[axle], 2.0 * (load - side * part * load_transfer), tyre)
            moment += x * force * math.cos(wheel_angle) + side * 0.5 * track * force * math.sin(wheel_angle)
            lateral_force += force * math.cos(wheel_angle)
    derivative = state_derivative(model, leaf, state, angle)
    assert derivative[5] == pytest.approx(moment / leaf.yaw_inertia, rel=1e-9)
    assert derivative[3] + state[2] * state[5] == pytest.approx(lateral_force / leaf.mass, rel=1e-9)


def magic_formula_axle(slip, load, tyre):
    """Lateral force [N] of two tyres sharing `load` [N]."""
    return 2.0 * magic_formula_force(slip, *magic_formula_coefficients(0.5 * load, tyre), tyre)


@DYNAMIC
def test_longitudinal_load_transfer_follows_the_tyre_data(leaf, base):
    braking, height = -4.0, 0.5
    model = augment(base, {"longitudinal_load_transfer": {"height": height}})
    plain, changed = (axle_forces_in_rhs(m, leaf, SLIDING, braking) for m in (MODELS[base], model))
    p = nonlinear_tyre.parameters(leaf)
    slips = slip_angles(SLIDING, MODELS["nonlinear"].inputs(0.0, 0.0, p), p)
    load_transfer = leaf.mass * height * braking / leaf.wheelbase
    loads = nonlinear_tyre.axle_loads(braking, p)
    for axle, (tyre, sign) in enumerate(((p.tyre_front, -1.0), (p.tyre_rear, 1.0))):
        change = (magic_formula_axle(slips[axle], loads[axle] + sign * load_transfer, tyre)
                  - magic_formula_axle(slips[axle], loads[axle], tyre))
        assert changed[axle] - plain[axle] == pytest.approx(change, rel=1e-9)
    # Braking loads the front axle and unloads the rear axle.
    assert abs(changed[0]) > abs(plain[0]) and abs(changed[1]) < abs(plain[1])


def test_longitudinal_load_transfer_is_equivalent_to_cg_height(leaf):
    low = replace(leaf, cg_height=0.2)
    model = augment("nonlinear", {"longitudinal_load_transfer": {"height": leaf.cg_height - 0.2}})
    for acceleration in (-5.0, 2.0):
        assert axle_forces_in_rhs(model, low, SLIDING, acceleration) == pytest.approx(
            axle_forces_in_rhs(MODELS["nonlinear"], leaf, SLIDING, acceleration), rel=1e-9)


def drive_force(car, state, acceleration, lateral_front, angle):
    """F_x [N] from m (v_x_dot - v_y r) = F_x - F_f sin delta."""
    return car.mass * (acceleration - state[3] * state[5]) + lateral_front * math.sin(angle)


@DYNAMIC
@pytest.mark.parametrize(("acceleration", "shares"), [(3.0, (1.0, 0.0)), (-5.0, (0.65, 0.35))])
def test_combined_slip_limits_lateral_force_to_the_friction_ellipse(leaf, base, acceleration, shares):
    model = augment(base, {"combined_slip": {"share": 1.0}})
    plain, changed = (axle_forces_in_rhs(m, leaf, SLIDING, acceleration) for m in (MODELS[base], model))
    p = nonlinear_tyre.parameters(leaf)
    force = drive_force(leaf, SLIDING, acceleration, plain[0], 0.0)
    for axle, tyre in enumerate((p.tyre_front, p.tyre_rear)):
        load = nonlinear_tyre.axle_loads(acceleration, p)[axle]
        increment = 0.5 * load / tyre.nominal_load - 1.0
        peak = (tyre.p_dy1 + tyre.p_dy2 * increment) * load
        remaining_share = math.sqrt(1.0 - (shares[axle] * force / peak) ** 2)
        assert changed[axle] / plain[axle] == pytest.approx(remaining_share, rel=1e-9)


@DYNAMIC
@pytest.mark.parametrize(("acceleration", "share_front"), [(2.0, 1.0), (-4.0, 0.65)])
def test_steered_drive_force_has_a_lateral_component(leaf, base, acceleration, share_front):
    model, angle = augment(base, {"steered_drive_force": {"share": 1.0}}), 0.1
    plain, changed = (state_derivative(m, leaf, SLIDING, angle, acceleration) for m in (MODELS[base], model))
    p = MODELS[base].parameters(leaf)
    w = MODELS[base].inputs(angle, acceleration, p)
    front, _ = MODELS[base].axle_forces(*slip_angles(SLIDING, w, p), w, p)
    lateral_drive_force = share_front * drive_force(leaf, SLIDING, acceleration, front, angle) * math.sin(angle)
    assert leaf.mass * (changed[3] - plain[3]) == pytest.approx(lateral_drive_force, rel=1e-9)
    moment = lateral_drive_force * leaf.cg_to_front_axle
    assert leaf.yaw_inertia * (changed[5] - plain[5]) == pytest.approx(moment, rel=1e-9)
    assert lateral_drive_force * acceleration > 0.0  # drive pulls the front into the turn, braking pushes it out


@DYNAMIC
@pytest.mark.parametrize("length", [0.1, 0.4, 1.2])  # 0.1 m at 12 m/s is below the shortest time constant
def test_relaxation_lags_a_slip_ramp_by_its_length(leaf, base, length):
    model = augment(base, {"tyre_relaxation": {"length": length}})
    p, speed, slope = model.parameters(leaf), 12.0, 0.05
    w = model.inputs(0.0, 0.0, p)
    slip, step, extra = 0.0, 0.001, np.zeros(2)
    for _ in range(1000):
        # Pure sideslip growing at `slope` [rad/s]: equal slip at both axles.
        slip += slope * step
        state = (0.0, 0.0, speed, speed * math.tan(slip), 0.0, 0.0)
        extra += step * np.array(model.rhs((*state, *extra.tolist()), w, p)[6:])
    force = axle_forces_in_rates(leaf, state, model.rhs((*state, *extra.tolist()), w, p))
    lagged_state = (0.0, 0.0, speed, speed * math.tan(slip - slope * length / speed), 0.0, 0.0)
    np.testing.assert_allclose(force, axle_forces_in_rhs(MODELS[base], leaf, lagged_state), rtol=2e-3)


@DYNAMIC
def test_relaxation_starts_in_steady_state(leaf, base):
    model = augment(base, {"tyre_relaxation": {"length": 0.6}})
    expected = axle_forces_in_rhs(MODELS[base], leaf, SLIDING)
    assert axle_forces_in_rhs(model, leaf, SLIDING) == pytest.approx(expected, rel=1e-12)


def test_roll_has_natural_frequency_and_damping(leaf):
    model = augment("linear", {"roll_steer": {"gradient": 1e-9, "frequency": 2.0, "damping": 0.4}})
    p = model.parameters(leaf)
    w = model.inputs(0.0, 0.0, p)
    state = (0.0, 0.0, 12.0, 0.0, 0.0, 0.0)
    columns = [np.array(model.rhs((*state, *e), w, p)[6:]) for e in ((1.0, 0.0), (0.0, 1.0))]
    eigenvalues = np.linalg.eigvals(np.column_stack(columns))
    assert np.abs(eigenvalues) == pytest.approx([4.0 * math.pi] * 2)
    assert eigenvalues.real == pytest.approx([-0.4 * 4.0 * math.pi] * 2)


@pytest.mark.parametrize(("base", "effects", "same_as"), [
    ("kinematic", ["tyre_slip"], "linear"),
    ("linear", ["tyre_saturation"], "nonlinear"),
    ("kinematic", ["tyre_slip", "tyre_saturation"], "nonlinear"),
])
def test_lower_model_with_missing_effects_equals_higher_model(car, base, effects, same_as):
    state, inputs = VehicleState(1.0, 2.0, 9.0, 0.1, 0.4, 0.2), ControlInput(0.15, -0.5)
    states = predict(augment(base, effects), car, state, inputs).states
    np.testing.assert_allclose(states, predict(same_as, car, state, inputs).states, rtol=1e-12, atol=1e-12)


@DYNAMIC
def test_motion_with_axle_forces_equals_rhs_bit_for_bit(car, base):
    model, random = MODELS[base], np.random.default_rng(3)
    p = model.parameters(car)
    for _ in range(200):
        state = tuple(random.uniform([-9, -9, -2, -2, -4, -1], [9, 9, 25, 2, 4, 1]).tolist())
        w = model.inputs(float(random.uniform(-0.5, 0.5)), float(random.uniform(-8, 5)), p)
        forces = model.axle_forces(*slip_angles(state, w, p), w, p)
        assert motion(state, *forces, w, p) == model.rhs(state, w, p)
