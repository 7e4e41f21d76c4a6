"""One drive as VBO files, with their usual faults: sign of the yaw rate, times, rows without a fix, course at rest."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drive_kinds import CAR, NOON, VBO_SETTINGS, assert_warned, columns, read_text, vbo
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.runs import RunError, find_runs, read


@pytest.mark.parametrize(("radius", "straight", "sign", "note"), [
    (40.0, 0, -1, "its sign was changed"), (40.0, 0, 1, ""), (40.0, 500, -1, "its sign was changed"), (1e6, 0, -1, "")])
def test_sign_of_a_vbo_yaw_rate_in_a_steady_turn(tmp_path: Path, radius: float, straight: int, sign: int,
                                                 note: str) -> None:
    """A constant yaw rate cannot be correlated with the heading, only its size compared; on a straight (radius [m] of
    1e6) not even that. One turn after a long straight (of so many rows) is enough."""
    rate = np.where(np.arange(600) < straight, 0.0, 10.0 / radius)
    turned = np.degrees(np.cumsum(rate)) * 0.05
    lines = "\n".join(f"{120000 + 0.05 * k:.2f} {3120 + 0.0003 * k:.6f} -90.0 36.0 {(90 - turned[k]) % 360:.4f} "
                      f"{sign * np.degrees(rate[k]):.5f} 0.1" for k in range(600))
    run = read_text(tmp_path / "turn.vbo",
                    f'[column names]\ntime lat long velocity heading YawRate "Steer"\n[data]\n{lines}\n')
    expected = rate if note or sign > 0 else -rate
    np.testing.assert_allclose(run.log.yaw_rate, expected, rtol=1e-3, atol=1e-6)
    assert any("yaw rate" in w for w in run.warnings) == bool(note)


@pytest.mark.parametrize("delimiter", [" ", ",", "\t"])
def test_delimiter_of_a_vbo_and_the_source_of_a_channel(tmp_path: Path, delimiter: str) -> None:
    rows = [(f"{120000 + 0.05 * k:.2f}", f"{3120 + 0.0003 * k:.6f}", "-90.0", "36.0", "0.0", "9.0") for k in range(99)]
    names = ("time", "lat", "long", "velocity", "heading", "steering_wheel_angle-obd")  # of RaceChrono
    (tmp_path / "a.vbo").write_text("[column names]\n{}\n[data]\n{}\n".format(
        delimiter.join(names), "\n".join(map(delimiter.join, rows))))
    run = read(find_runs([tmp_path / "a.vbo"])[0], CAR)
    assert (run.log.velocity_x == 10.0).all() and len(run.log.ins_time_ns) == 99
    np.testing.assert_allclose(run.log.steering_wheel_angle, np.radians(9.0))


@pytest.mark.parametrize("scale", [-1.0, -0.5, 0.5])
def test_negative_scale_of_a_vbo_yaw_rate_and_the_change_of_its_sign_are_one(tmp_path: Path, scale: float) -> None:
    lines = "\n".join(f"{120000 + 0.05 * k:.2f} {3120 + 0.0003 * k:.6f} -90.0 36.0 {(90 - 0.5 * k) % 360:.4f} -10.0 0.1"
                      for k in range(600))
    (tmp_path / "turn.vbo").write_text(
        f'[column names]\ntime lat long velocity heading YawRate "Steer"\n[data]\n{lines}\n')
    run_file = tmp_path / "turn.run.yaml"
    run_file.write_text(f"vbo: turn.vbo\ncorrect: {{yaw_rate: {{scale: {scale}}}}}\n")
    run = read(find_runs([run_file])[0], CAR, VBO_SETTINGS)
    np.testing.assert_allclose(run.log.yaw_rate, abs(scale) * np.radians(10.0))
    assert any("the scale in its run.yaml is applied without its sign" in w for w in run.warnings) == (scale < 0)
    assert run.auxiliary.corrections == (() if scale == -1.0 else ("yaw_rate x 0.5",))


@pytest.mark.parametrize(("units", "factor"), [("", 1.0), ("[channel units]\ndeg/s\ndeg\n", np.pi / 180.0)])
def test_unit_in_the_name_of_a_vbo_column_is_used(tmp_path: Path, units: str, factor: float) -> None:
    """The section of units has priority."""
    lines = "\n".join(f"{120000 + 0.05 * k:.2f} {3120 + 0.0003 * k:.6f} -90.0 36.0 90.0 0.2 0.1" for k in range(600))
    run = read_text(tmp_path / "drive.vbo", f"{units}[column names]\ntime lat long velocity heading YawRate_rad/s "
                    f"Steer\n[data]\n{lines}\n")
    np.testing.assert_allclose(run.log.yaw_rate, 0.2 * factor)


def test_bias_of_a_vbo_yaw_rate_does_not_change_its_sign(tmp_path: Path) -> None:
    """A bend to the right, so wide that a gyroscope with a bias to the left is positive in it."""
    rate = np.where((np.arange(600) >= 300) & (np.arange(600) < 400), -0.013, -0.004)
    turned = np.degrees(np.cumsum(rate)) * 0.05
    lines = "\n".join(f"{120000 + 0.05 * k:.2f} {3120 + 0.0003 * k:.6f} -90.0 36.0 {(90 - turned[k]) % 360:.4f} "
                      f"{np.degrees(rate[k] + 0.02):.5f} 0.1" for k in range(600))
    run = read_text(tmp_path / "bend.vbo",
                    f'[column names]\ntime lat long velocity heading YawRate "Steer"\n[data]\n{lines}\n')
    np.testing.assert_allclose(run.log.yaw_rate, rate + 0.02, atol=1e-5)


@pytest.mark.parametrize(("start", "seconds_of_day"), [(NOON, False), (86390.0, False), (45296.0, True)],
                         ids=["noon", "over midnight", "seconds of the day"])
def test_vbo_gives_the_drive(tmp_path: Path, drive_log: DriveLog, start: float, seconds_of_day: bool) -> None:
    run = read_text(tmp_path / "drive.vbo", vbo(drive_log, start, seconds_of_day=seconds_of_day))
    log = run.log
    assert len(log.x) == len(drive_log.x) - 1 and log.duration == pytest.approx(drive_log.duration, abs=0.02)
    distance, true_distance = (np.hypot(np.diff(each.x), np.diff(each.y)).sum() for each in (log, drive_log))
    assert distance == pytest.approx(true_distance, rel=2e-3)
    assert np.median(np.abs(log.yaw_rate[:-1] - drive_log.yaw_rate[: len(log.x) - 1])) < 0.05
    np.testing.assert_allclose(log.steering_wheel_angle, columns(drive_log)[7][:-1], atol=1e-4)
    usual = "course over ground|derivative of the heading|the last of"
    assert_warned(run.warnings, f"{usual}|its times are not HHMMSS" if seconds_of_day else usual)


@pytest.mark.parametrize(("scale", "sign", "warning"), [
    (1 / 60, -1, "read in degrees"), (1 / 60, 1, "read in degrees|longitude is positive to the east"),
    (1, 1, "longitude is positive to the east"), (1, -1, "")],
    ids=["degrees", "degrees, east positive", "minutes, east positive", "minutes"])
def test_coordinates_of_a_vbo_in_degrees_or_positive_to_the_east(tmp_path: Path, scale: float, sign: int,
                                                                 warning: str) -> None:
    course, speed = np.radians(60.0), 20.0
    north, east = (speed * 0.1 * np.arange(300) * f(course) for f in (np.cos, np.sin))
    lines = "\n".join(
        f"{36000 + 0.1 * k:.2f} {scale * (3120 + n / 1855.4):.8f} {sign * scale * (90 + e / 1145.1):.8f} 72.0 60.0 0.1"
        for k, (n, e) in enumerate(zip(north, east, strict=True)))
    run = read_text(tmp_path / "drive.vbo",
                    f'[column names]\ntime lat long velocity heading "Steer"\n[data]\n{lines}\n')
    assert (run.log.x[-1], run.log.y[-1]) == pytest.approx((east[-1], north[-1]), rel=0.01)
    assert_warned([each for each in run.warnings if "read in" in each or "positive" in each], warning)


@pytest.mark.parametrize("first", [95.0, 1777889472.0], ids=["seconds from the start", "seconds since 1970"])
def test_date_of_a_vbo_is_added_only_to_times_of_day(tmp_path: Path, first: float) -> None:
    lines = "\n".join(f"{first + 0.1 * k:.2f} {3120 + 0.001 * k:.6f} -90.0 36.0 0.0 0.1" for k in range(100))
    run = read_text(tmp_path / "drive.vbo", "File created on 04/05/2026 at 10:11:12\n[column names]\n"
                    f'time lat long velocity heading "Steer"\n[data]\n{lines}\n')
    assert run.log.ins_time_ns[0] * 1e-9 == pytest.approx(first)


def test_second_drive_in_a_vbo_is_reported_or_rejected(tmp_path: Path, drive_log: DriveLog) -> None:
    file = tmp_path / "drive.vbo"
    run = read_text(file, vbo(drive_log, late_last_row=False) * 2)
    assert_warned(run.warnings, r"the clock was set back by .* rows \(50 %\) are not used")
    with pytest.raises(RunError, match="several files with different"):
        read_text(file, vbo(drive_log) + vbo(drive_log).replace("heading Steer", "Steer heading"))


def map_vbo_rows(text: str, change: Callable[[int, list[str]], list[str]]) -> str:
    """change(number, cells) -> cells of each data row."""
    head, mark, data = text.partition("[data]\n")
    return head + mark + "".join(" ".join(change(k, line.split(" "))) + "\n"
                                 for k, line in enumerate(data.splitlines()))


@pytest.mark.parametrize(("change", "warning", "lost"), [
    (lambda k, row: [*row[:2], "+0.0", "+0.0", *row[4:]] if k < 50 else row,
     r"50 of \d+ rows .* latitude and longitude 0", 50),
    (lambda k, row: [row[0], "000000.00", *row[2:]] if k < 50 else row, r"the first of \d+ rows is 432\d\d", 50),
    (lambda k, row: [row[0], "127777.00", *row[2:]] if k == 50 else row, r"time \(column time\): 1 of \d+ rows", 1),
], ids=["no fix", "time 0", "damaged time"])
def test_only_invalid_rows_of_a_vbo_are_left_out(tmp_path: Path, drive_log: DriveLog, change, warning: str,
                                                 lost: int) -> None:
    run = read_text(tmp_path / "drive.vbo", map_vbo_rows(vbo(drive_log), change))
    assert len(run.log.x) >= len(drive_log.x) - 1 - lost - 2 and any(re.search(warning, w) for w in run.warnings)
    assert np.hypot(np.diff(run.log.x), np.diff(run.log.y)).sum() > 0.95 * 12.0 * run.log.duration


@pytest.mark.parametrize("stationary", [600, 10**6], ids=["at first", "always"])
def test_course_of_a_stationary_car_is_not_used(tmp_path: Path, drive_log: DriveLog, stationary: int) -> None:
    """The course of a second solution, which some receivers record as _heading, is not used either."""
    text = vbo(drive_log).replace("heading Steer", "heading Steer _heading")
    first = text.partition("[data]\n")[2].split(" ")
    rng = np.random.default_rng(1)

    def stop(k: int, row: list[str]) -> list[str]:
        if k < stationary:
            row[2:4], row[4] = first[2:4], f"{rng.uniform(0, 0.1):07.3f}"
            row[5] = f"{rng.uniform(0, 360):06.2f}"
        return [*row, f"{rng.uniform(0, 360):06.2f}"]

    run = read_text(tmp_path / "drive.vbo", map_vbo_rows(text, stop))
    assert any("slower than 1 m/s; the course is noise there" in w for w in run.warnings)
    assert np.abs(run.log.yaw_rate[:550]).max() < 1e-9 and np.ptp(run.log.yaw[:550]) < 1e-9
    assert not [f for f in check(run.log, CAR, run.auxiliary).findings if "yaw" in f.channels]


def test_milliseconds_of_the_day_in_a_vbo_cause_a_warning(tmp_path: Path, drive_log: DriveLog) -> None:
    text = map_vbo_rows(vbo(drive_log, late_last_row=False),
                        lambda k, row: [row[0], str(43200000 + 10 * k), *row[2:]])
    run = read_text(tmp_path / "drive.vbo", text)
    assert any("were read in ms" in warning for warning in run.warnings) and np.ptp(run.log.ins_time_ns) < 60e9
