"""Checks accept any finite values without an exception, and report no error for a healthy drive of any kind."""

import json
from dataclasses import replace

import numpy as np
import pytest
from exact_drive import SILENT, SPEED, TURNING, Noise, Sines, exact_drive
from exact_faults import findings_by_name
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from st_core.checks import AuxiliaryData, InsQuality, Series, Severity, check
from st_core.checks.motion import Motion
from st_core.checks.vehicle_relations import check_tyre_limit
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog

FAST = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.generate,))
STRAIGHT = Sines(0.0, ())
CHANNELS = (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS, "road_wheel_angle")


def errors(log, car=None, auxiliary=None):
    return [finding.text for finding in check(log, car, auxiliary).findings if finding.severity is Severity.ERROR]


def with_rotated_map(log, angle):
    place = (log.x + 1j * log.y) * np.exp(1j * angle)
    return replace(log, x=place.real, y=place.imag, yaw=log.yaw + angle)


def with_reversed_ins(log):
    """The INS is mounted facing backwards; yaw, velocities and accelerations are consistent with that."""
    names = ("velocity_x", "velocity_y", "acceleration_x", "acceleration_y")
    return replace(log, yaw=log.yaw + np.pi, **{name: -getattr(log, name) for name in names})


HEALTHY = {
    "5 s": {"seconds": 5.0},
    "15 s": {"seconds": 15.0},
    "10 min at 10 Hz": {"seconds": 600.0, "rate": 10.0},
    "1 Hz": {"seconds": 300.0, "rate": 1.0},
    "5 Hz": {"seconds": 120.0, "rate": 5.0},
    "1 kHz": {"seconds": 20.0, "rate": 1000.0},
    "without noise": {"noise": SILENT},
    "straight": {"turning": STRAIGHT},
    "constant yaw rate": {"turning": Sines(0.15, ())},
    "constant speed": {"speed": Sines(12.0, ())},
    "slow": {"speed": Sines(2.5, ((0.5, 31.0, 0.0),))},
    "stop and go": {"speed": Sines(5.0, ((5.0, 30.0, 0.0),)), "turning": Sines(0.0, ((0.05, 23.0, 0.0),))},
    "creeping": {"speed": Sines(0.3, ()), "turning": Sines(0.002, ())},
    "poor INS": {"noise": Noise(0.05, 0.003, 0.05, 0.01, 0.3, 0.005)},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", HEALTHY)
def test_healthy_drive_of_any_kind_has_no_error(leaf, kind):
    assert errors(exact_drive(leaf, **HEALTHY[kind]), leaf) == []


@pytest.mark.slow
@pytest.mark.parametrize("change", [
    lambda log: replace(log, x=log.x + 5e5, y=log.y + 5e6),
    lambda log: replace(log, yaw=log.yaw + 20.0 * np.pi),
    lambda log: replace(log, yaw=log.yaw - 200.0 * np.pi),
    lambda log: with_rotated_map(log, 2.1),
    lambda log: replace(log, ins_time_ns=log.ins_time_ns % 10**12, steering_time_ns=log.steering_time_ns % 10**12),
    lambda log: replace(log, acceleration_x=None, acceleration_y=None, steering_wheel_angle=None),
    lambda log: replace(log, acceleration_y=np.full(len(log.x), np.nan)),
    lambda log: replace(log, steering_time_ns=log.steering_time_ns[::5], road_wheel_angle=log.road_wheel_angle[::5],
                        steering_wheel_angle=None),
    lambda log: replace(log, steering_time_ns=np.zeros(0, np.int64), road_wheel_angle=np.zeros(0),
                        steering_wheel_angle=None),
    lambda log: replace(log, steering_time_ns=log.steering_time_ns + 10**13),
    lambda log: log.select_ins(slice(0)),
], ids=["UTM", "10 turns of yaw", "-100 turns of yaw", "rotated map", "other epoch", "no auxiliary channels", "no a_y",
        "slow steering", "no steering", "steering of another day", "no INS"])
def test_healthy_drive_with_a_different_origin_or_fewer_channels_has_no_findings(leaf, change):
    assert check(change(exact_drive(leaf)), leaf).findings == ()


def test_estimates_do_not_depend_on_the_origin(leaf):
    drive = exact_drive(leaf)
    wrong = replace(drive, x=0.98 * drive.x, yaw_rate=drive.yaw_rate + 0.02)
    moved = replace(wrong, x=wrong.x + 5e5, y=wrong.y + 5e6, yaw=wrong.yaw + 40.0 * np.pi,
                    ins_time_ns=wrong.ins_time_ns - 10**18, steering_time_ns=wrong.steering_time_ns - 10**18)
    estimates, estimates_moved = (check(log, leaf).estimates for log in (wrong, moved))
    assert estimates.keys() == estimates_moved.keys()
    for name, values in estimates.items():
        assert values == pytest.approx(estimates_moved[name], abs=1e-5), name


def test_driving_in_reverse_or_a_reversed_ins_is_not_an_error(leaf):
    assert errors(with_reversed_ins(exact_drive(leaf)), leaf) == []
    reverse = exact_drive(leaf, speed=Sines(-3.0, ((1.0, 31.0, 0.0),)), turning=Sines(0.0, ((0.1, 23.0, 0.0),)))
    assert errors(reverse, leaf) == []
    forward_and_reverse = exact_drive(leaf, speed=Sines(0.0, ((4.0, 40.0, 0.0),)),
                                      turning=Sines(0.0, ((0.05, 23.0, 0.0),)))
    assert errors(forward_and_reverse, leaf) == []


@pytest.mark.parametrize("noise", [SILENT, Noise()])
def test_stationary_car_has_no_findings(leaf, noise):
    stationary = exact_drive(leaf, speed=Sines(1e-9, ()), turning=STRAIGHT, noise=noise)
    assert [finding.text for finding in check(stationary, leaf).findings] == []


def test_motion_reported_at_standstill_is_found(leaf):
    stationary = exact_drive(leaf, speed=Sines(1e-9, ()), turning=STRAIGHT)
    biased = replace(stationary, velocity_x=stationary.velocity_x + 0.3, yaw_rate=stationary.yaw_rate - 0.02)
    findings = {finding.channels: finding for finding in check(biased, leaf).findings
                if finding.name == "standstill_motion"}
    assert findings["velocity_x",].value == pytest.approx(0.3, abs=0.01)
    assert findings["yaw_rate",].value == pytest.approx(-0.02, abs=0.001)


def test_car_on_a_ferry_or_a_chassis_dynamometer_has_no_scale_error(leaf):
    log = exact_drive(leaf, noise=Noise())
    time = 1e-9 * (log.ins_time_ns - log.ins_time_ns[0])
    still = exact_drive(leaf, speed=Sines(1e-9, ()), turning=STRAIGHT, noise=Noise())
    ferry = findings_by_name(replace(still, x=still.x + 8.0 * time, y=still.y + 6.0 * time), leaf)
    bench = findings_by_name(replace(still, velocity_x=log.velocity_x), leaf)
    for found, value in ((ferry, 10.0), (bench, np.median(log.velocity_x))):
        assert found["standstill_motion"].value == pytest.approx(value, rel=0.05)
        assert not [name for name in found if name.endswith("_scale") or name == "velocity_axes"]
    assert "on a ferry or trailer" in ferry["standstill_motion"].text and "position_noise" not in ferry
    # Nothing but the motion itself shows a loss of positions, which must not be compared with predictions.
    lost = findings_by_name(replace(log, x=still.x, y=still.y), leaf)
    for found in (bench, lost):
        assert [*found] == ["standstill_motion"] and found["standstill_motion"].severity is Severity.ERROR
        assert "on a chassis dynamometer, or did the receiver lose its position" in found["standstill_motion"].text


@pytest.mark.parametrize("noise, scale", [(1.0, 1.0), (4.0, 1.0), (0.004, 1000.0)])
def test_position_noise_of_a_stationary_car_is_not_a_ferry(leaf, noise, scale):
    still = exact_drive(leaf, speed=Sines(1e-9, ()), turning=STRAIGHT, noise=Noise(position=noise))
    assert "standstill_motion" not in findings_by_name(replace(still, x=scale * still.x, y=scale * still.y), leaf)


@pytest.mark.parametrize("vibration", [0.0, 0.1])
def test_uphill_helix_is_not_a_turned_accelerometer(leaf, vibration):
    """With vibration [m/s^2], the braking is too weak to show the angle that the slope in the bends imitates."""
    log = exact_drive(leaf, 120.0, speed=Sines(4.0, ((1.0 if vibration == 0.0 else 0.3, 17.0, 0.0),)),
                      turning=Sines(0.2, ((0.2, 40.0, 0.0),)), noise=Noise())
    slope = 0.08 * np.clip(log.yaw_rate / 0.4, 0.0, 1.0)  # rad
    noise = 20.0 * vibration * gaussian_filter1d(np.random.default_rng(1).standard_normal((2, len(slope))), 50.0)
    assert "acceleration_axes" not in findings_by_name(replace(
        log, acceleration_x=log.acceleration_x + 9.81 * np.sin(slope) + noise[0],
        acceleration_y=log.acceleration_y + noise[1]), leaf)


@pytest.mark.parametrize("channel", ["acceleration_x", "acceleration_y"])
@pytest.mark.parametrize("factor", [2.0, 1.0 / 9.81])
def test_scale_error_of_one_acceleration_is_not_a_turned_accelerometer(leaf, channel, factor):
    log = exact_drive(leaf, 120.0, speed=Sines(12.0, ((3.0, 9.0, 0.0), (1.0, 23.0, 0.2))), turning=Sines(
        0.02, ((0.14, 9.0, 0.9), (0.05, 5.3, 0.3))), noise=Noise())  # a_x and a_y have a correlation of 0.7
    found = findings_by_name(replace(log, **{channel: factor * getattr(log, channel)}), leaf)
    assert [*found] == [f"{channel}_scale"] and found[f"{channel}_scale"].value == pytest.approx(factor, rel=0.02)


def drifting(car, sideslip, turning):
    """A drive at 11 m/s with this sideslip [rad] and rate of the course [rad/s]; the driver countersteers."""
    time = np.arange(0.0, 80.0, 0.01)
    beta, course_rate = sideslip(time), turning(time)
    v, rate = 11.0 * np.exp(1j * beta), course_rate - np.gradient(beta, time)
    yaw = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))))
    lateral = v.imag + car.cg_to_ins_x * rate
    velocity = (v.real + 1j * lateral) * np.exp(1j * yaw)
    place = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time))))
    front_force = car.mass * 11.0 * course_rate * car.cg_to_rear_axle / car.wheelbase
    angle = np.arctan((v.imag + car.cg_to_front_axle * rate) / v.real) + front_force / car.cornering_stiffness_front
    deviations = np.array([[0.003, 0.003, 0.0005, 0.01, 0.01, 0.002]]).T
    ns = 1_700_000_000_000_000_000 + np.round(1e9 * time).astype(np.int64)
    signals = (place.real, place.imag, yaw, v.real, lateral, rate)
    return DriveLog("drift", ns, *np.random.default_rng(0).normal(signals, deviations), ns, np.clip(angle, -0.65, 0.65))


