"""One drive in every kind of file that people bring, with the faults those files have: read the same, with a warning on
what is not used, or refused in one true sentence."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from drive_kinds import CAR, NAMES, assert_same, assert_warned, columns, write_bag
from mcap.writer import CompressionType, IndexType
from raw_drives import write_drives
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.car import load_car, read_vehicle
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.raw import read_pair
from st_recordings.runs.run_types import SteeringField
from st_recordings.runs.write import import_run
from support import EXAMPLES, shared

WHEEL = ReadSettings(steering=SteeringField("", "Steer", "wheel", "deg"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DriveLog]:
    """(folder with run.ncom and run.log, the drive in them)."""
    folder = write_drives(tmp_path_factory.mktemp("drive"), {}, 0, (("sweep", 26.0),)) / "sweep"
    return folder, read(find_runs([folder])[0], CAR).log


def csv(cells: list[list[str]], header: str = ",".join(NAMES), delimiter: str = ",") -> str:
    return "\n".join([header, *(delimiter.join(row) for row in cells)]) + "\n"


def rows(log: DriveLog, form: str = "%.6f") -> list[list[str]]:
    return [[form % value for value in row] for row in zip(*columns(log), strict=True)]


# Text of a CSV out of a drive.
def set_back(log):
    cells = rows(log)
    half = len(cells) // 2
    for row in cells[half:]:
        row[0] = f"{float(row[0]) - log.duration / 2:.6f}"
    return csv(cells)


def last_stamp(log):
    cells = rows(log)
    cells[-1][0] = f"{float(cells[-1][0]) + 300:.6f}"
    return csv(cells)


def holes(log):
    cells = rows(log)
    for k in (50, 51, 900):
        cells[k][5] = "#N/A"
    return csv(cells)


def bad_row(log):
    cells = rows(log)
    cells[100] = cells[100][:3]
    return csv(cells)


def stamped(log, form: Callable[[float], str]) -> str:
    """With the seconds after the first row in another form."""
    return csv([[form(float(row[0]) - log.ins_time_ns[0] * 1e-9), *row[1:]] for row in rows(log)])


def divided(time: str) -> tuple[str, str]:
    """Seconds and nanoseconds, as in a ROS message."""
    return str(int(float(time))), str(round(float(time) % 1 * 1e9))


def clock(seconds: float) -> str:
    return f"{int(seconds // 3600):02d}:{int(seconds // 60 % 60):02d}:{seconds % 60:09.6f}"


def german(log, thousands: str = ".") -> str:
    def number(text: str) -> str:
        return f"{float(text):,.4f}".replace(",", " ").replace(".", ",").replace(" ", thousands)

    return csv([[number(cell) for cell in row] for row in rows(log)], ";".join(NAMES), ";")


def american(log):
    return csv([[f'"{float(cell):,.4f}"' for cell in row] for row in rows(log)])


def doubtful_thousands(log):
    return csv([[f"{float(cell):.0f}" for cell in row[:1]] + ["1,234"] * 7 for row in rows(log)], ";".join(NAMES), ";")


def degrees(log, header: str) -> str:
    cells = [[*row[:3], f"{np.degrees(float(row[3])):.6f}", *row[4:6], f"{np.degrees(float(row[6])):.6f}",
              f"{np.degrees(float(row[7])):.6f}"] for row in rows(log)]
    return csv(cells, header)


def geographic(log, every: int = 1) -> str:
    cells = rows(log, "%.9f")
    latitude, longitude = to_degrees(log)
    for k, row in enumerate(cells):
        held = k // every * every
        row[1], row[2] = f"{latitude[held]:.10f}", f"{longitude[held]:.10f}"
    return csv(cells, "t,latitude,longitude,phi,vx,vy,yaw_rate,steering_wheel_angle")


def in_radians(text: str) -> str:
    head, *lines = (line.split(",") for line in text.splitlines())
    return csv([[row[0], *(f"{np.radians(float(cell)):.12f}" for cell in row[1:3]), *row[3:]] for row in lines],
               ",".join(head))


def to_degrees(log) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude of x and y about 52 N, 1.5 W, first order."""
    a, e2, origin = 6378137.0, 6.69437999014e-3, np.radians(52.0)
    n = a / np.sqrt(1 - e2 * np.sin(origin) ** 2)
    m = n * (1 - e2) / (1 - e2 * np.sin(origin) ** 2)
    return 52.0 + np.degrees(log.y / m), -1.5 + np.degrees(log.x / (n * np.cos(origin)))


def vbo(log, start: float = 43200.0, last_wrong: bool = True, seconds_of_day: bool = False) -> str:
    latitude, longitude = to_degrees(log)
    speed = np.hypot(log.velocity_x, log.velocity_y) * 3.6
    course = (90 - np.degrees(log.yaw + np.arctan2(log.velocity_y, log.velocity_x))) % 360
    wheel = np.degrees(columns(log)[7])
    lines = []
    for k, elapsed in enumerate((log.ins_time_ns - log.ins_time_ns[0]) * 1e-9):
        seconds = (start + elapsed) % 86400 + (180 if last_wrong and k == len(log.x) - 1 else 0)
        clock = f"{int(seconds // 3600):02d}{int(seconds // 60 % 60):02d}{seconds % 60:05.2f}"
        clock = f"{seconds:.2f}" if seconds_of_day else clock
        lines.append(f"010 {clock} {latitude[k] * 60:+014.8f} {-longitude[k] * 60:+014.8f} {speed[k]:07.3f} "
                     f"{course[k]:06.2f} {wheel[k]:+.4E}")
    return ("File created on 03/09/2025 @ 12:00:00\n\n[header]\nsatellites\ntime\nlatitude\nlongitude\nvelocity kmh\n"
            "heading\nSteer\n\n[channel units]\ndeg\n\n[comments]\nLog Rate (Hz) : 100\n\n[column names]\n"
            "sats time lat long velocity heading Steer\n\n[data]\n" + "\n".join(lines) + "\n")


