"""Consistency check of the measurements on a winding road, with and without faults."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from st_core.measurement_history import MeasurementHistory
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_predictor.consistency import CHECK_PERIOD, MAX_CPU_FRACTION, MIN_DRIVING, WINDOW, ConsistencyMonitor, Verdict
from support import LEAF
from winding_road import RATE, Truth, winding_road

CAR = VehicleParameters.from_yaml(LEAF.read_text(), str(LEAF))
START_NS = 1_756_900_800_000_000_000
YAW_RATE, STEERING = 6, 7  # columns of `road`
YAW_RATE_DELAY = 0.3  # s
FAULT_BEGIN, FAULT_END, DURATION = 35.0, 85.0, 140.0  # s
MAX_DELAY_OF_ONE_CHECK = WINDOW + CHECK_PERIOD + 0.2
MAX_DELAY_OF_TWO_CHECKS = MAX_DELAY_OF_ONE_CHECK + CHECK_PERIOD

Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def road() -> np.ndarray:
    """Rows of (t, x, y, yaw, v_x, v_y, yaw rate, road wheel angle)."""
    rows = winding_road(CAR, Truth(0.0, CAR.steering_ratio, 1.0), DURATION, 3)
    rows[:, STEERING] /= CAR.steering_ratio
    return rows


class CheckedDrive:
    """The check and its history in a node that polls ten times a second.

    verdicts: (time [s], verdict) of each check; cpu_times: cumulative processor time [s] after each check.
    share: of a core; the default does not limit the checks, so that the load of the machine has no effect.
    """

    def __init__(self, vehicle: Any = CAR, share: float = 1.0):
        self.consistency = ConsistencyMonitor(vehicle, share)
        self.history = MeasurementHistory(65.0, 0.1, 5.0)
        self.now = 0.0
        self.verdicts: list[tuple[float, Verdict]] = []
        self.cpu_times: list[float] = []

    def drive(self, rows: np.ndarray) -> "CheckedDrive":
        for k, (t, *ins, steering) in enumerate(rows.tolist()):
            time_ns = START_NS + round(t * 1e9)
            self.history.add_ins(InsSample(time_ns, *ins))
            self.history.add_steering(time_ns, steering)
            self.now += 1.0 / RATE
            if k % 10 == 0 and self.consistency.poll(self.history, self.now):
                self.verdicts.append((t, self.consistency.verdict))
                self.cpu_times.append(self.consistency.cpu_time)
        return self


def to_degrees_per_second(rows: np.ndarray) -> np.ndarray:
    return np.rad2deg(rows[:, YAW_RATE])


def delay_yaw_rate(rows: np.ndarray) -> np.ndarray:
    return np.roll(rows[:, YAW_RATE], round(YAW_RATE_DELAY * RATE))


def reverse_steering(rows: np.ndarray) -> np.ndarray:
    return -rows[:, STEERING]


@pytest.mark.slow
def test_consistent_measurements_have_no_warning(road: np.ndarray) -> None:
    verdicts = CheckedDrive().drive(road).verdicts
    agreed = [verdict for _, verdict in verdicts if "no fault found" in verdict.message]
    assert len(agreed) > (DURATION - MIN_DRIVING) / (2.0 * CHECK_PERIOD)
    assert {verdict.severity for _, verdict in verdicts} <= {"", "note"}
    assert {"no fault found" in verdict.message for t, verdict in verdicts if t > MIN_DRIVING + 1.0} == {True}


@pytest.mark.slow
@pytest.mark.parametrize(("column", "change", "name", "severity", "fragment"), [
    (YAW_RATE, to_degrees_per_second, "yaw_rate_scale", "error", "yaw_rate is 57"),
    (YAW_RATE, delay_yaw_rate, "yaw_rate_lag", "warning", "yaw_rate lags yaw by 0.3"),
    (STEERING, reverse_steering, "steering_sign", "error", "have the opposite sign"),
])
def test_fault_is_reported_and_clears(road: np.ndarray, column: int, change: Change, name: str, severity: str,
                                      fragment: str) -> None:
    rows = road.copy()
    inside = (rows[:, 0] >= FAULT_BEGIN) & (rows[:, 0] < FAULT_END)
    rows[inside, column] = change(road)[inside]
    verdicts = CheckedDrive().drive(rows).verdicts
    reported = [t for t, verdict in verdicts if name in verdict.values and fragment in verdict.message]
    assert reported and FAULT_BEGIN < reported[0] <= FAULT_BEGIN + MAX_DELAY_OF_TWO_CHECKS
    assert {verdict.severity for t, verdict in verdicts if t in reported} == {severity}
    after = [verdict for t, verdict in verdicts if t > FAULT_END + MAX_DELAY_OF_ONE_CHECK]
    first = next(k for k, (_, verdict) in enumerate(verdicts) if name in verdict.values)
    # A single finding is only a note.
    assert verdicts[first][1].severity in ("", "note") and name in verdicts[first][1].message
    assert after and all("no fault found" in verdict.message for verdict in after)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.5, 6.4, 640.0])
def test_position_jump_gives_no_warning(road: np.ndarray, size: float) -> None:
    rows = road.copy()
    rows[rows[:, 0] >= FAULT_BEGIN, 1] += size
    drive = CheckedDrive().drive(rows)
    assert drive.history.jump_count == 1
    assert {verdict.severity for _, verdict in drive.verdicts} <= {"", "note"}
    assert "no fault found" in drive.verdicts[-1][1].message


@pytest.mark.slow
def test_fault_after_a_position_jump_is_reported(road: np.ndarray) -> None:
    rows = road.copy()
    rows[rows[:, 0] >= FAULT_BEGIN, 1] += 6.4
    rows[rows[:, 0] >= FAULT_BEGIN, YAW_RATE] *= 57.3
    reported = [t for t, verdict in CheckedDrive().drive(rows).verdicts if verdict.severity == "error"]
    assert reported and FAULT_BEGIN + MIN_DRIVING < reported[0] <= FAULT_BEGIN + MIN_DRIVING + 2.0 * CHECK_PERIOD + 0.2


def test_stationary_car_is_not_checked(road: np.ndarray) -> None:
    parked = np.repeat(road[:1], 3000, axis=0)
    parked[:, 0] = np.arange(3000) / RATE
    parked[:, 4:7] = 0.0
    verdict = CheckedDrive().drive(parked).verdicts[-1][1]
    assert verdict == Verdict("", "not checked: only 0 s above 1 m/s in the last minute or since a position jump; "
                              "20 s required")


def test_window_is_extended_across_a_halt(road: np.ndarray) -> None:
    """12 s of driving, a halt of 25 s, 13 s of driving: the last 30 s contain less driving than the required 20 s."""
    halt = road[1200:1201].repeat(2500, axis=0)
    halt[:, 0] += np.arange(2500) / RATE
    halt[:, 4:7] = 0.0
    later = road[1200:2600].copy()
    later[:, 0] += 2500 / RATE
    verdicts = CheckedDrive().drive(np.concatenate((road[:1200], halt, later))).verdicts
    assert "no fault found in the last 4" in verdicts[-1][1].message


def test_jump_back_in_time_restarts_the_check(road: np.ndarray) -> None:
    drive = CheckedDrive().drive(road[:4000])
    assert "no fault found" in drive.consistency.verdict.message
    drive.drive(road[:100])
    assert "not checked: only 0 s" in drive.consistency.verdict.message


def test_verdict_expires_without_new_measurements(road: np.ndarray) -> None:
    drive = CheckedDrive().drive(road[:4000])
    assert not drive.consistency.poll(drive.history, drive.now + 1.0)
    assert "no fault found" in drive.consistency.verdict.message
    drive.consistency.poll(drive.history, drive.now + 80.0)
    assert "not checked: only 0 s" in drive.consistency.verdict.message


def test_check_works_without_steering(road: np.ndarray) -> None:
    rows = road[:4000].copy()
    rows[:, STEERING] = np.nan  # rejected by the history
    assert "no fault found" in CheckedDrive().drive(rows).verdicts[-1][1].message


def test_failed_check_is_a_warning(road: np.ndarray) -> None:
    verdict = CheckedDrive(vehicle="no car").drive(road[:4000]).verdicts[-1][1]
    assert verdict.severity == "warning"
    assert verdict.message.startswith("check failed: AttributeError: ")


@pytest.mark.slow
@pytest.mark.parametrize("share", [MAX_CPU_FRACTION, 0.5 * MAX_CPU_FRACTION, 0.002])
def test_check_uses_at_most_its_share_of_a_core(road: np.ndarray, share: float) -> None:
    drive = CheckedDrive(share=share).drive(road)
    times = [t for t, _ in drive.verdicts]
    assert min(b - a for a, b in pairwise(times)) > CHECK_PERIOD - 0.2
    assert drive.cpu_times[-1] > 0.0
    assert drive.cpu_times[-2] <= 1.01 * share * times[-1]  # the cost of the last check delays the next one