@pytest.mark.parametrize("kind", ["one way", "both ways", "donut"])
def test_drifting_car_has_no_fault(leaf, kind):
    side = {"both ways": lambda t: np.tanh(3.0 * np.sin(0.26 * t))}.get(kind, lambda t: 0.5 + 0.5 * np.tanh(t - 10.0))
    angle, rate = {"donut": (1.0, 1.1)}.get(kind, (0.6, 0.44))
    drive = drifting(leaf, lambda t: -angle * side(t) * (1.0 + 0.1 * np.sin(t)), lambda t: rate * side(t))
    assert findings_by_name(drive, leaf) == {}


def on_slopes(log, grade, bank):
    """The drive with an INS fixed to the body on a road with this grade and bank [rad]."""
    forward, lateral = np.cos(grade), np.cos(bank)
    return replace(log, velocity_x=log.velocity_x / forward, velocity_y=log.velocity_y / lateral,
                   yaw_rate=log.yaw_rate * forward * lateral,
                   acceleration_x=log.acceleration_x + 9.81 * np.sin(grade),
                   acceleration_y=log.acceleration_y * lateral - 9.81 * np.sin(bank))


@pytest.mark.parametrize(("grade", "bank", "name"), [
    (lambda log: 0.12 * np.tanh(9.0 * np.sin(0.03 * log.x)), lambda log: 0.0, "velocity_scale"),
    (lambda log: 0.0, lambda log: 0.3 * np.tanh(20.0 * log.yaw_rate), "yaw_rate_scale")])