TABLES: list[tuple[str, Callable[[DriveLog], str], str, str]] = [
    # name, text, encoding, warning expected
    ("plain.csv", lambda log: csv(rows(log)), "utf-8", ""),
    ("cp1252.csv", lambda log: degrees(log, "t [s],x [m],y [m],yaw [°],vx [m/s],vy [m/s],yaw rate [°/s],"
                               "steering wheel angle [°]"), "cp1252", ""),
    ("utf16.csv", lambda log: csv(rows(log)), "utf-16", ""),
    ("sep.csv", lambda log: "sep=;\n" + csv(rows(log), ";".join(NAMES), ";"), "utf-8", ""),
    ("pipes.csv", lambda log: csv(rows(log), "|".join(NAMES), "|"), "utf-8", ""),
    ("before.csv", lambda log: "Exported by X\nDate: 2025-09-03\n\n" + csv(rows(log)), "utf-8", "header is in line 4"),
    ("holes.csv", holes, "utf-8", r"velocity_y .*3 of \d+ rows"),
    ("bad_row.csv", bad_row, "utf-8", r"1 of \d+ rows \(0\.0\d+ %\) do not have as many cells"),
    ("german.csv", german, "utf-8", ""),
    ("spaces.csv", lambda log: german(log, "\u00a0"), "utf-8", ""),
    ("american.csv", american, "utf-8", ""),
    ("last.csv", last_stamp, "utf-8", r"the last of \d+ rows is 300\.\d+ s after the one before"),
    ("geographic.csv", geographic, "utf-8", ""),
    ("held.csv", lambda log: geographic(log, 5), "utf-8", r"about 20 Hz; the others were interpolated"),
    ("datenum.csv", lambda log: stamped(log, lambda s: f"{739000.5 + s / 86400:.12f}"), "utf-8", "days of MATLAB"),
    ("pm.csv", lambda log: stamped(log, lambda s: clock((43190 + s) % 43200) + " AP"[1 + (s < 10)] + "M"), "utf-8", ""),
    ("day_first.csv", lambda log: stamped(log, lambda s: f"25/04/2026 {clock(43200 + s)}"), "utf-8", ""),
    ("month_first.csv", lambda log: stamped(log, lambda s: f"04/25/2026 {clock(43200 + s)}"), "utf-8", ""),
    ("which_first.csv", lambda log: stamped(log, lambda s: f"05/04/2026 {clock(43200 + s)}"), "utf-8",
     "the day/month order of its dates is ambiguous"),
    ("colon.csv", lambda log: stamped(log, lambda s: clock(43200 + s)[:12].replace(".", ":")), "utf-8", ""),
    ("clock.csv", lambda log: stamped(log, lambda s: clock(43190 + s).replace(":", "")), "utf-8",
     "times of column t were read as HHMMSS"),
    ("apart.csv", lambda log: csv([["2026-05-04", clock(43200 + k * 0.01)[:11], *row[1:]] for k, row in
                                   enumerate(rows(log))],
                                  ",".join(("Date", "Time", *NAMES[1:]))), "utf-8", ""),
    ("matlab.csv", lambda log: stamped(log, lambda s: f"04-May-2026 {clock(43200 + s)}"), "utf-8", ""),
    ("durations.csv", lambda log: stamped(log, lambda s: f"{s:.6f} sec"), "utf-8", ""),
    ("cells.csv", lambda log: csv([[*row[:4], row[4] + " m/s", row[5], f"{np.degrees(float(row[6])):.6f}°/s", row[7]]
                                   for row in rows(log)], ";".join(NAMES), ";"), "utf-8", ""),
    ("fortran.csv", lambda log: csv(rows(log, "%.12E")).replace("E", "D"), "utf-8", ""),
    ("minus.csv", lambda log: csv(rows(log)).replace("-", "\u2212"), "utf-8", ""),
    ("etas.csv", lambda log: "ETASAsciiItemFile\trecord\n" + csv(
        rows(log), "\t".join(["time", *(name + "\\CCP:1" for name in NAMES[1:])]) + "\n" + "\t".join(["f8"] * 8) +
        "\ns\tm\tm\trad\tm/s\tm/s\trad/s\trad", "\t"), "utf-8", "header is in line 2"),
    ("empty_rows.csv", lambda log: csv(rows(log)) + (",,,,,,,\n" * 500), "utf-8", ""),
    ("labview.csv", lambda log: degrees(log, "\t".join(["X_Value", *NAMES[1:]])).replace(",", "\t").replace(
        "X_Value", "Channels\t7\nY_Unit_Label\tm\tm\tdeg\tm/s\tm/s\tdeg/s\tdeg\n***End_of_Header***\nX_Value"),
     "utf-8", "header is in line 4"),
    ("minutes.csv", lambda log: stamped(log, lambda s: clock((3590 + s) % 3600)[3:]), "utf-8", ""),
    ("twice.csv", lambda log: csv([[*row, "9"] for row in rows(log)], ",".join((*NAMES, "vx"))), "utf-8",
     "column vx occurs 2 times; the first is used"),
    ("units.csv", lambda log: degrees(log, ",".join(NAMES) + "\ns,m,m,deg,m/s,m/s,deg/s,deg"), "utf-8", ""),
    ("big_endian.csv", lambda log: csv(rows(log)), "utf-16-be", ""),
    ("tabs.txt", lambda log: csv(rows(log), "\t".join(NAMES), "\t"), "utf-8", ""),
    ("savetxt.dat", lambda log: csv(rows(log), "# " + " ".join(NAMES), " "), "utf-8", ""),
    ("index.csv", lambda log: csv([[f"2026-05-04 {clock(43200 + k * 0.01)}", *row[1:]] for k, row in
                                   enumerate(rows(log))], "," + ",".join(NAMES[1:])), "utf-8", ""),
    ("timedelta.csv", lambda log: stamped(log, lambda s: f"0 days {clock(s)}"), "utf-8", ""),
    ("stamp.csv", lambda log: csv([[*divided(row[0]), *row[1:]] for row in rows(log)],
                                  ",".join(("header.stamp.sec", "header.stamp.nanosec", *NAMES[1:]))), "utf-8", ""),
    ("paths.csv", lambda log: csv(rows(log), ",".join((
        "__time", "/odom/pose/pose/position/x", "/odom/pose/pose/position/y", "/odom/yaw", "/odom/twist/twist/linear/x",
        "/odom/twist/twist/linear/y", "INS.yaw_rate", "Car/steering_wheel_angle"))), "utf-8", ""),
    ("week.csv", lambda log: stamped(log, lambda s: f"{(604790 + s) % 604800:.6f}"), "utf-8", ""),
    ("gon.csv", lambda log: csv([[*row[:3], f"{float(row[3]) * 200 / np.pi:.6f}", *row[4:]] for row in rows(log)],
                                ",".join(NAMES).replace("yaw,", "yaw [gon],")), "utf-8", ""),
    ("compass.csv", lambda log: csv([[*row[:3], f"{(90 - np.degrees(float(row[3]))) % 360:.6f}", *row[4:]]
                                     for row in rows(log)], ",".join(NAMES).replace("yaw,", "heading,")), "utf-8",
     "column heading has values from .* to .*: they were read as degrees"),
    ("unwrapped.csv", lambda log: csv([[*row[:3], f"{6.5 * np.pi - float(row[3]):.6f}", *row[4:]] for row in rows(log)],
                                      ",".join(NAMES).replace("yaw,", "heading,")), "utf-8", ""),
    ("whole_stamps.csv", lambda log: csv([[f"{float(row[0]):.3f}", f"{float(row[0]) * 1e9:.0f}", *row[1:]] for row in
                                          rows(log)], ",".join(("stamp_sec", "stamp_nsec", *NAMES[1:]))), "utf-8", ""),
    ("track.csv", lambda log: csv([[*row, "7", "4.5"] for row in rows(log)], ",".join((*NAMES, "id", "length"))),
     "utf-8", ""),
    ("topics.csv", lambda log: csv([[row[0], "99", "5", "6", *row[1:]] for row in rows(log)], ",".join(
        ("t", "engine.speed", "a/speed", "b/speed", *NAMES[1:])).replace("velocity_x", "ins/velocity_x")), "utf-8", ""),
    ("unit.csv", lambda log: csv([[*row, "9"] for row in rows(log)], ",".join((*NAMES, "ax [mg]"))), "utf-8",
     "column ax .* is not used: 'mg' is not a unit of acceleration"),
]


