"""Radius, accelerations, speeds and heading changes of each scenario."""

import math
from functools import cache

import numpy as np
import pytest
from st_core.errors import ConfigurationError
from st_sim.driver import MAX_STEERING_WHEEL_RATE, SimulatedCar
from st_sim.path import Path, SpeedProfile, lane_shift, straight, turn
from st_sim.scenarios import SCENARIOS, load_plan
from st_sim.settings import read_vehicle, resolve_settings
from support import LEAF, ROOT

CAR = read_vehicle(LEAF)
RATE = 50
COLUMNS = ("t", "x", "y", "yaw", "vx", "vy", "r", "ax", "ay", "steering_wheel", "force")


class Drive:
    """A simulated scenario at 50 Hz, SI; the columns are attributes, `force` is the drive force at the wheels."""

    def __init__(self, name, seconds, plant="realistic", seed=0):
        car = SimulatedCar(CAR, resolve_settings(plant), load_plan(name), seed)
        rows = []
        for i in range(seconds * RATE):
            car.advance(i / RATE)
            t = car.make_truth()
            motion = t.velocity_x, t.velocity_y, t.yaw_rate, t.acceleration_x, t.acceleration_y
            rows.append((t.time, t.x, t.y, t.yaw, *motion, t.steering_wheel_angle, car.driver.drive_force))
        for name_, column in zip(COLUMNS, np.array(rows).T, strict=True):
            setattr(self, name_, column)

    def find_radius(self, rows=slice(None)):
        """Radius of the path of the CG: least-squares circle through the positions."""
        x, y = self.x[rows], self.y[rows]
        cx, cy, c = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones_like(x)]), x**2 + y**2, rcond=None)[0]
        return math.sqrt(c + cx**2 + cy**2)


@cache
def drive_circle(name, plant="realistic"):
    return Drive(name, 12, plant)


@pytest.mark.parametrize("plant", ["ideal", "realistic"])
@pytest.mark.parametrize(("name", "a_y"), [("S2", 1.5), ("S3", 3.77), ("S4", 6.37)])
def test_circles_have_their_radius_and_acceleration(name, a_y, plant):
    d = drive_circle(name, plant)
    assert d.find_radius() == pytest.approx(11.5, abs=0.03)
    assert d.ay.mean() == pytest.approx(a_y, rel=0.02)
    assert d.vx.mean() == pytest.approx(math.sqrt(a_y * 11.5), rel=0.01)
    assert (d.r > 0).all() and d.ay.std() < 0.05


@pytest.mark.parametrize(
    ("name", "road_wheel_deg", "v_y"),
    # Values of the real car in the paper's error table, paper_notes.md.
    [("S3", 14.20, 0.63), ("S4", 15.21, 0.68)],
)
def test_steering_of_the_realistic_car_equals_that_of_the_real_one(name, road_wheel_deg, v_y):
    d = drive_circle(name)
    assert math.degrees(d.steering_wheel.mean()) / CAR.steering_ratio == pytest.approx(road_wheel_deg, rel=0.02)
    assert d.vy.mean() == pytest.approx(v_y, abs=0.08)


def test_s1_is_a_closed_figure_eight():
    d = Drive("S1", 60)
    assert d.vx.mean() == pytest.approx(4.0, abs=0.05)
    assert np.percentile(d.ay, [2, 98]) == pytest.approx([-16 / 11.5, 16 / 11.5], abs=0.07)
    # Both loops have the same heading change, and the road is closed.
    assert np.ptp(d.yaw) == pytest.approx(math.radians(240), abs=0.1)
    path = load_plan("S1").path
    end = path.pose(path.length * 5)
    assert math.hypot(end.x, end.y) < 0.05 and end.yaw == pytest.approx(0.0, abs=1e-9)


def test_s5_brakes_from_a_right_circle_to_rest_and_restarts():
    d = Drive("S5", 32)
    steady = d.t < 17.5
    assert (d.vx[steady] * d.r[steady]).mean() == pytest.approx(-1.5, rel=0.02)
    moving = d.t < 17.0
    assert d.find_radius(moving) == pytest.approx(10.0, abs=0.03) and d.r[moving].mean() < 0
    stop = int(np.argmax(d.vx == 0.0))
    brake = (d.t > 18.4) & (d.t < d.t[stop] - 0.3)
    assert np.gradient(d.vx, d.t)[brake].mean() == pytest.approx(-1.5, abs=0.08)
    rest = d.t[d.vx == 0.0]
    assert np.ptp(rest) == pytest.approx(4.0, abs=0.3)
    assert d.x[d.vx == 0.0].std() < 1e-9
    assert d.vx[-1] == pytest.approx(math.sqrt(15.0), rel=0.03)