def test_slope_and_banked_bends_are_no_scale_error(leaf, grade, bank, name):
    log = exact_drive(leaf, 120.0)
    sloping = on_slopes(log, grade(log), bank(log))
    assert findings_by_name(sloping, leaf).keys() <= {"acceleration_x_bias", "acceleration_y_bias"}
    level = replace(sloping, acceleration_x=log.acceleration_x, acceleration_y=log.acceleration_y)
    assert findings_by_name(level, leaf)[name].alternatives == ()
    unknown = findings_by_name(replace(level, acceleration_x=None, acceleration_y=None), leaf)
    if name == "yaw_rate_scale":
        assert unknown[name].text.endswith("or the road is banked: both fit this drive")


def test_lateral_acceleration_beyond_tyre_limits_is_an_error_unless_positions_confirm_it(leaf):
    downforce = exact_drive(leaf, turning=Sines(0.0, ((1.5, 23.0, 0.0),)))
    finding = findings_by_name(downforce, leaf)["lateral_acceleration_impossible"]
    assert finding.severity is Severity.NOTE and finding.value == pytest.approx(1.5 * SPEED.mean, rel=0.4)
    assert errors(downforce, leaf) == []
    single_bends = exact_drive(leaf, turning=Sines(0.0, ((0.74, 1.5, 0.0),)), speed=Sines(20.0, ()))
    assert errors(single_bends, leaf) == []
    motion = Motion.from_log(exact_drive(leaf), 0, AuxiliaryData())
    wrong = replace(motion, yaw_rate=motion.yaw_rate + 1.0)
    (finding,) = check_tyre_limit(wrong, sideslip_measured=True)
    assert finding.severity is Severity.ERROR and finding.channels == ("velocity_x", "velocity_y", "yaw_rate")
    assert check_tyre_limit(wrong, sideslip_measured=False) == []  # as in a spin