@pytest.mark.parametrize(("name", "text", "encoding", "warning"), TABLES, ids=[row[0] for row in TABLES])
def test_tables(tmp_path: Path, drive, name: str, text, encoding: str, warning: str) -> None:
    file = tmp_path / name
    file.write_bytes(text(drive[1]).encode(encoding))
    run = read(find_runs([file])[0], CAR)
    assert_same(run.log, drive[1], lost=3 if name == "holes.csv" else 1,
                turned=name in ("geographic.csv", "held.csv", "unwrapped.csv"))
    assert_warned(run.warnings, warning)


@pytest.mark.parametrize("kind", ["csv", "vbo"])
def test_a_table_in_parts_is_one_run(tmp_path: Path, drive, kind: str) -> None:
    text = stamped(drive[1], lambda s: f"25/04/2026 {clock(43200 + s)}") if kind == "csv" else vbo(drive[1])
    head, mark, body = text.partition("\n" if kind == "csv" else "[data]\n")
    lines, third = body.splitlines(keepends=True), len(body.splitlines()) // 3
    (tmp_path / f"whole.{kind}").write_text(text)
    for part in range(3):
        rest = lines[part * third : (part + 1) * third if part < 2 else None]
        (tmp_path / f"part_{part}.{kind}").write_text(head + mark + "".join(rest))
    (tmp_path / "parts.run.yaml").write_text(f"{kind}: part_*.{kind}\n")
    whole, parts = (read(find_runs([tmp_path / name])[0], CAR, WHEEL if kind == "vbo" else None)
                    for name in (f"whole.{kind}", "parts.run.yaml"))
    np.testing.assert_array_equal(whole.log.ins_time_ns, parts.log.ins_time_ns)
    np.testing.assert_allclose(whole.log.x, parts.log.x, atol=1e-9)
    assert [run.name for run in find_runs([tmp_path])] == ["parts", "whole"]
    (tmp_path / "parts.run.yaml").write_text(f"{kind}: [part_0.{kind}, whole.{kind}]\n")
    with pytest.raises(RunError, match="it begins before the end of"):
        read(find_runs([tmp_path / "parts.run.yaml"])[0], CAR, WHEEL if kind == "vbo" else None)


