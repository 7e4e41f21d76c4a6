"""Readings of the simulated sensors, and the effect of each of their settings."""

import math

import numpy as np
import pytest
from st_sim.dynamics import GRAVITY
from st_sim.plant import Truth
from st_sim.sensors import ACCURACY, Ins, SteeringSensor, TransmissionLoss, read_wheel_speeds
from st_sim.settings import SETTINGS, read_vehicle, resolve_settings
from support import LEAF

CAR = read_vehicle(LEAF)


def truth(**changes):
    values = {
        "time": 1.0, "x": 10.0, "y": -4.0, "z": 0.0, "yaw": 0.7, "velocity_x": 8.0, "velocity_y": 0.3, "yaw_rate": 0.5,
        "acceleration_x": 0.4, "acceleration_y": 4.0, "yaw_acceleration": 0.2, "steering_wheel_angle": 1.2,
        "road_wheel_angle": 0.07, "wheel_speed": (7.6, 8.4, 7.6, 8.4),
    }
    return Truth(**{**values, **changes})


def ins(effects=(), seed=0, **changes):
    return Ins(CAR, resolve_settings("ideal", effects), 0.01, seed).read(truth(**changes))


def test_ins_measures_at_its_point_behind_the_cg():
    r = ins()
    assert (r.x, r.y) == pytest.approx((10 - 0.398 * math.cos(0.7), -4 - 0.398 * math.sin(0.7)))
    assert (r.velocity_x, r.velocity_y) == pytest.approx((8.0, 0.3 - 0.5 * 0.398))
    # Level car: the specific force is the acceleration of that point plus g upwards.
    assert r.specific_force == pytest.approx((0.4 + 0.25 * 0.398, 4.0 - 0.2 * 0.398, GRAVITY))
    assert r.rates == pytest.approx((0.0, 0.0, 0.5))


def test_tilted_car_measures_gravity():
    r = ins(acceleration_x=0.0, acceleration_y=0.0, yaw_rate=0.0, yaw_acceleration=0.0, roll=0.05, pitch=0.02)
    # The right side is down: gravity acts to the right, so the specific force along the left axis is + g sin(roll).
    assert r.specific_force == pytest.approx((GRAVITY * 0.02, GRAVITY * 0.05, GRAVITY), abs=0.02)
    assert math.hypot(*r.specific_force) == pytest.approx(GRAVITY)
    turning = ins(roll=0.1, pitch=0.0, roll_rate=0.3)
    assert turning.rates == pytest.approx((0.3, 0.5 * math.sin(0.1), 0.5 * math.cos(0.1)))


def test_noise_has_the_reported_accuracy_and_depends_on_the_seed():
    """The standard deviation over many units is 0.3 to 1.1 times the accuracy that the status channels report."""
    settings = resolve_settings("ideal", ["ins_noise=1"])
    readings = [Ins(CAR, settings, 0.01, seed).read(truth()) for seed in range(400)]
    exact = ins()
    spread = {name: np.std([getattr(r, name) - getattr(exact, name) for r in readings])
              for name in ("x", "y", "velocity_x", "velocity_y", "yaw", "roll", "pitch")}
    for names, limit in ((("x", "y"), ACCURACY["position"]), (("velocity_x", "velocity_y"), ACCURACY["velocity"]),
                         (("yaw",), ACCURACY["heading"]), (("roll", "pitch"), ACCURACY["roll_pitch"])):
        for name in names:
            assert 0.3 * limit < spread[name] < 1.1 * limit, name
    repeated = Ins(CAR, settings, 0.01, 7).read(truth())
    assert repeated == readings[7] and repeated != readings[8]


def test_position_noise_is_correlated_and_rate_noise_is_white():
    unit = Ins(CAR, resolve_settings("ideal", ["ins_noise=1"]), 0.01, 5)
    readings = [unit.read(truth()) for _ in range(2000)]
    x, rate = np.array([r.x for r in readings]), np.array([r.rates[2] for r in readings])
    assert np.std(np.diff(x)) < 0.5 * ACCURACY["position"]
    assert np.corrcoef(x[:-1], x[1:])[0, 1] > 0.8
    assert abs(np.corrcoef(rate[:-1], rate[1:])[0, 1]) < 0.1 and np.std(rate) == pytest.approx(0.002, rel=0.15)


