"""Consistency of the measurements on a minute of a winding road, with and without faults."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from st_core.measurement_history import MeasurementHistory
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_predictor.consistency import CHECK_PERIOD, CPU_SHARE, MIN_DRIVING, WINDOW, Consistency, Verdict
from support import ROOT
from winding_road import RATE, Truth, winding_road

LEAF = ROOT / "config" / "vehicle" / "leaf.yaml"
CAR = VehicleParameters.from_yaml(LEAF.read_text(), str(LEAF))
START_NS = 1_756_900_800_000_000_000
YAW_RATE, STEERING = 6, 7
LATE = 0.3  # s
BEGIN, END, LAST = 35.0, 85.0, 140.0  # s in which a fault is in, and of the drive
SLOWEST = WINDOW + CHECK_PERIOD + 0.2
TWICE = SLOWEST + CHECK_PERIOD

Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def road() -> np.ndarray:
    """Rows of (t, x, y, yaw, v_x, v_y, yaw rate, road wheel angle)."""
    rows = winding_road(CAR, Truth(0.0, CAR.steering_ratio, 1.0), LAST, 3)
    rows[:, STEERING] /= CAR.steering_ratio
    return rows


class Live:
    """The check and its history in a node that polls ten times a second.

    said: (s, verdict) of each check; spent [s]: processor time until then. share: by default a check may cost
    as much as it likes, so that a busy machine changes nothing.
    """

    def __init__(self, vehicle: Any = CAR, share: float = 1.0):
        self.consistency = Consistency(vehicle, share)
        self.history = MeasurementHistory(65.0, 0.1, 5.0)
        self.now = 0.0
        self.verdicts: list[tuple[float, Verdict]] = []
        self.spent: list[float] = []

    def drive(self, rows: np.ndarray) -> "Live":
        for k, (t, *ins, steering) in enumerate(rows.tolist()):
            time_ns = START_NS + round(t * 1e9)
            self.history.add_ins(InsSample(time_ns, *ins))
            self.history.add_steering(time_ns, steering)
            self.now += 1.0 / RATE
            if k % 10 == 0 and self.consistency.poll(self.history, self.now):
                self.verdicts.append((t, self.consistency.verdict))
                self.spent.append(self.consistency.cpu_time)
        return self


def degrees_per_second(rows: np.ndarray) -> np.ndarray:
    return np.rad2deg(rows[:, YAW_RATE])


def late(rows: np.ndarray) -> np.ndarray:
    return np.roll(rows[:, YAW_RATE], round(LATE * RATE))


def flipped(rows: np.ndarray) -> np.ndarray:
    return -rows[:, STEERING]


def test_a_right_minute_is_well(road: np.ndarray) -> None:
    verdicts = Live().drive(road).verdicts
    agreed = [verdict for _, verdict in verdicts if "agree" in verdict.message]
    assert len(agreed) > (LAST - MIN_DRIVING) / (2.0 * CHECK_PERIOD)
    assert {verdict.severity for _, verdict in verdicts} <= {"", "note"}
    assert {"agree" in verdict.message for t, verdict in verdicts if t > MIN_DRIVING + 1.0} == {True}


@pytest.mark.parametrize(("column", "change", "name", "severity", "words"), [
    (YAW_RATE, degrees_per_second, "yaw_rate_scale", "error", "yaw_rate is 57"),
    (YAW_RATE, late, "yaw_rate_lag", "warning", "yaw_rate lags yaw by 0.3"),
    (STEERING, flipped, "steering_sign", "error", "have the opposite sign"),
])
def test_a_fault_is_reported_and_clears(road: np.ndarray, column: int, change: Change, name: str, severity: str,
                                        words: str) -> None:
    rows = road.copy()
    inside = (rows[:, 0] >= BEGIN) & (rows[:, 0] < END)
    rows[inside, column] = change(road)[inside]
    verdicts = Live().drive(rows).verdicts
    reported = [t for t, verdict in verdicts if name in verdict.values and words in verdict.message]
    assert reported and BEGIN < reported[0] <= BEGIN + TWICE
    assert {verdict.severity for t, verdict in verdicts if t in reported} == {severity}
    after = [verdict for t, verdict in verdicts if t > END + SLOWEST]
    first = next(k for k, (_, verdict) in enumerate(verdicts) if name in verdict.values)
    assert verdicts[first][1].severity in ("", "note") and name in verdicts[first][1].message  # once may mislead
    assert after and all("agree" in verdict.message for verdict in after)


@pytest.mark.parametrize("size", [0.5, 6.4, 640.0])
def test_a_jump_of_the_position_is_not_used(road: np.ndarray, size: float) -> None:
    """The history detects the jump; later faults are reported from the samples after it."""
    rows = road.copy()
    rows[rows[:, 0] >= BEGIN, 1] += size
    live = Live().drive(rows)
    assert live.history.jumps == 1
    assert {verdict.severity for _, verdict in live.verdicts} <= {"", "note"}
    assert "agree" in live.verdicts[-1][1].message
    rows[rows[:, 0] >= BEGIN, YAW_RATE] *= 57.3
    reported = [t for t, verdict in Live().drive(rows).verdicts if verdict.severity == "error"]
    assert reported and BEGIN + MIN_DRIVING < reported[0] <= BEGIN + MIN_DRIVING + 2.0 * CHECK_PERIOD + 0.2


def test_a_stationary_car_is_not_checked(road: np.ndarray) -> None:
    parked = np.repeat(road[:1], 3000, axis=0)
    parked[:, 0] = np.arange(3000) / RATE
    parked[:, 4:7] = 0.0
    verdict = Live().drive(parked).verdicts[-1][1]
    assert verdict == Verdict("", "not checked: 0 s of driving in the last minute or since the position jumped, "
                              "20 s above 1 m/s required")


def test_halts_reach_further_back(road: np.ndarray) -> None:
    """12 s of driving, a halt of 25, 13 s of driving: less than 20 s in the newest 30, enough in the minute."""
    halt = road[1200:1201].repeat(2500, axis=0)
    halt[:, 0] += np.arange(2500) / RATE
    halt[:, 4:7] = 0.0
    later = road[1200:2600].copy()
    later[:, 0] += 2500 / RATE
    verdicts = Live().drive(np.concatenate((road[:1200], halt, later))).verdicts
    assert "agree in the newest 4" in verdicts[-1][1].message


def test_a_jump_back_in_time_restarts_the_check(road: np.ndarray) -> None:
    live = Live().drive(road[:4000])
    assert "agree" in live.consistency.verdict.message
    live.drive(road[:100])
    assert "not checked: 0 s" in live.consistency.verdict.message


def test_nothing_new_for_a_minute_is_no_verdict(road: np.ndarray) -> None:
    live = Live().drive(road[:4000])
    assert not live.consistency.poll(live.history, live.now + 1.0)
    assert "agree" in live.consistency.verdict.message
    live.consistency.poll(live.history, live.now + 80.0)
    assert "not checked: 0 s" in live.consistency.verdict.message


def test_no_steering_is_no_obstacle(road: np.ndarray) -> None:
    rows = road[:4000].copy()
    rows[:, STEERING] = np.nan  # refused by the history
    assert "agree" in Live().drive(rows).verdicts[-1][1].message


def test_a_check_that_fails_is_a_warning(road: np.ndarray) -> None:
    verdict = Live(vehicle="no car").drive(road[:4000]).verdicts[-1][1]
    assert verdict.severity == "warning"
    assert verdict.message.startswith("check failed: AttributeError: ")


@pytest.mark.parametrize("share", [CPU_SHARE, 0.5 * CPU_SHARE, 0.002])
def test_it_takes_no_more_than_its_share_of_a_core(road: np.ndarray, share: float) -> None:
    live = Live(share=share).drive(road)
    times = [t for t, _ in live.verdicts]
    assert min(b - a for a, b in pairwise(times)) > CHECK_PERIOD - 0.2
    assert 0.0 < live.spent[-2] <= 1.01 * share * times[-1]  # the last is paid for later