@pytest.mark.parametrize(("text", "error"), [
    (lambda log: "PK\x03\x04" + csv(rows(log)), r"this is a compressed file \(zip, or a spreadsheet\); unpack it"),
    (lambda log: stamped(log, lambda s: "5.0"), r"1 of \d+ rows .* have a time later than all before"),
    (lambda log: csv(rows(log)[::-1]), r"1 of \d+ rows .* have a time later than all before; sort its rows"),
    (lambda log: stamped(log, lambda s: "04 Mxy 2026 " + clock(s)), r"the first is '04 Mxy 2026 .*export seconds"),
    (lambda log: geographic(log).replace(",5", ",520"),
     r"latitude \(column latitude\) is about 520\d[.\d]* deg; export"),
    (lambda log: re.sub(r"(,-\d\.\d*)", r"\1W", geographic(log)),
     r"column longitude has no number, but '-1\.5\d*W'; export"),
    (lambda log: csv(rows(log), csv(rows(log)[:1]).splitlines()[1]), "its first line has numbers instead of the names"),
    (lambda log: csv(rows(log), ",".join(NAMES).replace("yaw,", "yaw [?],")), r"column yaw \[\?\] is not used: '\?'"),
    (lambda log: stamped(log, lambda s: f"{s * 1e9:.0f}"), r"are not in s; .*units: \{t: ns\}"),
    (lambda log: csv(rows(log), ",".join(NAMES).replace(",x,", ",a/pos_x,b/pos_x,")[:-21]), "is known as x"),
    (lambda log: "timestamp,arbitration_id,dlc,data\n0.1,0x2,8,AAAA\n", "this is a CAN log as a table; export it as"),
    (lambda log: geographic(log).replace("latitude,longitude", "longitude,latitude"), "longitude are exchanged: only"),
    (lambda log: in_radians(geographic(log)), r"are in radians: read as degrees, they give 1/\d\d of the distance"),
    (doubtful_thousands, r"1,234 may be a number with a decimal mark or with a thousands separator"),
    (lambda log: csv(rows(log), ",".join(NAMES) + "\ns,m,m,Grad,m/s,m/s,deg/s,deg"), "unit row: 'Grad' of column yaw"),
])
def test_tables_that_cannot_be_read_for_sure(tmp_path: Path, drive, text, error: str) -> None:
    file = tmp_path / "table.csv"
    file.write_text(text(drive[1]))
    with pytest.raises(RunError, match=error):
        read(find_runs([file])[0], CAR)


def test_positions_rounded_to_the_fifth_decimal_of_a_degree_are_used_as_they_are(tmp_path: Path, drive) -> None:
    cells = [row.split(",") for row in geographic(drive[1]).splitlines()]
    file = tmp_path / "rounded.csv"
    file.write_text("\n".join(",".join(
        [row[0], *(re.sub(r"(\.\d{5})\d+", r"\1", cell) for cell in row[1:3]), *row[3:]]) for row in cells))
    assert not read(find_runs([file])[0], CAR).warnings


def test_a_wrong_scale_of_the_speed_is_no_exchange_of_latitude_and_longitude(tmp_path: Path, drive) -> None:
    file = tmp_path / "scaled.csv"
    for scale in np.arange(1.02, 1.4, 0.02):
        file.write_text(geographic(replace(drive[1], velocity_x=drive[1].velocity_x / scale)))
        assert len(read(find_runs([file])[0], CAR).log.x) == len(drive[1].x)


def test_whole_seconds_for_many_rows_are_named(tmp_path: Path, drive) -> None:
    file = tmp_path / "whole.csv"
    file.write_text(stamped(drive[1], lambda s: clock(43200 + s)[:8]))
    run = read(find_runs([file])[0], CAR)
    assert any("has whole seconds only, each in many rows; export fractions" in warning for warning in run.warnings)


def test_a_clock_set_back_half_way_costs_half_and_is_reported_with_its_share(tmp_path: Path, drive) -> None:
    file = tmp_path / "back.csv"
    file.write_text(set_back(drive[1]))
    run = read(find_runs([file])[0], CAR)
    assert abs(len(run.log.x) - len(drive[1].x) / 2) <= 1
    assert_warned(run.warnings, r"the clock was set back once, by 1\d\.\d+ s: \d+ of \d+ rows \(50 %\)")
    file.write_text(csv([[*row[:6], row[7]] for row in rows(drive[1])[: len(run.log.x)]] * 2, ",".join(
        (*NAMES[:6], NAMES[7]))))  # the yaw rate, derived from yaw, is not missing in rows that are not used
    derived = read(find_runs([file])[0], CAR)
    assert not [w for w in derived.warnings if "have no number" in w] and not derived.auxiliary.missing


@pytest.mark.parametrize(("radius", "sign", "note"), [(40.0, -1, "its sign was changed"), (40.0, 1, ""), (1e6, -1, "")])
def test_a_yaw_rate_channel_of_a_vbo_in_a_steady_turn_and_on_a_straight(tmp_path: Path, radius: float, sign: int,
                                                                        note: str) -> None:
    """Neither varies: only their sizes compare, and on a straight nothing does."""
    rate = 10.0 / radius
    turned = np.degrees(rate) * 0.05 * np.arange(600)
    rows = "\n".join(f"{120000 + 0.05 * k:.2f} {3120 + 0.0003 * k:.6f} -90.0 36.0 {(90 - turned[k]) % 360:.4f} "
                     f"{sign * np.degrees(rate):.5f} 0.1" for k in range(600))
    file = tmp_path / "turn.vbo"
    file.write_text(f'[column names]\ntime lat long velocity heading YawRate "Steer"\n[data]\n{rows}\n')
    run = read(find_runs([file])[0], CAR, WHEEL)
    expected = rate if note or sign > 0 else -rate
    np.testing.assert_allclose(run.log.yaw_rate, expected, rtol=1e-3, atol=1e-6)
    assert any("yaw rate" in w for w in run.warnings) == bool(note)


@pytest.mark.parametrize(("name", "day"), [("25/04/2026", 20568), ("04/25/2026", 20568), ("05/04/2026", 0)])
def test_the_date_of_a_table_is_used_where_its_order_is_known(tmp_path: Path, drive, name: str, day: int) -> None:
    file = tmp_path / "table.csv"
    file.write_text(stamped(drive[1], lambda s: f"{name} {clock(43200 + s)}"))
    log = read(find_runs([file])[0], CAR).log
    assert log.ins_time_ns[0] // 86_400_000_000_000 == day


