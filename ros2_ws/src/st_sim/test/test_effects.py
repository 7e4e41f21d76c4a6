"""Every setting of the plant: no effect at null, an effect otherwise, and the analytical effect where one is known."""

import math
from functools import cache

import numpy as np
import pytest
from st_core.errors import ConfigurationError
from st_sim.driver import SimulatedCar
from st_sim.dynamics import GRAVITY, TRACK_WIDTH, make_tyre_coefficients, tyre_force
from st_sim.plant import RACK, STEP, VX, YAW_RATE, Environment, Plant, Y, Z
from st_sim.scenarios import load_plan
from st_sim.settings import (
    IDEAL,
    PRESETS,
    REALISTIC,
    SETTINGS,
    find_overrides,
    read_vehicle,
    resolve_settings,
)
from support import LEAF

CAR = read_vehicle(LEAF)
PLANT_GROUPS = ("steering", "tyre", "body", "environment")

# An effective value of each setting, and other settings that it requires.
EXAMPLES = {"steering_ratio_factor": (1.07, {}), "steering_offset": (0.006, {}), "steering_delay": (0.05, {}),
      "steering_lag": (0.1, {}), "steering_backlash": (0.1, {}), "steering_compliance": (2e-6, {}),
      "roll_steer": (-0.1, {"roll_gradient": 0.0075}), "rear_roll_steer": (0.1, {"roll_gradient": 0.0075}),
      "ackermann": (-0.5, {}), "front_stiffness_factor": (0.85, {}), "rear_stiffness_factor": (0.85, {}),
      "friction_factor": (0.75, {}), "relaxation_length": (0.6, {}), "combined_slip": (1.0, {}),
      "wheel_slip_compliance": (0.04, {}), "camber_thrust": (0.8, {"roll_gradient": 0.0075}),
      "lateral_load_transfer": (1.0, {}), "longitudinal_load_transfer": (0.0, {}), "roll_gradient": (0.0075, {}),
      "pitch_gradient": (0.004, {}), "mass_factor": (1.18, {}), "yaw_inertia_factor": (1.22, {}), "cg_shift": (0.1, {}),
      "drive_offset": (0.1, {}), "drag_area": (0.65, {}), "rolling_resistance": (0.011, {}), "bank_angle": (0.03, {}),
      "grade_angle": (0.03, {}), "hillside_slope": (0.03, {}), "terrain_wave": (0.03, {}), "friction_patch": (0.5, {}),
      "wind_speed": (15.0, {}), "gust_speed": (5.0, {})}


@cache
def trace(settings):
    """An open-loop drive with steering, driving and braking: pose, speed, attitude and wheel speeds at 10 Hz.

    settings: frozen set of (name, value).
    """
    plant = Plant(CAR, dict(settings), seed=3)
    plant.place(0.0, 0.0, 0.2, 11.0)
    rows = []
    for i in range(3000):
        t = i * STEP
        steering_wheel = 1.4 * math.sin(2 * math.pi * 0.35 * t) + 0.3 * math.sin(2 * math.pi * 1.6 * t)
        push = 600.0 if t < 4 else -4000.0
        plant.step(steering_wheel, push)
        if i % 50 == 0:
            truth = plant.observe(push)
            rows.append((*plant.state[: VX + 1], truth.roll * 10, truth.pitch * 10, *truth.wheel_speed))
    return np.array(rows)


def difference(name, value, others):
    at_value, at_null = (trace(frozenset({**IDEAL, **others, name: v}.items())) for v in (value, SETTINGS[name].null))
    return np.abs(at_value - at_null).max()


def test_every_plant_setting_has_an_example():
    assert set(EXAMPLES) == {s.name for s in SETTINGS.values() if s.group in PLANT_GROUPS}


@pytest.mark.parametrize("name", EXAMPLES)
def test_setting_has_an_effect_that_vanishes_at_null(name):
    value, others = EXAMPLES[name]
    null = SETTINGS[name].null
    on = difference(name, value, others)
    assert on > 0.005, f"{name} = {value} changes the drive by {on:.2g} only"
    # Null is the limit of small values, not a special case; lags of at least one step leave some per cent.
    assert difference(name, null + 1e-6 * (value - null), others) < 0.05 * on


def steady(effects, steering_wheel=2.0, speed=9.0, seconds=8.0):
    """Ideal plant with `effects` in a steady turn; steering wheel angle [rad], speed [m/s]."""
    plant = Plant(CAR, resolve_settings("ideal", effects))
    plant.place(0.0, 0.0, 0.0, speed)
    for _ in range(round(seconds / STEP)):
        plant.step(steering_wheel, 8000.0 * (speed - plant.state[VX]) + 300.0)
    return plant


def test_steering_ratio_and_offset_change_the_road_wheel_angle():
    assert steady(["steering_ratio_factor=1.1"]).state[RACK] == pytest.approx(2.0 / (1.1 * CAR.steering_ratio))
    angle = steady(["steering_offset=0.01"]).observe(300.0).road_wheel_angle
    assert angle == pytest.approx(2.0 / CAR.steering_ratio + 0.01)