@pytest.mark.parametrize("count", [0, 1, 2, 3, 49, 50, 60])
def test_recording_of_few_samples_has_no_findings(leaf, count):
    log = exact_drive(leaf, 5.0)
    short = replace(log.select_ins(np.arange(count)), steering_time_ns=log.steering_time_ns[:count],
                    road_wheel_angle=log.road_wheel_angle[:count], steering_wheel_angle=None)
    assert check(short, leaf).findings == ()


NUMBERS = st.one_of(st.just(0.0), st.floats(-1e12, 1e12), st.floats(-10.0, 10.0))
SHAPES = st.sampled_from(("constant", "white", "walk", "steps", "one spike", "grid"))


def synthetic_channel(shape, size, count, draw):
    return size * {
        "constant": np.ones(count), "white": draw.standard_normal(count),
        "walk": np.cumsum(draw.standard_normal(count)),
        "steps": np.repeat(draw.standard_normal(-(-count // 40)), 40)[:count], "grid": draw.integers(-3, 4, count),
        "one spike": np.arange(count) == count // 2}[shape]


@FAST
@given(count=st.sampled_from((50, 70, 400, 3000)), shapes=st.tuples(*[SHAPES] * len(CHANNELS)),
       sizes=st.tuples(*[NUMBERS] * len(CHANNELS)), spacing=st.sampled_from((1, 10**3, 10**7, 10**9, 10**13)),
       seed=st.integers(0, 1000))
def test_any_finite_values_give_a_valid_result(leaf, count, shapes, sizes, spacing, seed):
    draw = np.random.default_rng(seed)
    rows = [synthetic_channel(shape, size, count, draw) for shape, size in zip(shapes, sizes, strict=True)]
    time = np.cumsum(draw.integers(1, 3, count)) * spacing
    log = DriveLog("synthetic", ins_time_ns=time, steering_time_ns=time, **dict(zip(CHANNELS, rows, strict=True)))
    assert_valid(check(log, leaf, auxiliary_data(time, rows)))


@pytest.mark.slow
@FAST
@given(channels=st.dictionaries(st.sampled_from((*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)), st.tuples(SHAPES, NUMBERS),
                                min_size=1, max_size=3), seed=st.integers(0, 1000))
def test_any_invalid_channels_give_a_valid_result(leaf, channels, seed):
    log, draw = exact_drive(leaf, 20.0), np.random.default_rng(seed)
    assert_valid(check(replace(log, **{name: synthetic_channel(shape, size, len(log.x), draw)
                                   for name, (shape, size) in channels.items()}), leaf))


def auxiliary_data(time, rows):
    return AuxiliaryData({"INS": time[::-1], "steering": time}, {"x": 3}, Series(time, rows[3]),
                         Series(time[:1], rows[4][:1]), InsQuality(time, rows[5], rows[6], rows[7]))


def assert_valid(checked):
    """Values are finite, intervals contain them, and the result is JSON-serialisable."""
    for finding in checked.findings:
        assert finding.value is None or np.isfinite(finding.value), finding
        assert finding.interval is None or finding.interval[0] <= finding.value <= finding.interval[1], finding
        assert finding.effect is None or finding.effect >= 0.0, finding
        assert finding.text and "nan" not in finding.text and finding.advice and finding.advice.line
        assert all(first <= last for first, last in finding.times)
    json.dumps(checked.as_dict(), allow_nan=False)


def test_wrong_yaw_rate_unit_is_found_at_constant_yaw_rate(leaf):
    """Without changes of the yaw rate only its level can be compared."""
    bend = exact_drive(leaf, turning=Sines(TURNING.mean + 0.1, ()))
    degrees = replace(bend, yaw_rate=57.3 * bend.yaw_rate)
    assert [finding.name for finding in check(degrees, leaf).with_severity(Severity.ERROR)] == ["yaw_rate_scale"]