@pytest.mark.parametrize(("start", "seconds_of_day"), [(43200.0, False), (86390.0, False), (45296.0, True)])
def test_vbo(tmp_path: Path, drive, start: float, seconds_of_day: bool) -> None:
    file = tmp_path / "drive.vbo"
    file.write_text(vbo(drive[1], start, seconds_of_day=seconds_of_day))
    run = read(find_runs([file])[0], CAR, WHEEL)
    log, truth = run.log, drive[1]
    assert len(log.x) == len(truth.x) - 1 and log.duration == pytest.approx(truth.duration, abs=0.02)
    steps = np.hypot(np.diff(log.x), np.diff(log.y)).sum(), np.hypot(np.diff(truth.x), np.diff(truth.y)).sum()
    assert steps[0] == pytest.approx(steps[1], rel=2e-3)
    assert np.median(np.abs(log.yaw_rate[:-1] - truth.yaw_rate[: len(log.x) - 1])) < 0.05
    np.testing.assert_allclose(log.steering_wheel_angle, columns(truth)[7][:-1], atol=1e-4)
    known = "course over ground|derivative of the heading|the last of"
    assert_warned(run.warnings, f"{known}|its times are not HHMMSS" if seconds_of_day else known)


def test_a_vbo_of_two_drives(tmp_path: Path, drive) -> None:
    file = tmp_path / "drive.vbo"
    file.write_text(vbo(drive[1], last_wrong=False) * 2)
    run = read(find_runs([file])[0], CAR, WHEEL)
    assert_warned(run.warnings, r"the clock was set back once, .* rows \(50 %\) are not used")
    file.write_text(vbo(drive[1]) + vbo(drive[1]).replace("heading Steer", "Steer heading"))
    with pytest.raises(RunError, match="several files with different"):
        read(find_runs([file])[0], CAR, WHEEL)


def test_a_noisy_course_makes_no_error_of_a_healthy_drive(tmp_path: Path) -> None:
    """The yaw rate is its derivative, from row to row mostly noise."""
    rows = [line.split(",") for line in (EXAMPLES / "rfs_turn_a.csv").read_text().splitlines()]
    at = [rows[0].index(name) for name in ("t", "x", "y", "yaw", "vx", "vy", "delta")]
    t, x, y, yaw, vx, vy, delta = np.array([[float(row[k]) for k in at] for row in rows[1:1350]]).T
    cells = np.stack([t, x, y, np.pi / 2 - yaw - np.arctan2(vy, vx), np.hypot(vx, vy), delta], axis=1)
    file = tmp_path / "course.csv"
    np.savetxt(file, cells, "%.5f", ",", header="t,x,y,course,speed,delta", comments="")
    car = read_vehicle(load_car("hyundai_genesis").vehicle)
    run = read(find_runs([file])[0], car)
    found = {one.name: one.severity for one in check(run.log, car, run.auxiliary).findings}
    assert not [name for name in found if name.startswith(("yaw_rate", "steering"))], found


@pytest.mark.parametrize(("change", "warning", "lost"), [
    (lambda k, row: [*row[:2], "+0.0", "+0.0", *row[4:]] if k < 50 else row,
     r"50 of \d+ rows .* latitude and longitude 0", 50),
    (lambda k, row: [row[0], "000000.00", *row[2:]] if k < 50 else row, r"the first of \d+ rows is 432\d\d", 50),
    (lambda k, row: [row[0], "127777.00", *row[2:]] if k == 50 else row, r"time \(column time\): 1 of \d+ rows", 1),
], ids=["no fix", "time 0", "damaged time"])
def test_single_wrong_rows_of_a_vbo_cost_themselves_only(tmp_path: Path, drive, change, warning: str,
                                                         lost: int) -> None:
    head, _, data = vbo(drive[1]).partition("[data]\n")
    file = tmp_path / "drive.vbo"
    file.write_text(head + "[data]\n" + "\n".join(" ".join(change(k, row.split(" "))) for k, row in
                                                 enumerate(data.splitlines())) + "\n")
    run = read(find_runs([file])[0], CAR, WHEEL)
    assert len(run.log.x) >= len(drive[1].x) - 1 - lost - 2 and any(re.search(warning, w) for w in run.warnings)
    assert np.hypot(np.diff(run.log.x), np.diff(run.log.y)).sum() > 0.95 * 12.0 * run.log.duration


@pytest.mark.parametrize("standing", [600, 10**6], ids=["at first", "always"])
def test_the_course_of_a_standing_car_is_not_used(tmp_path: Path, drive, standing: int) -> None:
    """Neither that of a second solution, which some receivers record as _heading."""
    head, mark, data = vbo(drive[1]).partition("[data]\n")
    chance = np.random.default_rng(1)
    lines = []
    for k, line in enumerate(data.splitlines()):
        row = line.split(" ")
        if k < standing:
            row[2:4], row[4] = data.split(" ")[2:4], f"{chance.uniform(0, 0.1):07.3f}"
            row[5] = f"{chance.uniform(0, 360):06.2f}"
        lines.append(" ".join([*row, f"{chance.uniform(0, 360):06.2f}"]))
    file = tmp_path / "drive.vbo"
    file.write_text(head.replace("heading Steer", "heading Steer _heading") + mark + "\n".join(lines) + "\n")
    run = read(find_runs([file])[0], CAR, WHEEL)
    assert any(re.search(r"slower than 1 m/s, where the course is noise", w) for w in run.warnings)
    assert np.abs(run.log.yaw_rate[:550]).max() < 1e-9 and np.ptp(run.log.yaw[:550]) < 1e-9
    assert not [one for one in check(run.log, CAR, run.auxiliary).findings if "yaw" in one.channels]


