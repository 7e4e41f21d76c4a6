"""One drive in every kind of file that people bring, with the faults those files have: read the same, with a warning on
what is not used, or refused in one true sentence."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drive_kinds import CAR, NAMES, assert_same, assert_warned, clock, columns, csv, rows, to_degrees, vbo
from raw_drives import write_drives
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.car import load_car, read_vehicle
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.run_types import SteeringField
from support import EXAMPLES

WHEEL = ReadSettings(steering=SteeringField("", "Steer", "wheel", "deg"))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DriveLog]:
    """(folder with run.ncom and run.log, the drive in them)."""
    folder = write_drives(tmp_path_factory.mktemp("drive"), {}, 0, (("sweep", 26.0),)) / "sweep"
    return folder, read(find_runs([folder])[0], CAR).log


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
    ("last.csv", last_stamp, "utf-8", r"the last of \d+ rows is 300\.\d+ s after the previous one"),
    ("geographic.csv", geographic, "utf-8", ""),
    ("held.csv", lambda log: geographic(log, 5), "utf-8",
     r"about 20 Hz; the positions of the other rows were interpolated"),
    ("datenum.csv", lambda log: stamped(log, lambda s: f"{739000.5 + s / 86400:.12f}"), "utf-8", "days of MATLAB"),
    ("pm.csv", lambda log: stamped(log, lambda s: clock((43190 + s) % 43200) + " AP"[1 + (s < 10)] + "M"), "utf-8", ""),
    ("day_first.csv", lambda log: stamped(log, lambda s: f"25/04/2026 {clock(43200 + s)}"), "utf-8", ""),
    ("month_first.csv", lambda log: stamped(log, lambda s: f"04/25/2026 {clock(43200 + s)}"), "utf-8", ""),
    ("which_first.csv", lambda log: stamped(log, lambda s: f"05/04/2026 {clock(43200 + s)}"), "utf-8",
     "the order of day and month in its dates is ambiguous"),
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
    ("elapsed.csv", lambda log: csv([[clock(43200 + k * 0.01)[:8], *row] for k, row in enumerate(rows(log))],
                                    ",".join(("Time", "elapsed", *NAMES[1:]))), "utf-8", ""),
    ("channel_numbers.csv", lambda log: degrees(
        log, ",".join(NAMES) + "\n1,2,3,4,5,6,7,8\ns,m,m,deg,m/s,m/s,deg/s,deg"),
     "utf-8", ""),
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
    ("sources.csv", lambda log: csv([[*row, "9", "9", "9", "9"] for row in rows(log)], ",".join((
        "time", "Out/x [m]", "Out/y [m]", "egoYaw", "vx_raw", "Out/vy [m/s]", "Yaw rate IMU [in radians per second]",
        "CAN1::EPS::Steering wheel angle", "acc.x", "Out/vx_max [m/s]", "σ_vx", "Δt"))), "utf-8", ""),
    ("pitch.csv", lambda log: csv([[*row[:3], f"{np.pi / 2 - float(row[3]):.6f}", *row[4:], "0"] for row in rows(log)],
                                  ",".join((*NAMES[:3], "heading", *NAMES[4:], "theta"))), "utf-8", ""),
    ("twice_raw.csv", lambda log: csv([[*row, "9", "8"] for row in rows(log)],
                                      ",".join((*NAMES, "ax_raw", "ax_filtered"))),
     "utf-8", "columns ax_raw and ax_filtered may each be acceleration_x; none of them is used"),
    ("quoted.csv", lambda log: csv([[*row, '"a, b"'] for row in rows(log)], ",".join((*NAMES, "note"))), "utf-8", ""),
    ("line_ends.csv", lambda log: csv(rows(log), ",".join(f'"{name}\n[{unit}]"' for name, unit in zip(
        NAMES, ["s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"], strict=True))), "utf-8", ""),
    ("compact.csv", lambda log: stamped(log, lambda s: f"20260504_{clock(43200 + s).replace(':', '')}"), "utf-8", ""),
    ("clock_format.csv", lambda log: stamped(log, lambda s: clock(43200 + s)).replace("t,", "Time (HH:MM:SS.SS),", 1),
     "utf-8", ""),
    ("week.csv", lambda log: csv([["2300", *row, "99"] for row in rows(log)], ",".join(
        ("Time [week]", "TOW [s]", "x", "y", "yaw", "velocity_mpers", "vy [m⁄s]", "“yaw_rate”", NAMES[7],
         "speed_gps"))), "utf-8", ""),
    ("clock_name.csv", lambda log: csv(rows(log), ",".join(("time_utc", *NAMES[1:]))), "utf-8", ""),
    ("two_speeds.csv", lambda log: csv([[*row, "99"] for row in rows(log)], ",".join(NAMES).replace(
        "velocity_x", "Speed (GPS)(m/s)") + ",Speed (OBD)(m/s)"), "utf-8", ""),
    ("date.txt", lambda log: stamped(log, lambda s: f"2026-05-04 {clock(43200 + s)}").replace("t,", "Date Time,", 1),
     "utf-8", ""),
    ("start.txt", lambda log: "; Start time: 2026-05-04\n" + csv(rows(log)), "utf-8", "the header is in line 2"),
    ("control.csv", lambda log: csv([[*row, "0"] for row in rows(log)], ",".join((*NAMES[:4], "v", *NAMES[5:], "u"))),
     "utf-8", ""),
    ("single_quotes.csv", lambda log: re.sub(r"[^,\n]+", r"'\g<0>'", csv(rows(log))), "utf-8", ""),
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


def over_ground(log: DriveLog, header: str) -> str:
    """With the compass heading in degrees, and velocities to the north and east."""
    yaw = log.yaw
    north = log.velocity_x * np.sin(yaw) + log.velocity_y * np.cos(yaw)
    east = log.velocity_x * np.cos(yaw) - log.velocity_y * np.sin(yaw)
    return csv([[*row[:3], f"{90 - np.degrees(yaw[k]):.6f}", f"{north[k]:.6f}", f"{east[k]:.6f}", *row[6:]]
                for k, row in enumerate(rows(log))], header)


@pytest.mark.parametrize(("text", "error"), [
    (lambda log: over_ground(log, ",".join((*NAMES[:4], "vn", "ve", *NAMES[6:]))),
     "yaw agrees with the velocities to the east and north only as compass_heading in deg; declare it"),
    (lambda log: csv(rows(log), "t,x,y,yaw,u,v,r,steering_wheel_angle"), "columns u and v may each be velocity_x"),
    (lambda log: csv(rows(log)).replace(".", ","), "its rows have 16 cells, but its header has 8"),
    (lambda log: csv(rows(log), "Zt;Ost;Nord;Kurs;Vor;Quer;Rate;Lenk", ";").replace(".", ","),
     "its columns are Zt, Ost, Nord, Kurs, Vor, Quer, Rate, Lenk"),
    (lambda log: csv(rows(log), ",".join(("Δt", *NAMES[1:]))), "no column was recognised as t;"),
    (lambda log: "PK\x03\x04" + csv(rows(log)), r"this is a compressed file \(zip, or a spreadsheet\); unpack it"),
    (lambda log: stamped(log, lambda s: "5.0"), r"1 of \d+ rows .* have a time later than all rows before"),
    (lambda log: csv(rows(log)[::-1]), r"1 of \d+ rows .* have a time later than all rows before them; sort its rows"),
    (lambda log: stamped(log, lambda s: "04 Mxy 2026 " + clock(s)), r"the first is '04 Mxy 2026 .*export seconds"),
    (lambda log: geographic(log).replace(",5", ",520"),
     r"latitude \(column latitude\) is about 520\d[.\d]* deg, which is impossible; export"),
    (lambda log: re.sub(r"(,-\d\.\d*)", r"\1W", geographic(log)),
     r"column longitude has no numbers, but text such as '-1\.5\d*W'; export"),
    (lambda log: csv(rows(log), csv(rows(log)[:1]).splitlines()[1]),
     "its first line contains numbers instead of the names"),
    (lambda log: csv(rows(log), ",".join(NAMES).replace("yaw,", "yaw [?],")), r"column yaw \[\?\] is not used: '\?'"),
    (lambda log: stamped(log, lambda s: f"{s * 1e9:.0f}"), r"cannot be in s; .*units: \{t: ns\}"),
    (lambda log: csv(rows(log), ",".join(NAMES).replace(",x,", ",a/pos_x,b/pos_x,")[:-21]),
     "columns a/pos_x and b/pos_x may each be x; name the right one"),
    (lambda log: "timestamp,arbitration_id,dlc,data\n0.1,0x2,8,AAAA\n", "this is a CAN log as a table; export it as"),
    (lambda log: geographic(log).replace("latitude,longitude", "longitude,latitude"), "are interchanged: they agree"),
    (lambda log: in_radians(geographic(log)), r"are in radians: if read as degrees, they give 1/\d\d of the driven"),
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
    assert any("has only whole seconds, each in many rows; export fractions" in warning for warning in run.warnings)


def test_a_clock_set_back_half_way_costs_half_and_is_reported_with_its_share(tmp_path: Path, drive) -> None:
    file = tmp_path / "back.csv"
    file.write_text(set_back(drive[1]))
    run = read(find_runs([file])[0], CAR)
    assert abs(len(run.log.x) - len(drive[1].x) / 2) <= 1
    assert_warned(run.warnings, r"the clock was set back by 1\d\.\d+ s: \d+ of \d+ rows \(50 %\)")
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
    assert_warned(run.warnings, r"the clock was set back by .* rows \(50 %\) are not used")
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
    rng = np.random.default_rng(1)
    lines = []
    for k, line in enumerate(data.splitlines()):
        row = line.split(" ")
        if k < standing:
            row[2:4], row[4] = data.split(" ")[2:4], f"{rng.uniform(0, 0.1):07.3f}"
            row[5] = f"{rng.uniform(0, 360):06.2f}"
        lines.append(" ".join([*row, f"{rng.uniform(0, 360):06.2f}"]))
    file = tmp_path / "drive.vbo"
    file.write_text(head.replace("heading Steer", "heading Steer _heading") + mark + "\n".join(lines) + "\n")
    run = read(find_runs([file])[0], CAR, WHEEL)
    assert any(re.search(r"slower than 1 m/s; the course is noise there", w) for w in run.warnings)
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