def test_noise_is_small_at_rest():
    def noise(speed):
        unit = Ins(CAR, resolve_settings("ideal", ["ins_noise=1"]), 0.01, 5)
        return np.std([unit.read(truth(velocity_x=speed)).specific_force[2] for _ in range(500)])

    assert noise(0.0) < 0.2 * noise(10.0)


INS_ERRORS = {
    "ins_time_error=0.03": lambda r, exact: r.stamp - exact.stamp == pytest.approx(0.03),
    "ins_misalignment=0.02": lambda r, exact: (
        r.yaw - exact.yaw == pytest.approx(0.02)
        and r.velocity_y - exact.velocity_y == pytest.approx(-0.02 * 8.0, abs=2e-3)
        and math.hypot(r.velocity_x, r.velocity_y) == pytest.approx(math.hypot(exact.velocity_x, exact.velocity_y))
    ),
    "ins_lever_error=0.2": lambda r, exact: (
        r.velocity_y - exact.velocity_y == pytest.approx(0.2 * 0.5)
        and math.dist((r.x, r.y), (exact.x, exact.y)) == pytest.approx(0.2)
    ),
    "yaw_rate_scale=1.02": lambda r, exact: r.rates[2] == pytest.approx(1.02 * exact.rates[2]),
    "velocity_scale=1.02": lambda r, exact: r.velocity_x == pytest.approx(1.02 * exact.velocity_x) and r.x == exact.x,
    "lateral_acceleration_bias=0.15": lambda r, exact: (
        r.specific_force[1] - exact.specific_force[1] == pytest.approx(0.15)),
    # The unit is fixed in the body while the CG moves forward.
    "cg_shift=0.1": lambda r, exact: r.velocity_y - exact.velocity_y == pytest.approx(-0.1 * 0.5),
}


@pytest.mark.parametrize("effect", INS_ERRORS)
def test_ins_error_has_its_size(effect):
    assert INS_ERRORS[effect](ins([effect]), ins())


def test_steering_sensor_has_offset_and_noise():
    assert SteeringSensor(CAR, resolve_settings("ideal"), 0).read(truth()) == pytest.approx(1.2 + math.radians(-2.7))
    noisy = SteeringSensor(CAR, resolve_settings("ideal", ["steering_sensor_noise=0.002"]), 0)
    values = np.array([noisy.read(truth()) for _ in range(2000)])
    assert values.std() == pytest.approx(0.002, rel=0.1)


def test_wheel_speeds_are_unsigned_and_zero_below_a_threshold():
    slow = truth(wheel_speed=(-3.0, 3.2, 0.2, 0.31), velocity_x=0.5)
    wheels, vehicle = read_wheel_speeds(slow, resolve_settings("ideal"))
    assert wheels == [3.0, 3.2, 0.0, 0.31] and vehicle == 0.0
    assert read_wheel_speeds(truth(), resolve_settings("ideal"))[1] == 8.0
    (scaled, *_), vehicle = read_wheel_speeds(truth(), resolve_settings("ideal", ["wheel_speed_scale=1.034"]))
    assert scaled == pytest.approx(7.6 * 1.034) and vehicle == 8.0


def test_losses_have_their_rate_and_outages():
    random = TransmissionLoss(0.2, 0.0, (1, 7))
    assert np.mean([random.is_lost(0.01 * i) for i in range(5000)]) == pytest.approx(0.2, abs=0.02)
    silent = TransmissionLoss(0.0, 10.0, (1, 7))
    assert [silent.is_lost(t) for t in (0.0, 0.5, 9.9, 10.0, 10.9, 11.1, 20.5)] == [0, 0, 0, 1, 1, 0, 1]
    assert not any(TransmissionLoss(0.0, 0.0, (1, 7)).is_lost(t) for t in range(100))


def test_every_sensor_setting_is_tested():
    tested = {e.partition("=")[0] for e in INS_ERRORS} | {
        "ins_noise", "steering_sensor_noise", "wheel_speed_scale",
        # In test_stream.py and test_run.py, which simulate time:
        "ins_latency", "steering_sensor_latency", "ins_packet_loss", "ins_outage_every", "can_frame_loss",
        "can_outage_every", "logger_clock_offset", "logger_clock_drift",
    }
    assert {s.name for s in SETTINGS.values() if s.group in ("ins", "can")} <= tested