def test_steering_compliance_is_proportional_to_the_front_lateral_force():
    plant = steady(["steering_compliance=2e-6"])
    outputs = plant.observe(300.0)
    front = outputs.lateral_force[0] + outputs.lateral_force[1]
    assert front > 1000.0
    assert outputs.road_wheel_angle == pytest.approx(2.0 / CAR.steering_ratio - 2e-6 * front, rel=1e-4)


def rack_after_step(effects, seconds):
    plant = Plant(CAR, resolve_settings("ideal", effects))
    plant.place(0.0, 0.0, 0.0, 8.0)
    for _ in range(round(seconds / STEP)):
        plant.step(CAR.steering_ratio * 0.05, 0.0)
    return plant.state[RACK] / 0.05


def test_steering_delay_lag_and_backlash_of_a_step():
    assert rack_after_step(["steering_delay=0.05"], 0.05) == 0.0
    assert rack_after_step(["steering_delay=0.05"], 0.054) == pytest.approx(1.0)
    assert rack_after_step(["steering_lag=0.1"], 0.1) == pytest.approx(1 - math.exp(-1), abs=2e-3)
    play = 0.1
    assert rack_after_step([f"steering_backlash={play}"], 0.1) == pytest.approx(
        1 - play / 2 / (CAR.steering_ratio * 0.05)
    )


def test_lateral_load_transfer_and_roll_are_proportional_to_lateral_acceleration():
    plant = steady(["lateral_load_transfer=1", "roll_gradient=0.0075"])
    outputs = plant.observe(300.0)
    a_y, (front_left, front_right, rear_left, rear_right) = outputs.acceleration_y, outputs.load
    left, right = front_left + rear_left, front_right + rear_right
    assert a_y > 2.0
    assert right - left == pytest.approx(2 * CAR.mass * a_y * CAR.cg_height / TRACK_WIDTH, rel=0.01)
    assert outputs.roll == pytest.approx(0.0075 * a_y, rel=0.01)


def test_drive_force_off_the_centre_line_yaws_the_car():
    rates = []
    for effects in ([], ["drive_offset=0.1"]):
        plant = Plant(CAR, resolve_settings("ideal", effects))
        plant.place(0.0, 0.0, 0.0, 15.0)
        plant.step(0.0, 2000.0)
        rates.append(plant.state[YAW_RATE])
    assert rates[0] == 0.0
    assert rates[1] == pytest.approx(0.1 * 2000.0 / (CAR.yaw_inertia / STEP), rel=0.02)  # tyre forces are small


def test_longitudinal_load_transfer_when_braking():
    plant = Plant(CAR, resolve_settings("ideal"))
    plant.place(0.0, 0.0, 0.0, 20.0)
    for _ in range(500):
        plant.step(0.0, -3.0 * CAR.mass)
    load = plant.observe(-3.0 * CAR.mass).load
    transfer = load[0] + load[1] - CAR.mass * GRAVITY * CAR.cg_to_rear_axle / CAR.wheelbase
    assert transfer == pytest.approx(CAR.mass * 3.0 * CAR.cg_height / CAR.wheelbase, rel=1e-3)


def front_force_after_step(effects, steps):
    plant = Plant(CAR, resolve_settings("ideal", ["yaw_inertia_factor=2", "mass_factor=2", *effects]))
    plant.place(0.0, 0.0, 0.0, 10.0)
    for _ in range(steps):
        plant.step(0.01 * CAR.steering_ratio, 0.0)
    lateral = plant.observe(0.0).lateral_force
    return lateral[0] + lateral[1]


@pytest.mark.parametrize(("seconds", "share"), [(0.01, 1 - math.exp(-0.2)), (0.03, 1 - math.exp(-0.6))])
def test_tyre_relaxation_has_the_time_constant_length_over_speed(seconds, share):
    """0.5 m at 10 m/s: a time constant of 50 ms after a steering step. Mass is doubled so that slip hardly changes."""
    delayed = front_force_after_step(["relaxation_length=0.5"], round(seconds / STEP))
    assert delayed / front_force_after_step([], round(seconds / STEP)) == pytest.approx(share, abs=0.06)


def test_combined_slip_reduces_lateral_force_by_the_friction_ellipse():
    """Braking in the same state: F_y of each front wheel is reduced by sqrt(1 - (F_x / peak)^2)."""
    free, combined = steady([]), steady(["combined_slip=1"])
    combined.state = free.state
    free, combined = free.observe(-6.0 * CAR.mass), combined.observe(-6.0 * CAR.mass)
    for wheel in (0, 1):
        peak = tyre_force(make_tyre_coefficients(CAR.tyre_front, 1.0), 0.0, free.load[wheel], 1.0)[1]
        share = math.sqrt(1 - (free.longitudinal_force[wheel] / peak) ** 2)
        assert share < 0.9
        assert combined.lateral_force[wheel] == pytest.approx(share * free.lateral_force[wheel])


