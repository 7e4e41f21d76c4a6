"""DriveLog: validation, slices on both time bases, recomputed steering."""

import dataclasses

import numpy as np
import pytest
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

START_NS = 1_700_000_000_000_000_000


def make_log(n: int = 101, m: int = 201, **changes) -> DriveLog:
    ins = START_NS + np.arange(n) * 10_000_000
    steering = START_NS - 500_000_000 + np.arange(m) * 10_000_000
    values = {k: np.linspace(0, 1, n) for k in ("x", "y", "yaw", "velocity_x", "velocity_y", "yaw_rate")}
    log = {
        "name": "test", "ins_time_ns": ins, **values, "steering_time_ns": steering,
        "road_wheel_angle": np.linspace(-0.1, 0.1, m), "steering_wheel_angle": np.linspace(-1.7, 1.7, m),
    }
    return DriveLog(**{**log, **changes})


def test_duration_and_overlap() -> None:
    log = make_log()
    assert log.duration == pytest.approx(1.0)
    assert (log.start_ns, log.end_ns) == (START_NS - 500_000_000, START_NS + 1_500_000_000)
    assert log.overlap == pytest.approx(1.0)


def test_empty_log_has_no_duration() -> None:
    log = make_log(0, 0)
    assert (log.duration, log.overlap, log.start_ns) == (0.0, 0.0, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.zeros(3)}, "x has 3 values"),
        ({"yaw": np.full(101, np.nan)}, "yaw has values that are not finite"),
        ({"ins_time_ns": np.zeros(101, dtype=np.int64)}, "is not strictly increasing"),
        ({"ins_time_ns": np.arange(101) * 0.01}, "whole nanoseconds"),
        ({"acceleration_x": np.zeros(5)}, "acceleration_x has 5 values"),
    ],
)
def test_invalid_columns_are_named(change: dict, message: str) -> None:
    with pytest.raises(StCoreError, match=message):
        make_log(**change)


def test_arrays_are_read_only_and_those_of_the_caller_stay_writeable() -> None:
    x = np.zeros(101)
    log = make_log(x=x)
    with pytest.raises(ValueError, match="read-only"):
        log.x[0] = 1.0
    x[0] = 1.0  # only the view in the log is read-only


def test_slice_includes_both_ends_on_both_time_bases() -> None:
    part = make_log().slice(START_NS + 100_000_000, START_NS + 200_000_000, name="part")
    assert part.name == "part"
    for time in (part.ins_time_ns, part.steering_time_ns):
        assert (time[0], time[-1], len(time)) == (START_NS + 100_000_000, START_NS + 200_000_000, 11)
    assert len(part.steering_wheel_angle) == len(part.road_wheel_angle) == 11
    assert part.acceleration_x is None


def test_road_wheel_angle_is_recomputed_from_the_steering_wheel(leaf: VehicleParameters) -> None:
    log = make_log().with_steering(leaf)
    np.testing.assert_allclose(log.road_wheel_angle, (log.steering_wheel_angle + np.radians(2.7)) / 17.3, rtol=1e-12)
    with pytest.raises(StCoreError, match="without a steering wheel angle"):
        dataclasses.replace(log, steering_wheel_angle=None).with_steering(leaf)
