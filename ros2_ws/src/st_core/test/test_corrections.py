"""Corrections of recorded channels: applying them to a drive with known faults restores the true drive."""

from dataclasses import replace

import numpy as np
import pytest
from st_core.corrections import CHANNELS, Correction, apply_corrections, check_corrections, describe_corrections
from st_core.errors import StCoreError
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, DriveLog
from st_core.types import body_to_map
from support import read_car

LEAF = read_car("leaf")
SIGNALS = (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)


def motion(t: np.ndarray) -> dict[str, np.ndarray]:
    """A car that weaves at 8 m/s, in closed form. t [s]."""
    yaw = 0.6 * np.sin(0.4 * t)
    return {"x": 7.0 * t, "y": 3.0 * np.sin(0.5 * t), "yaw": yaw, "velocity_x": 8.0 + np.sin(0.3 * t),
            "velocity_y": 0.4 * np.cos(0.7 * t), "yaw_rate": 0.24 * np.cos(0.4 * t),
            "acceleration_x": 0.3 * np.cos(0.3 * t), "acceleration_y": 2.0 * np.cos(0.4 * t)}


def drive(seconds: float = 20.0, delays: dict[str, float] | None = None) -> DriveLog:
    """delays: by channel [s]."""
    t = np.arange(0.0, seconds, 0.01)
    values = motion(t) | {name: motion(t - delay)[name] for name, delay in (delays or {}).items()}
    time_ns = np.round(t * 1e9).astype(np.int64)
    steering_wheel = 1.5 * np.sin(0.4 * t)
    log = DriveLog("drive", time_ns, **values, steering_time_ns=time_ns, road_wheel_angle=0 * t,
                   steering_wheel_angle=steering_wheel)
    return log.with_steering(LEAF)


def assert_equal(log: DriveLog, true: DriveLog, tolerance: float = 1e-12) -> None:
    """At the time stamps of `log`."""
    rows = np.searchsorted(true.ins_time_ns, log.ins_time_ns)
    np.testing.assert_array_equal(true.ins_time_ns[rows], log.ins_time_ns)
    for name in SIGNALS:
        np.testing.assert_allclose(getattr(log, name), getattr(true, name)[rows], atol=tolerance, err_msg=name)
    np.testing.assert_array_equal(log.steering_time_ns, true.steering_time_ns)
    np.testing.assert_allclose(log.road_wheel_angle, true.road_wheel_angle, atol=tolerance)


def test_drive_without_corrections_is_unchanged() -> None:
    log = drive()
    assert apply_corrections(log, {}) is log
    assert_equal(apply_corrections(log, {"x": Correction(), "steering": Correction()}), log)


@pytest.mark.parametrize("channel", [name for name, takes in CHANNELS.items() if "scale" in takes and "add" in takes])
def test_scale_and_bias_are_corrected_in_every_channel(channel: str) -> None:
    true = drive()
    name = "road_wheel_angle" if channel == "steering" else channel
    faulty = replace(true, **{name: (getattr(true, name) - 0.3) / -2.5})
    if name == "road_wheel_angle":  # the sensor is at the steering wheel
        wheel = LEAF.steering_wheel_offset + (faulty.road_wheel_angle) * LEAF.steering_ratio
        faulty = replace(faulty, steering_wheel_angle=wheel)
    corrected = apply_corrections(faulty, {channel: Correction(scale=-2.5, add=0.3)}, LEAF)
    assert_equal(corrected, true, 1e-9)
    assert_equal(corrected.with_steering(LEAF), true, 1e-9)
    with pytest.raises(AssertionError):
        assert_equal(apply_corrections(faulty, {channel: Correction(scale=-2.5, add=0.31)}, LEAF), true, 1e-9)


@pytest.mark.parametrize(("pair", "names"), [("position", ("x", "y")), ("velocity", ("velocity_x", "velocity_y"))])
def test_correction_of_a_pair_is_applied_after_those_of_its_channels(pair: str, names: tuple[str, str]) -> None:
    true = drive()
    faulty = replace(true, **{name: getattr(true, name) / 3.6 for name in names})
    assert_equal(apply_corrections(faulty, {pair: Correction(scale=3.6)}), true, 1e-9)
    faulty = replace(faulty, **{names[0]: getattr(faulty, names[0]) - 1.0})
    assert_equal(apply_corrections(faulty, {pair: Correction(scale=3.6), names[0]: Correction(add=1.0)}), true, 1e-9)


@pytest.mark.parametrize("channel", [name for name, takes in CHANNELS.items() if "earlier" in takes])
@pytest.mark.parametrize("delay", [0.31, 0.004, -0.1])
def test_delay_is_corrected_in_every_channel(channel: str, delay: float) -> None:
    true = drive()
    names = {"position": ("x", "y"), "velocity": ("velocity_x", "velocity_y")}.get(channel, (channel,))
    correction = {channel: Correction(earlier=delay)}
    if channel in ("steering", "road_wheel_angle"):
        faulty = replace(true, steering_time_ns=true.steering_time_ns + round(delay * 1e9))
        assert_equal(apply_corrections(faulty, correction, LEAF), true)
        return
    corrected = apply_corrections(drive(delays=dict.fromkeys(names, delay)), correction)
    if channel in OPTIONAL_INS_SIGNALS:
        lost = np.isnan(getattr(corrected, channel))
        assert lost.sum() == np.ceil(abs(delay) / 0.01 - 1e-6) and len(corrected.x) == len(true.x)
        corrected = corrected.select_ins(~lost)
    else:
        assert len(true.x) - len(corrected.x) == np.ceil(abs(delay) / 0.01 - 1e-6)
    assert_equal(corrected, true, 1e-4)