def test_bank_accelerates_to_the_low_side_by_gravity():
    plant = Plant(CAR, resolve_settings("ideal", ["bank_angle=0.05"]))
    plant.place(0.0, 0.0, 0.0, 10.0)
    # Without slip there is no tyre force, only gravity.
    assert plant.observe(0.0).acceleration_y == pytest.approx(-GRAVITY * math.sin(0.05), rel=1e-6)


def test_crosswind_force_depends_on_the_heading():
    forces = []
    for yaw in (0.0, math.pi):
        plant = Plant(CAR, resolve_settings("ideal", ["wind_speed=15"]))
        plant.place(0.0, 0.0, yaw, 10.0)
        plant.conditions = plant.environment.advance(0.0, yaw)
        forces.append(plant.observe(0.0).acceleration_y * CAR.mass)
    # 1/2 rho A |w| w_y with a headwind of 10 m/s and a crosswind of 15 m/s.
    assert forces[0] == pytest.approx(0.5 * 1.2 * 2.5 * math.hypot(10, 15) * 15, rel=1e-6)
    assert forces[1] == pytest.approx(-forces[0], rel=1e-6)


def test_hillside_height_depends_on_position_only():
    """Height depends on the position only, not on the path to it."""
    plant = Plant(CAR, resolve_settings("ideal", ["hillside_slope=0.05"]))
    plant.place(0.0, 0.0, 0.0, 8.0)
    for _ in range(4000):
        plant.step(2.5, 8000.0 * (8.0 - plant.state[VX]))
    assert abs(plant.state[Y]) > 3.0
    assert plant.state[Z] == pytest.approx(plant.state[Y] * math.tan(0.05), abs=0.02)


def test_friction_patches_are_fixed_on_the_ground():
    environment = Environment(resolve_settings("ideal", ["friction_patch=0.5", "friction_factor=0.9"]), STEP, 0)
    assert [environment.advance(x, 1.0).friction for x in (3.0, 12.0, 45.0, -35.0)] == pytest.approx(
        [0.45, 0.9, 0.45, 0.45]
    )


def test_gusts_have_the_set_standard_deviation_and_depend_on_the_seed():
    settings = resolve_settings("ideal", ["gust_speed=4", "wind_speed=3"])
    environments = [Environment(settings, STEP, seed) for seed in (1, 1, 2)]
    winds = [np.array([e.advance(0.0, 0.0).wind_y for _ in range(200_000)]) for e in environments]
    assert winds[0].std() == pytest.approx(4.0, rel=0.1)
    assert winds[0].mean() == pytest.approx(3.0, abs=1.0)
    assert (winds[0] == winds[1]).all() and (winds[0] != winds[2]).any()


def test_cg_shift_changes_the_axle_loads():
    forward = steady(["cg_shift=0.2"])
    load = forward.observe(300.0).load
    assert load[0] / load[2] > 1.5
    assert forward.constants.to_front == pytest.approx(CAR.cg_to_front_axle - 0.2)


def test_driver_tremor_has_the_set_size_and_depends_on_the_seed():
    def steering_wheel(effects, seed):
        car = SimulatedCar(CAR, resolve_settings("ideal", effects), load_plan("S2"), seed)
        angles = []
        for i in range(2000):
            car.advance(0.01 * i)
            angles.append(car.driver.steering_wheel_angle)
        return np.array(angles)

    steady_hands, trembling = steering_wheel([], 1), steering_wheel(["driver_tremor=0.02"], 1)
    assert 0.01 < (trembling - steady_hands).std() < 0.03
    assert (trembling == steering_wheel(["driver_tremor=0.02"], 1)).all()
    assert (trembling != steering_wheel(["driver_tremor=0.02"], 2)).any()


def test_presets_and_plant_files_are_resolved(tmp_path):
    assert find_overrides(IDEAL) == {}
    assert find_overrides(REALISTIC)["relaxation_length"] == 0.4
    assert set(PRESETS) == {"ideal", "realistic"}
    file = tmp_path / "windy.yaml"
    file.write_text("preset: realistic\nwind_speed: 12\n")
    settings = resolve_settings(str(file), ["bank_angle=0.02"])
    assert {k: v for k, v in settings.items() if v != REALISTIC[k]} == {"wind_speed": 12.0, "bank_angle": 0.02}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wind: 3", "wind: unknown setting"),
        ("wind_speed: 99", "wind_speed: 99 is not within -40 to 40 m/s"),
        ("wind_speed: fast", "wind_speed: 'fast' is not within"),
        ("preset: perfect", "preset: 'perfect' is not one of"),
        ("- 1", "not a mapping"),
        ("a: [", "not valid YAML"),
    ],
)
def test_invalid_plant_file_is_rejected_with_its_name(tmp_path, text, message):
    file = tmp_path / "plant.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=r"^[^\n]*plant\.yaml[^\n]*$") as caught:
        resolve_settings(str(file))
    assert message in str(caught.value)


@pytest.mark.parametrize("effect",
                         ["bank_angle", "bank_angle=", "bank_angle=x", "bank_angle=nan", "bank_angle=2", "b=1"])
def test_invalid_effect_is_rejected_with_its_option(effect):
    with pytest.raises(ConfigurationError, match="--effect"):
        resolve_settings("ideal", [effect])