def test_milliseconds_of_the_day_in_a_vbo_are_questioned_and_a_compressed_log_is_named(tmp_path: Path, drive) -> None:
    head, _, data = vbo(drive[1], last_wrong=False).partition("[data]\n")
    file = tmp_path / "drive.vbo"
    file.write_text(head + "[data]\n" + "\n".join(" ".join([row.split(" ")[0], str(43200000 + 10 * k),
                                                          *row.split(" ")[2:]]) for k, row in
                                                 enumerate(data.splitlines())) + "\n")
    assert any("units: {t: ms}" in warning for warning in read(find_runs([file])[0], CAR, WHEEL).warnings)
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    (folder / "run.log").write_bytes(b"\x1f\x8b\x08" + bytes(100))
    with pytest.raises(RunError, match=r"run.log: this is a compressed file \(gzip\); unpack it first"):
        read(find_runs([folder])[0], CAR)


# CAN logs: what is made of the lines of run.log.
def frames_of(folder: Path) -> list[str]:
    return (folder / "run.log").read_text().splitlines()


def changed(lines: list[str], change: Callable[[str, str], str]) -> str:
    """change: of (head, data) of the steering frames."""
    out = []
    for line in lines:
        head, _, rest = line.partition("#")
        data, _, tail = rest.partition(" ")
        out.append(f"{change(head, data)} {tail}" if head.endswith(" 002") else line)
    return "\n".join(out) + "\n"


def asc(lines: list[str], date: str = "Wed Sep 3 06:00:00.005 pm 2025", comment: str = "") -> str:
    begin = float(lines[0].split()[0][1:-1])
    out = [f"date {date}", "base hex  timestamps absolute", "internal events logged", f"Begin Triggerblock {date}"]
    for k, line in enumerate(lines):
        stamp, channel, rest = line.split()[:3]
        identifier, data = rest.split("#")
        if comment and k == len(lines) // 3:
            out.append(comment)
        out.append(f"{float(stamp[1:-1]) - begin:11.6f} {int(channel[-1]) + 1}  {identifier:<15} Rx   d "
                   f"{len(data) // 2} " + " ".join(data[j : j + 2] for j in range(0, len(data), 2)))
    return "\n".join(out) + "\nEnd TriggerBlock\n"


def trc(lines: list[str], wide: bool) -> str:
    begin = float(lines[0].split()[0][1:-1])
    out = [";" + "#" * 74, ";   run.trc", ";", ";    Start time: 03.09.2025 18:00:00.005", ";---+--  ----+---  --+-"]
    for k, line in enumerate(lines, 1):
        stamp, _, rest = line.split()[:3]
        identifier, data = rest.split("#")
        number = int(identifier, 16)
        out.append(f"{k:6d}) {(float(stamp[1:-1]) - begin) * 1e3:9.1f}  {number:{'08X' if wide else '04X'}}  "
                   f"{len(data) // 2}  {' '.join(data[j : j + 2] for j in range(0, len(data), 2))}")
    return "\r\n".join(out) + "\r\n"


def spoilt(lines: list[str], every: int) -> str:
    return "\n".join(line[:20] if k % every == every - 1 else line for k, line in enumerate(lines)) + "\n"


def replaced(lines: list[str], line: str) -> str:
    return "\n".join([*lines[:5000], line, *lines[5001:]])


def later(line: str, seconds: float = 0.8) -> str:
    stamp, _, rest = line.partition(" ")
    return f"({float(stamp[1:-1]) + seconds:.6f}) {rest}"