def test_delay_correction_does_not_interpolate_across_gaps() -> None:
    log = drive(delays={"yaw_rate": 0.1})
    seconds = log.ins_time_ns * 1e-9
    log = log.select_ins((seconds < 5.0) | (seconds > 5.5))
    corrected = apply_corrections(log, {"yaw_rate": Correction(earlier=0.1)})
    assert_equal(corrected, drive(), 1e-4)
    remaining = corrected.ins_time_ns * 1e-9
    # The yaw rate of the last 0.1 s before the gap would have been recorded in the gap.
    assert not ((remaining > 4.9) & (remaining < 5.5)).any()
    assert np.isclose(remaining[remaining > 5.0].min(), 5.51)


def test_heading_correction_keeps_the_velocity_over_ground() -> None:
    log = drive()
    rotated = apply_corrections(log, {"heading": Correction(add=-0.0098)})
    np.testing.assert_allclose(rotated.yaw, log.yaw - 0.0098)
    for before, after in zip(body_to_map(log.velocity_x, log.velocity_y, log.yaw),
                             body_to_map(rotated.velocity_x, rotated.velocity_y, rotated.yaw), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-12)
    # With a heading 0.0098 rad too far left, a car that drives straight shows a velocity to the right.
    straight = replace(log, velocity_y=0.0098 * -log.velocity_x)
    assert np.abs(apply_corrections(straight, {"heading": Correction(add=-0.0098)}).velocity_y).max() < 1e-5
    assert_equal(apply_corrections(rotated, {"heading": Correction(add=0.0098)}), log)


def test_reference_point_of_the_positions_is_moved_along_the_car() -> None:
    true = drive()
    faulty = replace(true, x=true.x + 1.5 * np.cos(true.yaw), y=true.y + 1.5 * np.sin(true.yaw))
    assert_equal(apply_corrections(faulty, {"position": Correction(ahead=-1.5)}), true)
    with_yaw_error = replace(faulty, yaw=true.yaw - 0.1)
    corrections = {"position": Correction(ahead=-1.5), "yaw": Correction(add=0.1)}
    np.testing.assert_allclose(apply_corrections(with_yaw_error, corrections).y, true.y, atol=1e-12)


def test_leave_out_times_count_from_the_first_recorded_sample() -> None:
    log = drive()
    log = replace(log, ins_time_ns=log.ins_time_ns + 10**18)
    remaining = apply_corrections(log, {"x": Correction(earlier=0.5)}, leave_out=((0.0, 1.0), (12.0, 14.5)))
    seconds = (remaining.ins_time_ns - 10**18) * 1e-9
    assert seconds[0] == pytest.approx(1.01) and not ((seconds > 11.5) & (seconds < 14.5)).any()
    assert len(remaining.steering_time_ns) == len(log.steering_time_ns)
    assert len(apply_corrections(log, {}, leave_out=((0.0, 100.0),)).x) == 0


def test_missing_accelerations_remain_missing() -> None:
    log = drive()
    with_missing = np.where(np.arange(len(log.x)) % 50 == 7, np.nan, log.acceleration_y)
    corrected = apply_corrections(replace(log, acceleration_y=with_missing),
                                  {"acceleration_y": Correction(scale=9.81, earlier=0.005)})
    assert len(corrected.x) == len(log.x)
    assert np.isnan(corrected.acceleration_y).sum() == 2 * 40 + 1


def test_uncorrected_steering_wheel_angle_is_removed_without_a_vehicle() -> None:
    corrected = apply_corrections(drive(), {"road_wheel_angle": Correction(scale=-1.0)})
    assert corrected.steering_wheel_angle is None
    np.testing.assert_array_equal(corrected.road_wheel_angle, -drive().road_wheel_angle)
    assert apply_corrections(drive(), {"steering": Correction(earlier=0.1)}).steering_wheel_angle is not None


@pytest.mark.parametrize(("corrections", "message"), [
    ({"speed": Correction()}, "speed: unknown channel; known: x, y, position"),
    ({"yaw": Correction(ahead=1.0)}, "yaw: ahead does not apply here; use scale, add, earlier"),
    ({"heading": Correction(scale=2.0)}, "heading: scale does not apply here; use add"),
    ({"x": Correction(scale=float("nan"))}, "x: scale: nan is not within"),
    ({"x": Correction(earlier=61.0)}, "x: earlier: 61.0 is not within .-60"),
    ({"x": Correction(scale=0.0)}, "x: scale: must not be 0"),
    ({"steering": Correction(), "road_wheel_angle": Correction()}, "are the same channel"),
])
def test_invalid_corrections_are_rejected(corrections: dict, message: str) -> None:
    with pytest.raises(StCoreError, match=message):
        check_corrections(corrections)
    with pytest.raises(StCoreError, match=message):
        apply_corrections(drive(), corrections)


def test_corrections_that_leave_no_sample_are_rejected() -> None:
    with pytest.raises(StCoreError, match="leave no INS sample"):
        apply_corrections(drive(1.0), {"yaw": Correction(earlier=2.0)})


def test_description_of_corrections() -> None:
    assert describe_corrections({"yaw_rate": Correction(0.0174533, -0.004, 0.31), "position": Correction(ahead=-1.5),
                                 "road_wheel_angle": Correction(scale=-1.0)}) == (
        "yaw_rate x 0.0174533 - 0.004 rad/s, 0.31 s earlier", "position, 1.5 m behind", "road_wheel_angle x -1")
