"""Segmentation of a drive into turns, straights and standstill."""

import itertools

import numpy as np
import pytest
from st_core.log import DriveLog
from st_offline.evaluation.drive_parts import assign_horizons, segment_drive
from st_recordings.runs import Label


def drive(*parts: tuple[float, float, float]) -> DriveLog:
    """Joined parts (duration [s], final speed [m/s], heading change [deg], left +); the first at constant speed."""
    dt = 0.02
    speed, rate = [], []
    before = parts[0][1]
    for seconds, end, turn in parts:
        count = round(seconds / dt)
        speed.append(np.linspace(before, end, count))
        rate.append(np.full(count, np.radians(turn) / seconds))
        before = end
    speed, rate = np.concatenate(speed), np.concatenate(rate)
    time = np.round(np.arange(len(speed)) * dt * 1e9).astype(np.int64)
    zero = np.zeros(len(speed))
    return DriveLog("drive", time, zero, zero, np.cumsum(rate) * dt, speed, zero, rate, time, zero)


def name_parts(log: DriveLog) -> list[str]:
    return [part.name for part in segment_drive(log)]


def test_turns_are_named_by_side_and_heading_change():
    log = drive((5, 6, 0), (6, 6, 90), (5, 6, 0), (9, 6, -180), (5, 6, 0), (20, 6, 400), (5, 6, 0), (3, 6, -20))
    assert name_parts(log) == ["straight", "left turn", "straight", "right U-turn", "straight", "left circle",
                               "straight", "right bend"]


@pytest.mark.parametrize(("end", "name"), [(14.0, "accelerating"), (4.0, "braking"), (9.5, "straight")])
def test_straights_are_named_by_the_change_of_speed(end, name):
    assert name_parts(drive((0.1, 9, 0), (5, end, 0))) == [name]


def test_standstill_is_a_separate_part():
    log = drive((6, 5, 120), (3, 0.0, 0), (5, 0.0, 0), (3, 5, 0), (6, 5, -120))
    assert name_parts(log)[1:-1].count("standing") == 1


def test_wide_curve_is_not_a_straight():
    assert name_parts(drive((40, 12, 100))) == ["left wide curve"]


def test_parts_are_contiguous_and_heading_changes_add_up():
    log = drive((5, 6, 0), (6, 6, 90), (4, 8, 0), (6, 8, -100), (6, 4, 0))
    parts = segment_drive(log)
    assert parts[0].start == 0.0 and parts[-1].end == pytest.approx(log.duration, abs=0.1)
    assert all(a.end == b.start for a, b in itertools.pairwise(parts))
    assert sum(p.heading_change for p in parts) == pytest.approx(log.yaw[-1] - log.yaw[0], abs=1e-6)
    assert parts[1].start == pytest.approx(5.0, abs=0.6) and parts[1].end == pytest.approx(11.0, abs=0.6)


def test_short_heading_change_does_not_make_a_part():
    assert name_parts(drive((5, 6, 0), (0.5, 6, 8), (5, 6, 0))) == ["straight"]


def test_labels_take_precedence():
    log = drive((5, 6, 0), (6, 6, 90), (5, 6, 0))
    found = segment_drive(log, [Label("S1", 1.0, 3.0), Label("S2", 5.0, 11.0)])
    assert [(p.name, p.start, p.end) for p in found] == [("S1", 1.0, 3.0), ("S2", 5.0, 11.0)]
    assert np.degrees(found[1].heading_change) == pytest.approx(90.0, abs=1.0)


def test_each_horizon_belongs_to_at_most_one_part():
    parts = segment_drive(drive((5, 6, 0), (6, 6, 90), (5, 6, 0)))
    rows = [np.arange(300)[row] for row in assign_horizons(parts, np.linspace(0.0, 15.9, 300))]
    assert len(set(np.concatenate(rows))) == sum(map(len, rows)) and [len(r) > 50 for r in rows] == [True, True, True]


def test_empty_drive_has_no_parts():
    empty = np.empty(0)
    none = np.empty(0, np.int64)
    assert segment_drive(DriveLog("none", none, empty, empty, empty, empty, empty, empty, none, empty)) == []
