"""What is known to be wrong with a recording is taken back: a drive spoilt and corrected is the drive it was."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.corrections import CHANNELS, Correction, apply_corrections, check_corrections, describe_corrections
from st_core.errors import StCoreError
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog
from st_core.types import body_to_map
from st_core.vehicle import VehicleParameters
from support import ROOT

LEAF = VehicleParameters.from_yaml((ROOT / "config/vehicle/leaf.yaml").read_text(), "leaf.yaml")
SIGNALS = (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)


def motion(t: np.ndarray) -> dict[str, np.ndarray]:
    """A car that weaves and sways at 8 m/s; smooth, so that it is known at every instant."""
    yaw = 0.6 * np.sin(0.4 * t)
    return {"x": 7.0 * t, "y": 3.0 * np.sin(0.5 * t), "yaw": yaw, "velocity_x": 8.0 + np.sin(0.3 * t),
            "velocity_y": 0.4 * np.cos(0.7 * t), "yaw_rate": 0.24 * np.cos(0.4 * t),
            "acceleration_x": 0.3 * np.cos(0.3 * t), "acceleration_y": 2.0 * np.cos(0.4 * t)}


def drive(seconds: float = 20.0, late: dict[str, float] | None = None) -> DriveLog:
    """late: channels that show at each stamp what was true so many seconds before."""
    t = np.arange(0.0, seconds, 0.01)
    values = motion(t) | {name: motion(t - by)[name] for name, by in (late or {}).items()}
    time_ns = np.round(t * 1e9).astype(np.int64)
    wheel = 1.5 * np.sin(0.4 * t)
    log = DriveLog("drive", time_ns, **values, steering_time_ns=time_ns, road_wheel_angle=0 * t,
                   steering_wheel_angle=wheel)
    return log.with_steering(LEAF)


def assert_same(log: DriveLog, true: DriveLog, within: float = 1e-12) -> None:
    """At the stamps that are left."""
    rows = np.searchsorted(true.ins_time_ns, log.ins_time_ns)
    np.testing.assert_array_equal(true.ins_time_ns[rows], log.ins_time_ns)
    for name in SIGNALS:
        np.testing.assert_allclose(getattr(log, name), getattr(true, name)[rows], atol=within, err_msg=name)
    np.testing.assert_array_equal(log.steering_time_ns, true.steering_time_ns)
    np.testing.assert_allclose(log.road_wheel_angle, true.road_wheel_angle, atol=within)


def test_nothing_to_correct_leaves_the_drive_alone() -> None:
    log = drive()
    assert apply_corrections(log, {}) is log
    assert_same(apply_corrections(log, {"x": Correction(), "steering": Correction()}), log)


@pytest.mark.parametrize("channel", [name for name, takes in CHANNELS.items() if "scale" in takes and "add" in takes])
def test_scale_and_bias_of_every_channel(channel: str) -> None:
    true = drive()
    name = "road_wheel_angle" if channel == "steering" else channel
    spoilt = replace(true, **{name: (getattr(true, name) - 0.3) / -2.5})
    if name == "road_wheel_angle":  # the sensor sits at the steering wheel
        wheel = LEAF.steering_wheel_offset + (spoilt.road_wheel_angle) * LEAF.steering_ratio
        spoilt = replace(spoilt, steering_wheel_angle=wheel)
    corrected = apply_corrections(spoilt, {channel: Correction(scale=-2.5, add=0.3)}, LEAF)
    assert_same(corrected, true, 1e-9)
    assert_same(corrected.with_steering(LEAF), true, 1e-9)
    assert apply_corrections(spoilt, {channel: Correction(scale=-2.5, add=0.31)}, LEAF).name == "drive"
    with pytest.raises(AssertionError):
        assert_same(apply_corrections(spoilt, {channel: Correction(scale=-2.5, add=0.31)}, LEAF), true, 1e-9)


@pytest.mark.parametrize(("pair", "names"), [("position", ("x", "y")), ("velocity", ("velocity_x", "velocity_y"))])
def test_pairs_are_scaled_together_and_after_their_own(pair: str, names: tuple[str, str]) -> None:
    true = drive()
    spoilt = replace(true, **{name: getattr(true, name) / 3.6 for name in names})
    assert_same(apply_corrections(spoilt, {pair: Correction(scale=3.6)}), true, 1e-9)
    spoilt = replace(spoilt, **{names[0]: getattr(spoilt, names[0]) - 1.0})
    assert_same(apply_corrections(spoilt, {pair: Correction(scale=3.6), names[0]: Correction(add=1.0)}), true, 1e-9)


@pytest.mark.parametrize("channel", [name for name, takes in CHANNELS.items() if "earlier" in takes])
@pytest.mark.parametrize("late", [0.31, 0.004, -0.1])
def test_a_channel_that_comes_late(channel: str, late: float) -> None:
    true = drive()
    names = {"position": ("x", "y"), "velocity": ("velocity_x", "velocity_y")}.get(channel, (channel,))
    correction = {channel: Correction(earlier=late)}
    if channel in ("steering", "road_wheel_angle"):
        spoilt = replace(true, steering_time_ns=true.steering_time_ns + round(late * 1e9))
        assert_same(apply_corrections(spoilt, correction, LEAF), true)
        return
    corrected = apply_corrections(drive(late=dict.fromkeys(names, late)), correction)
    if channel in OPTIONAL_INS_SIGNALS:
        lost = np.isnan(getattr(corrected, channel))
        assert lost.sum() == np.ceil(abs(late) / 0.01 - 1e-6) and len(corrected.x) == len(true.x)
        corrected = corrected.select_ins(~lost)
    else:
        assert len(true.x) - len(corrected.x) == np.ceil(abs(late) / 0.01 - 1e-6)
    assert_same(corrected, true, 1e-4)


def test_gaps_are_not_bridged() -> None:
    log = drive(late={"yaw_rate": 0.1})
    seconds = log.ins_time_ns * 1e-9
    log = log.select_ins((seconds < 5.0) | (seconds > 5.5))
    corrected = apply_corrections(log, {"yaw_rate": Correction(earlier=0.1)})
    assert_same(corrected, drive(), 1e-4)
    left = corrected.ins_time_ns * 1e-9
    # What the yaw rate was in the last 0.1 s before the gap was recorded in the gap.
    assert not ((left > 4.9) & (left < 5.5)).any() and np.isclose(left[left > 5.0].min(), 5.51)


def test_a_turned_ins_keeps_the_velocity_over_ground() -> None:
    log = drive()
    turned = apply_corrections(log, {"heading": Correction(add=-0.0098)})
    np.testing.assert_allclose(turned.yaw, log.yaw - 0.0098)
    for before, after in zip(body_to_map(log.velocity_x, log.velocity_y, log.yaw),
                             body_to_map(turned.velocity_x, turned.velocity_y, turned.yaw), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-12)
    # Reported 0.0098 too far left, a car that goes straight shows a velocity to the right.
    straight = replace(log, velocity_y=0.0098 * -log.velocity_x)
    assert np.abs(apply_corrections(straight, {"heading": Correction(add=-0.0098)}).velocity_y).max() < 1e-5
    assert_same(apply_corrections(turned, {"heading": Correction(add=0.0098)}), log)


def test_the_point_of_the_positions_is_moved_along_the_car() -> None:
    true = drive()
    spoilt = replace(true, x=true.x + 1.5 * np.cos(true.yaw), y=true.y + 1.5 * np.sin(true.yaw))
    assert_same(apply_corrections(spoilt, {"position": Correction(ahead=-1.5)}), true)
    askew = replace(spoilt, yaw=true.yaw - 0.1)
    corrections = {"position": Correction(ahead=-1.5), "yaw": Correction(add=0.1)}
    np.testing.assert_allclose(apply_corrections(askew, corrections).y, true.y, atol=1e-12)


def test_stretches_left_out_count_from_the_first_recorded_sample() -> None:
    log = drive()
    log = replace(log, ins_time_ns=log.ins_time_ns + 10**18)
    left = apply_corrections(log, {"x": Correction(earlier=0.5)}, leave_out=((0.0, 1.0), (12.0, 14.5)))
    seconds = (left.ins_time_ns - 10**18) * 1e-9
    assert seconds[0] == pytest.approx(1.01) and not ((seconds > 11.5) & (seconds < 14.5)).any()
    assert len(left.steering_time_ns) == len(log.steering_time_ns)
    assert len(apply_corrections(log, {}, leave_out=((0.0, 100.0),)).x) == 0


def test_accelerations_that_are_not_known_stay_so() -> None:
    log = drive()
    some = np.where(np.arange(len(log.x)) % 50 == 7, np.nan, log.acceleration_y)
    corrected = apply_corrections(replace(log, acceleration_y=some),
                                  {"acceleration_y": Correction(scale=9.81, earlier=0.005)})
    assert len(corrected.x) == len(log.x)
    assert np.isnan(corrected.acceleration_y).sum() == 2 * 40 + 1


def test_without_a_vehicle_the_hand_wheel_is_not_passed_on_uncorrected() -> None:
    corrected = apply_corrections(drive(), {"road_wheel_angle": Correction(scale=-1.0)})
    assert corrected.steering_wheel_angle is None
    np.testing.assert_array_equal(corrected.road_wheel_angle, -drive().road_wheel_angle)
    assert apply_corrections(drive(), {"steering": Correction(earlier=0.1)}).steering_wheel_angle is not None


@pytest.mark.parametrize(("corrections", "message"), [
    ({"speed": Correction()}, "speed: unknown channel; known are x, y, position"),
    ({"yaw": Correction(ahead=1.0)}, "yaw: ahead does not apply here; valid are scale, add, earlier"),
    ({"heading": Correction(scale=2.0)}, "heading: scale does not apply here; valid are add"),
    ({"x": Correction(scale=float("nan"))}, "x: scale: nan is not within"),
    ({"x": Correction(earlier=61.0)}, "x: earlier: 61.0 is not within .-60"),
    ({"x": Correction(scale=0.0)}, "x: scale: must not be 0"),
    ({"steering": Correction(), "road_wheel_angle": Correction()}, "are the same channel"),
])
def test_what_cannot_be_meant_is_refused(corrections: dict, message: str) -> None:
    with pytest.raises(StCoreError, match=message):
        check_corrections(corrections)
    with pytest.raises(StCoreError, match=message):
        apply_corrections(drive(), corrections)


def test_nothing_left_is_said() -> None:
    with pytest.raises(StCoreError, match="leave no INS sample"):
        apply_corrections(drive(1.0), {"yaw": Correction(earlier=2.0)})


def test_words() -> None:
    assert describe_corrections({"yaw_rate": Correction(0.0174533, -0.004, 0.31), "position": Correction(ahead=-1.5),
                                 "road_wheel_angle": Correction(scale=-1.0)}) == (
        "yaw_rate x 0.0174533 - 0.004 rad/s, 0.31 s earlier", "position, 1.5 m behind", "road_wheel_angle x -1")