def earlier(lines: list[str]) -> list[str]:
    """The first third, an hour before: of another drive."""
    return [later(line, -3600.0) for line in lines[: len(lines) // 3]]


LOGS: list[tuple[str, Callable[[list[str]], str], str, str]] = [
    ("run.log", lambda lines: spoilt(lines, 3000), "utf-8", r"lines \(0\.03\d? %\) cannot be read, .* line 3000"),
    ("run.log", "\n".join, "utf-16", ""),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}#{d}000000"), "utf-8", "bytes are padding"),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}##1{d.ljust(24, '0')}"), "utf-8", "have 12 bytes"),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}##1{d.ljust(128, 'A')}"), "utf-8", "have 64 bytes"),
    ("run.log", lambda lines: replaced(lines, lines[5000].split("#")[0] + "#" + "AA" * 70), "utf-8",
     "frames with more than 64 bytes: 1; they were skipped"),
    ("run.log", lambda lines: replaced(lines, "(1e300) " + lines[5000].split(" ", 1)[1]), "utf-8",
     "frames with an impossible time: 1; they were skipped"),
    ("run.asc", lambda lines: asc(lines, comment="// Prüfstand"), "cp1252", ""),
    ("run.asc", lambda lines: asc(lines, "Wed Sep 3 18:00:00.005 pm 2025"), "utf-8", ""),
    ("run.asc", lambda lines: asc(lines, "Mi Mär 3 18:00:00.005 2025"), "cp1252", ""),
    ("run.asc", lambda lines: asc(lines, "mercredi 3 septembre"), "utf-8", "its date .* cannot be read"),
    ("run.asc", lambda lines: asc(lines) * 2, "utf-8", r"its clock was set, .*: 2\d\.\d of 5\d\.\d s \(50 %\) fit"),
    ("run.log", lambda lines: "\n".join([*lines, *earlier(lines)]), "utf-8", r" of 3\d\.\d s \(75 %\) fit the INS"),
    ("run.log", lambda lines: "\n".join([*earlier(lines), *lines]), "utf-8", r" of 3\d\.\d s \(75 %\) fit the INS"),
    ("run.log", lambda lines: replaced(lines, later(lines[5001])), "utf-8", ""),
    ("run.trc", lambda lines: trc(lines, True), "ascii", ""),
    ("run.trc", lambda lines: trc(lines, False), "ascii", ""),
]


@pytest.mark.parametrize(("name", "text", "encoding", "warning"), LOGS)
def test_can_logs(tmp_path: Path, drive, name: str, text, encoding: str, warning: str) -> None:
    (tmp_path / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    (tmp_path / name).write_bytes(text(frames_of(drive[0])).encode(encoding))
    (tmp_path / "README").write_text("no data")
    run = read(find_runs([tmp_path])[0], CAR)
    assert_same(run.log, drive[1], lost=0, steering=0.003)
    assert_warned([w for w in run.warnings if "alignment" not in w], warning)


@pytest.mark.parametrize(("change", "error"), [
    (lambda h, d: f"{h}#{d[:8]}", r"2\d+ of 2\d+ frames \(100 %\) have 4 bytes, the DBC gives 5"),
    (lambda h, d: f"{h}#{d}010203", r"have 8 bytes, the DBC gives 5; 2\d+ are not used"),
    (lambda h, d: f"{h.replace(' 002', ' 00000002')}#{d}", "has 11 bits in the DBC, and .* have it with 29"),
])
def test_steering_frames_that_do_not_fit_the_dbc_are_named(tmp_path: Path, drive, change, error: str) -> None:
    (tmp_path / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    (tmp_path / "run.log").write_text(changed(frames_of(drive[0]), change))
    with pytest.raises(RunError, match=error):
        read(find_runs([tmp_path])[0], CAR)


def test_steering_frames_without_a_usable_value_are_no_gap_of_the_logger(tmp_path: Path, drive) -> None:
    (tmp_path / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    lines = frames_of(drive[0])
    steering = [k for k, line in enumerate(lines) if " 002#" in line]
    bad, lost = steering[500:600], {*steering[1000:1100]}
    for k in bad:  # low byte first: the largest angle that the signal can have
        head, _, data = lines[k].partition("#")
        lines[k] = f"{head}#FF7F{data[4:]}"
    (tmp_path / "run.log").write_text("\n".join(line for k, line in enumerate(lines) if k not in lost))
    run = read(find_runs([tmp_path])[0], CAR)
    found = {one.name: one for one in check(run.log, CAR, run.auxiliary).findings}
    assert re.search(r"100 of \d+ frames between .* were received and are not used: .*SteeringWheelAngle implausible "
                     r"\(up to -?3276.7 deg\) in 100", found["values_missing"].text)
    assert "1 gap of the steering" in found["time_gaps"].text
    assert found["time_gaps"].value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("name", "warning"), [
    ("run.log", r"\d+\.\d of 2\d\.\d s of the INS \(5\d %\) are not used: the steering was not recorded then"),
    ("run.ncom", r"\d+\.\d of 2\d\.\d s of the steering \(5\d %\) are not used: the INS was not recorded then"),
])
def test_a_file_that_ends_early_costs_the_rest_of_the_other(tmp_path: Path, drive, name: str, warning: str) -> None:
    """Whatever the format, no mark of its own shows that it is cut."""
    for file in ("run.ncom", "run.log"):
        content = (drive[0] / file).read_bytes()
        (tmp_path / file).write_bytes(content[: content.rindex(b"\n", 0, len(content) * 45 // 100) + 1] if file == name
                                      else content)
    (run,) = find_runs([tmp_path])
    imported = import_run(run, CAR, tmp_path / "bag", ReadSettings(), lambda drive: ())
    for warnings in (read(run, CAR).warnings, imported.warnings):
        assert any(re.search(warning, text) for text in warnings)


def test_the_clock_of_a_vbo_is_aligned_with_a_can_log(tmp_path: Path, drive) -> None:
    """Also of one with a steering column, which is a whole drive for other commands."""
    (tmp_path / "run.vbo").write_text(vbo(drive[1]))
    aligned = read_pair([tmp_path / "run.vbo", drive[0] / "run.log"], ReadSettings())
    reference = read_pair([drive[0] / "run.ncom", drive[0] / "run.log"], ReadSettings())
    moved = int(aligned.ins.time_ns[0]) - int(reference.ins.time_ns[0])
    assert aligned.alignment.offset_ns - reference.alignment.offset_ns == pytest.approx(moved, abs=10_000_000)


def test_a_vbo_without_steering_takes_that_of_the_can_log(tmp_path: Path, drive) -> None:
    head, mark, data = vbo(drive[1]).partition("[data]\n")
    rows = "\n".join(row.rpartition(" ")[0] for row in data.splitlines())
    (tmp_path / "run.vbo").write_text(head.replace("\nSteer\n", "\n").replace(" Steer\n", "\n") + mark + rows + "\n")
    (tmp_path / "run.log").write_bytes((drive[0] / "run.log").read_bytes())
    for given in ([tmp_path], [tmp_path / "run.vbo", tmp_path / "run.log"]):
        (found,) = find_runs(given)
        run = read(found, CAR)
        assert len(found.can) == 1 and run.log.duration == pytest.approx(drive[1].duration, abs=0.1)
        assert "acceleration_x" not in run.auxiliary.missing  # it was not recorded


def test_a_cut_blf_is_read_up_to_the_cut_with_a_warning(tmp_path: Path, drive) -> None:
    (tmp_path / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    blf = tmp_path / "run.blf"
    with can.BLFWriter(str(blf)) as writer:
        for message in can.LogReader(str(drive[0] / "run.log")):
            message.channel = int(str(message.channel)[-1])
            writer.on_message_received(message)
    (whole,) = find_runs([tmp_path])
    assert_same(read(whole, CAR).log, drive[1], lost=0, steering=0.003)
    blf.write_bytes(blf.read_bytes()[: blf.stat().st_size // 2])
    run = read(find_runs([tmp_path])[0], CAR)
    assert_warned(run.warnings, r"run\.blf: .*(truncated|header)")


@pytest.mark.parametrize("options", [(), ("--no-fd",)], ids=["with FD group", "without FD group"])
def test_an_mf4_of_firmware_with_virtual_channels(tmp_path: Path, drive, options: tuple[str, ...]) -> None:
    make = shared("failing/canedge_current_firmware_mf4/make.py")
    (tmp_path / "run.ncom").write_bytes((drive[0] / "run.ncom").read_bytes())
    subprocess.run([sys.executable, make, drive[0] / "run.log", tmp_path / "run.MF4", *options], check=True)
    run = read(find_runs([tmp_path])[0], CAR)
    assert_same(run.log, drive[1], lost=0, steering=0.003)
    assert not [w for w in run.warnings if "alignment" not in w]


# Bags.
def splits(folder: Path, log: DriveLog) -> Path:
    edges = np.linspace(0, len(log.x), 13).astype(int)
    for k in range(12):
        write_bag(folder / f"drive_{k}.mcap", log, edges[k], edges[k + 1])
    return folder


BAGS: list[tuple[str, Callable[[Path, DriveLog], Path], ReadSettings, str]] = [
    ("no message index", lambda folder, log: write_bag(
        folder / "a.mcap", log, index_types=IndexType.ATTACHMENT | IndexType.CHUNK | IndexType.METADATA),
     ReadSettings(), ""),
    ("channels not repeated", lambda folder, log: write_bag(
        folder / "a.mcap", log, repeat_channels=False, repeat_schemas=False), ReadSettings(), ""),
    ("no chunks", lambda folder, log: write_bag(folder / "a.mcap", log, use_chunking=False), ReadSettings(), ""),
    ("no statistics", lambda folder, log: write_bag(folder / "a.mcap", log, use_statistics=False), ReadSettings(), ""),
    ("lz4", lambda folder, log: write_bag(folder / "a.mcap", log, compression=CompressionType.LZ4), ReadSettings(), ""),
    ("stamps zero", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="zero"), ReadSettings(),
     r"all \d+ stamps of /odom are 0 s; the times of receipt are used"),
    ("stamps since boot", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="boot"), ReadSettings(),
     "have no time in common; the times of receipt are used for both"),
    ("twelve splits", splits, ReadSettings(), ""),
    ("own type, degrees, right positive", lambda folder, log: write_bag(folder / "a.mcap", log, own=True),
     ReadSettings(steering=SteeringField("/rack", "angle_deg", "wheel", "deg", -1), odometry="/odom"), ""),
]


@pytest.mark.parametrize(("make", "settings", "warning"), [row[1:] for row in BAGS], ids=[row[0] for row in BAGS])
def test_bags(tmp_path: Path, drive, make, settings: ReadSettings, warning: str) -> None:
    (source,) = find_runs([make(tmp_path, drive[1])])
    run = read(source, CAR, settings)
    assert_same(run.log, drive[1], lost=0)
    assert_warned(run.warnings, warning)


def test_a_missing_file_of_a_bag_is_named(tmp_path: Path, drive) -> None:
    splits(tmp_path, drive[1])
    for k in (4, 5):
        (tmp_path / f"drive_{k}.mcap").unlink()
    first, second = (read(source, CAR) for source in find_runs([tmp_path]))
    assert not first.warnings
    assert_warned(second.warnings, "2 files between drive_3.mcap and this one are missing: they are read as separate")


def test_bags_named_by_the_time_of_day_lack_no_file(tmp_path: Path, drive) -> None:
    splits(tmp_path, drive[1])
    for file in tmp_path.glob("drive_*.mcap"):
        if name := {"drive_0": "drive_101500", "drive_2": "drive_104500"}.get(file.stem):
            file.rename(tmp_path / f"{name}.mcap")
        else:
            file.unlink()
    for source in find_runs([tmp_path]):
        assert not [warning for warning in read(source, CAR).warnings if "missing" in warning]


def test_a_text_export_of_a_recording_in_its_folder_is_no_run(tmp_path: Path, drive) -> None:
    (tmp_path / "a.csv").write_text(csv(rows(drive[1])))
    (tmp_path / "a.txt").write_text(csv([row[:-1] for row in rows(drive[1])], "\t".join(NAMES[:-1]), "\t"))
    assert [run.files for run in find_runs([tmp_path])] == [(tmp_path / "a.csv",)]



def test_a_bag_of_another_encoding_is_named(tmp_path: Path, drive) -> None:
    file = write_bag(tmp_path / "json.mcap", drive[1], 0, 5, encoding="json")
    with pytest.raises(RunError, match="its messages are encoded as json, and only CDR of ROS 2 can be read"):
        read(find_runs([file])[0], CAR)


def test_another_definition_of_a_known_type_is_named(tmp_path: Path, drive) -> None:
    file = write_bag(tmp_path / "a.mcap", drive[1], 0, 5, compression=CompressionType.NONE, enable_crcs=False)
    file.write_bytes(file.read_bytes().replace(b"Vector3 linear", b"Vector3 planar"))
    with pytest.raises(RunError, match=r"its definition of nav_msgs/msg/Odometry is not that of ROS 2: .*linear"):
        read(find_runs([file])[0], CAR)


def test_a_changed_byte_in_a_bag_is_named(tmp_path: Path, drive) -> None:
    file = write_bag(tmp_path / "a.mcap", drive[1], compression=CompressionType.NONE)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(RunError, match=r"the chunk at byte \d+ is damaged: wrong checksum"):
        read(find_runs([file])[0], CAR)


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_an_ins_of_another_make_with_a_can_log_is_one_run(tmp_path: Path, drive, kind: str) -> None:
    folder, log = drive
    (tmp_path / "run.log").write_bytes((folder / "run.log").read_bytes())
    if kind == "csv":
        (tmp_path / "run.csv").write_text(csv([row[:7] for row in rows(log)], ",".join(NAMES[:7])))
    else:
        write_bag(tmp_path / "run.mcap", log, own=True)
    (source,) = find_runs([tmp_path])
    assert len(source.can) == 1 and source.problem is None
    run = read(source, CAR)
    assert_same(run.log, log, lost=0, steering=0.003)
    assert run.provenance["reader"] == f"{kind} and CAN log"