def test_s6_has_u_turns_to_both_sides():
    d = Drive("S6", 70)
    turning = np.abs(d.r) > 0.4
    assert d.vx[turning].mean() == pytest.approx(4.0, abs=0.15)
    assert d.vx.max() == pytest.approx(6.0, abs=0.1) and d.vx.min() == pytest.approx(4.0, abs=0.1)
    first = [np.sign(d.r[turning])[0], *np.sign(d.r[turning])[1:][np.diff(np.flatnonzero(turning)) > RATE // 2]]
    assert first[:3] == [-1, 1, 1]
    path = load_plan("S6").path
    assert path.pose(path.length * (1 - 1e-9)).yaw == pytest.approx(math.pi, abs=1e-3)
    twice = path.pose(2 * path.length)
    assert math.hypot(twice.x, twice.y) < 1e-6


def test_s7_turns_450_degrees_in_a_roundabout():
    d = Drive("S7", 48)
    assert d.vx[0] == pytest.approx(16.0, abs=0.2) and d.vx.min() == pytest.approx(5.0, abs=0.15)
    fast = (d.vx > 15.5) & (d.t < 12)
    assert d.ay[fast].min() == pytest.approx(-(16**2) / 230, abs=0.2)
    slowest = int(np.argmin(d.vx))
    assert d.yaw[slowest:].max() - d.yaw[:slowest].min() == pytest.approx(math.radians(450), abs=0.1)
    assert d.vx[-1] == pytest.approx(16.0, abs=0.3)


def test_sweep_frequency_increases():
    d = Drive("sweep", 26)
    crossings = d.t[1:][np.diff(np.sign(d.steering_wheel)) != 0]
    gaps = np.diff(crossings)
    # The frequency increases from 0.2 Hz already within the first half wave.
    assert 0.2 < 0.5 / gaps[0] < 0.35 and 0.5 / gaps[-2] == pytest.approx(2.8, rel=0.1)
    assert np.abs(d.ay[: 10 * RATE]).max() == pytest.approx(3.0, abs=0.5)
    assert d.vx.min() > 13.8


def test_step_is_within_half_a_second():
    d = Drive("step", 14)
    before, after = d.steering_wheel[int(2.9 * RATE)], d.steering_wheel[int(3.5 * RATE)]
    assert abs(before) < 0.05 and after == pytest.approx(0.09 * CAR.steering_ratio, abs=0.05)
    assert d.ay[5 * RATE] == pytest.approx(3.9, abs=0.4) and d.ay[12 * RATE] == pytest.approx(-3.9, abs=0.4)


def test_lane_change_is_one_lane_wide():
    d = Drive("lane_change", 14)
    assert d.y.max() == pytest.approx(3.5, abs=0.25) and d.y[-1] == pytest.approx(0.0, abs=0.25)
    assert 3.0 < np.abs(d.ay).max() < 5.5


def test_brake_in_turn_holds_the_steering():
    d = Drive("brake_in_turn", 12)
    assert d.ay[6 * RATE] == pytest.approx(4.0, abs=0.15)
    braking = (d.t > 8.6) & (d.vx > 4.0) & (d.t < 11)
    assert braking.sum() > 20
    assert np.gradient(d.vx, d.t)[braking].mean() == pytest.approx(-4.0, abs=0.3)
    # Only the tremor of the driver remains.
    assert np.ptp(d.steering_wheel[braking]) < 0.06


def test_circle_is_driven_to_both_sides_with_constant_steering():
    d = Drive("circle", 30)
    for first, last, side in ((5, 12, 1), (20, 27, -1)):
        steady = (d.t > first) & (d.t < last)
        assert d.ay[steady].mean() == pytest.approx(side * 3.6, abs=0.15) and d.ay[steady].std() < 0.05
        assert np.ptp(d.steering_wheel[steady]) < 0.08
    assert d.vx.mean() == pytest.approx(6.5, abs=0.05)


def test_slalom_and_weave_have_their_frequency_and_acceleration():
    for name, frequency, size in (("slalom", 0.5, 4.0), ("weave", 0.25, 1.0)):
        d = Drive(name, 12)
        assert 0.5 * (np.diff(np.sign(d.steering_wheel)) != 0).sum() / 12 == pytest.approx(frequency, abs=0.1)
        assert np.abs(d.ay).max() == pytest.approx(size, rel=0.12)


def test_there_and_back_returns_to_its_start():
    d = Drive("there_and_back", 39)
    assert math.hypot(d.x[-1] - d.x[0], d.y[-1] - d.y[0]) < 2.0
    east, west = (np.abs(np.remainder(d.yaw - way, 2 * np.pi) - np.pi) > np.pi - 0.02 for way in (0.0, np.pi))
    assert east.sum() > 8 * RATE and west.sum() > 8 * RATE
    assert np.abs(d.ay).max() == pytest.approx(3.0, abs=0.25)


def test_ramp_exceeds_the_limit_of_adhesion():
    d = Drive("ramp_to_limit", 26)
    peak = np.abs(d.ay).max()
    assert peak > 8.0
    # Beyond the limit more steering does not increase the lateral acceleration.
    at_limit = int(np.argmax(np.abs(d.steering_wheel)))
    earlier = int(0.8 * at_limit)
    assert d.steering_wheel[at_limit] > 1.2 * d.steering_wheel[earlier] and d.ay[at_limit] < 1.05 * d.ay[earlier]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_driver_is_limited_and_repeatable(name):
    """Steering wheel rate and rate of the drive force are limited, and equal seeds give equal drives."""
    d, repeated, other = Drive(name, 8), Drive(name, 2), Drive(name, 2, seed=1)
    begin = slice(2 * RATE)
    assert np.abs(np.diff(d.steering_wheel)).max() * RATE <= MAX_STEERING_WHEEL_RATE + 1e-9
    assert np.abs(np.diff(d.force)).max() <= 10.0 * CAR.mass / RATE * 1.3
    assert (d.x[begin] == repeated.x).all() and (d.steering_wheel[begin] == repeated.steering_wheel).all()
    assert (d.steering_wheel[begin] != other.steering_wheel).any()


def test_path_has_its_heading_and_curvature_and_is_continuous():
    path = Path([*straight(10, 5), *turn(20, -90, 5, 4), *straight(10, 5)])
    end = path.pose(path.length * (1 - 1e-12))
    assert end.yaw == pytest.approx(-math.pi / 2, abs=1e-9)
    assert path.curvature(10 + 4 + 1) == pytest.approx(-1 / 20)
    # Continuous at the ends and over any number of rounds.
    for s in (path.length, 3 * path.length, -path.length):
        a, b = path.pose(s - 1e-6), path.pose(s + 1e-6)
        assert math.hypot(a.x - b.x, a.y - b.y) < 1e-5
    shift = Path(lane_shift(3.5, 30, 10))
    assert shift.pose(30 * (1 - 1e-12)).y == pytest.approx(3.5, rel=0.02)
    with pytest.raises(ValueError, match="too short for transitions"):
        turn(5, 30, 4, 10)


def test_speed_profile_observes_its_limits():
    path = Path([*straight(100, 15), *turn(10, 180, 4), *straight(100, 15)])
    profile = SpeedProfile(path, 1.0, 2.0)
    samples = [profile.interpolate(s) for s in np.arange(0, 2 * path.length, 0.2)]
    assert max(v for v, _ in samples) == pytest.approx(15.0) and min(v for v, _ in samples) == pytest.approx(4.0)
    assert max(a for _, a in samples) <= 1.0 + 1e-6 and min(a for _, a in samples) >= -2.0 - 1e-6


def test_road_is_read_from_a_file():
    d = Drive(str(ROOT / "config/manoeuvres/slalom.yaml"), 30)
    assert d.vx.max() == pytest.approx(11.0, abs=0.2) and d.vx.min() == pytest.approx(5.0, abs=0.2)
    assert np.abs(d.ay).max() > 2.0


def test_stop_and_go_has_speed_changes_and_turns_to_both_sides():
    d = Drive(str(ROOT / "config/manoeuvres/stop_and_go.yaml"), 40)
    assert d.vx.max() > 10.0 and d.vx.min() < 5.0
    assert d.ay.max() > 1.5 and d.ay.min() < -1.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("road: [{straight: 10}]", "speed"),
        ("road: [{straight: 10, speed: 0}]", "must be above 0"),
        ("road: [{straight: 10, speed: 5, radius: 3}]", "unknown key radius"),
        ("road: [{turn: 30, radius: 5, blend: 10, speed: 4}]", "too short for transitions"),
        ("roads: []", "road"),
        ("road: []", "no length"),
        ("road: [{straight: -5, speed: 5}, {straight: 9, speed: 5}]", "lengths must not be negative"),
        ("road: [{straight: .nan, speed: 5}]", "at most 20000 m"),
        ("road: [{turn: 90, radius: 1e-300, speed: 5}]", "a radius of at least 0.1 m"),
        ("road: [{shift: .inf, length: 3, speed: 5}]", "a radius of at least 0.1 m"),
        ("road: [3]", "rows of road are"),
        ("road: [{straight: 0, speed: 5}]", "no length"),
        ("road: [{turn: 90, radius: 0, speed: 5}]", "rows of road are"),
        ("road: [{loop: 90, speed: 5}]", "rows of road are"),
        ("[", "not valid YAML"),
    ],
)
def test_invalid_road_is_rejected_with_its_name(tmp_path, text, message):
    file = tmp_path / "road.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=r"^[^\n]*road\.yaml[^\n]*$") as caught:
        load_plan(str(file))
    assert message in str(caught.value)
    with pytest.raises(ConfigurationError, match="--scenario S9"):
        load_plan("S9")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_plan(str(tmp_path / "none.yaml"))
