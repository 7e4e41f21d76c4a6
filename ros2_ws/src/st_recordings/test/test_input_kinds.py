"""One drive as tables of many programs, with their usual faults: read correctly, with a warning on what is not used, or
rejected in one sentence."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from drive_kinds import (
    CAR,
    NAMES,
    NOON,
    VBO_SETTINGS,
    assert_same,
    assert_warned,
    clock,
    csv,
    read_text,
    rows,
    to_degrees,
    vbo,
)
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.car import load_car, read_vehicle
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv_table import read_table
from st_recordings.runs.run_types import SteeringField
from support import EXAMPLES


# The drive as text of a CSV.
def header(*further: str, **changed: str) -> str:
    """The usual names, some of them changed, and further ones."""
    return ",".join((*(changed.get(name, name) for name in NAMES), *further))


def with_columns(log: DriveLog, further: dict[str, str], **changed: str) -> str:
    """The table with further columns (name -> text of every cell) and changed names."""
    return csv([[*row, *further.values()] for row in rows(log)], header(*further, **changed))


def with_times(log: DriveLog, to_text: Callable[[float], str]) -> str:
    """Times as text made of the seconds since the first row."""
    return csv([[to_text(float(row[0]) - log.ins_time_ns[0] * 1e-9), *row[1:]] for row in rows(log)])


def with_yaw(log: DriveLog, to_text: Callable[[float], str], further: dict[str, str], **changed: str) -> str:
    """Yaw as text made of its value [rad]."""
    return csv([[*row[:3], to_text(float(row[3])), *row[4:], *further.values()] for row in rows(log)],
               header(*further, **changed))


def with_clock_set_back(log: DriveLog) -> str:
    cells = rows(log)
    for row in cells[len(cells) // 2 :]:
        row[0] = f"{float(row[0]) - log.duration / 2:.6f}"
    return csv(cells)


def with_late_last_row(log: DriveLog) -> str:
    cells = rows(log)
    cells[-1][0] = f"{float(cells[-1][0]) + 300:.6f}"
    return csv(cells)


def with_missing_values(log: DriveLog) -> str:
    cells = rows(log)
    for k in (50, 51, 900):
        cells[k][5] = "#N/A"
    return csv(cells)


def with_short_row(log: DriveLog) -> str:
    cells = rows(log)
    cells[100] = cells[100][:3]
    return csv(cells)


def with_decimal_commas(log: DriveLog, thousands: str = ".") -> str:
    def number(text: str) -> str:
        return f"{float(text):,.4f}".replace(",", " ").replace(".", ",").replace(" ", thousands)

    return csv([[number(cell) for cell in row] for row in rows(log)], ";".join(NAMES), ";")


def with_ambiguous_thousands(log: DriveLog) -> str:
    return csv([[f"{float(cell):.0f}" for cell in row[:1]] + ["1,234"] * 7 for row in rows(log)], ";".join(NAMES), ";")


def in_degrees(log: DriveLog, names: str) -> str:
    cells = [[*row[:3], f"{np.degrees(float(row[3])):.6f}", *row[4:6], f"{np.degrees(float(row[6])):.6f}",
              f"{np.degrees(float(row[7])):.6f}"] for row in rows(log)]
    return csv(cells, names)


def geographic(log: DriveLog, repeats: int = 1) -> str:
    """The table with latitude and longitude; each position is repeated in `repeats` rows."""
    cells = rows(log, "%.9f")
    latitude, longitude = to_degrees(log)
    for k, row in enumerate(cells):
        first = k // repeats * repeats
        row[1], row[2] = f"{latitude[first]:.10f}", f"{longitude[first]:.10f}"
    return csv(cells, header(x="latitude", y="longitude", yaw="phi"))


def quote_rows(text: str) -> str:
    """The table with each row below the header as one quoted cell."""
    names, *lines = text.splitlines()
    return "\n".join([names, *('"' + line.replace('"', '""') + '"' for line in lines)]) + "\n"


def with_hemispheres(log: DriveLog) -> str:
    """The table with longitudes positive to the west, and the hemisphere after each coordinate."""
    names, *cells = (line.split(",") for line in geographic(log).splitlines())
    return csv([[row[0], row[1], "N", row[2].lstrip("-"), "W", *row[3:]] for row in cells],
               ",".join((names[0], "latitude", "N/S", "longitude", "E/W", *names[3:])))


def in_seconds_and_fractions(log: DriveLog, names: tuple[str, str], unit: float) -> str:
    """Times in two columns: whole seconds, and fractions in a unit [s]."""
    return csv([[f"{float(row[0]) // 1.0:.0f}", f"{float(row[0]) % 1.0 / unit:.0f}", *row[1:]] for row in rows(log)],
               ",".join((*names, *NAMES[1:])))


def positions_in_radians(text: str) -> str:
    names, *cells = (line.split(",") for line in text.splitlines())
    return csv([[row[0], *(f"{np.radians(float(cell)):.12f}" for cell in row[1:3]), *row[3:]] for row in cells],
               ",".join(names))


def with_course_velocities(log: DriveLog, names: str) -> str:
    """The table with the compass heading in degrees, and velocities to the north and east."""
    yaw = log.yaw
    north = log.velocity_x * np.sin(yaw) + log.velocity_y * np.cos(yaw)
    east = log.velocity_x * np.cos(yaw) - log.velocity_y * np.sin(yaw)
    return csv([[*row[:3], f"{90 - np.degrees(yaw[k]):.6f}", f"{north[k]:.6f}", f"{east[k]:.6f}", *row[6:]]
                for k, row in enumerate(rows(log))], names)


class Table(NamedTuple):
    """warning: pattern of an expected warning; empty: none is expected."""

    name: str
    text: Callable[[DriveLog], str]
    warning: str = ""
    encoding: str = "utf-8"


def with_times_of_two_groups(log: DriveLog) -> str:
    """INS and steering with columns Time of their own; a row of the INS is missing."""
    cells = rows(log)
    ins = [*cells[:5], *cells[6:], [""] * 7]
    names = ("Time", *NAMES[1:7], "Time", NAMES[7])
    return csv([[*ins[k][:7], *row[::7]] for k, row in enumerate(cells)], ",".join(names))


def navgraph(log: DriveLog) -> str:
    """Names, quotes and the delimiter at the end of rows as an export of OxTS NAVgraph has them."""
    return csv([["2015-12-18", clock(NOON + k * 0.01)[:12], f"{k * 0.01:.2f}", *row[1:], ""] for k, row in enumerate(
        rows(log))], '"Date (UTC+1,00)","Time (UTC+1,00)",TimeFromStart (s),' + ",".join((
            "PosLocalX (m)", "PosLocalY (m)", "yaw (rad)", "VelForward (m/s)", "VelLateral (m/s)", "AngleRateZ (rad/s)",
            NAMES[7])))


def with_unfilled_columns(log: DriveLog, orientation: bool) -> str:
    """The table with columns of zeros: x, y, yaw and steering wheel, or orientation."""
    names, *cells = (line.split(",") for line in geographic(log).splitlines())
    zeros = ("qx", "qy", "qz") if orientation else ("x", "y", "yaw", "steering_wheel_angle")
    wheel = CAR.road_wheel_angle(np.array([float(row[7]) for row in cells]))
    return csv([[*row[:3], f"{np.pi / 2 - float(row[3]):.9f}", *row[4:7], f"{wheel[k]:.9f}", *["0"] * len(zeros), "1"]
                for k, row in enumerate(cells)],
               ",".join((*names[:3], "heading", *names[4:7], "delta", *zeros, "qw")))


TABLES = [
    Table("plain.csv", lambda log: csv(rows(log))),
    # Encodings, delimiters, quotes, lines around the table.
    Table("cp1252.csv", lambda log: in_degrees(log, "t [s],x [m],y [m],yaw [°],vx [m/s],vy [m/s],yaw rate [°/s],"
                                                    "steering wheel angle [°]"), encoding="cp1252"),
    Table("utf16.csv", lambda log: csv(rows(log)), encoding="utf-16"),
    Table("utf16_big_endian.csv", lambda log: csv(rows(log)), encoding="utf-16-be"),
    Table("two_encodings.csv", lambda log: in_degrees(
        log, "\udce4\nt [s],x [m],y [m],yaw [°],vx [m/s],vy [m/s],yaw rate [°/s],steering wheel angle [°]"),
          "header is in line 2"),
    Table("zeros_at_line_ends.csv", lambda log: csv(rows(log)).replace("\n", "\0\n")),
    Table("header_twice.csv", lambda log: header() + "\n" + csv(rows(log)), "1 of .* rows .* have no number"),
    Table("long_preamble.csv", lambda log: "".join(f"key {k}: value, {k}\n" for k in range(200)) + csv(rows(log)),
          "header is in line 201"),
    Table("sep_line.csv", lambda log: "sep=;\n" + csv(rows(log), ";".join(NAMES), ";")),
    Table("preamble_with_values.csv", lambda log: "Name,Value\nCar,Leaf\n\n" + csv(rows(log)), "header is in line 4"),
    Table("topic_and_value.csv", lambda log: with_columns(log, {"topic": "/odom", "value": "3"})),
    Table("pipes.csv", lambda log: csv(rows(log), "|".join(NAMES), "|")),
    Table("tabs.txt", lambda log: csv(rows(log), "\t".join(NAMES), "\t")),
    Table("savetxt.dat", lambda log: csv(rows(log), "# " + " ".join(NAMES), " ")),
    Table("quoted_rows.csv", lambda log: quote_rows(with_columns(log, {"note": '"a, b"'}))),
    Table("quoted_note.csv", lambda log: with_columns(log, {"note": '"a, b"'})),
    Table("single_quotes.csv", lambda log: re.sub(r"[^,\n]+", r"'\g<0>'", csv(rows(log)))),
    Table("line_ends_in_names.csv", lambda log: csv(rows(log), ",".join(f'"{name}\n[{unit}]"' for name, unit in zip(
        NAMES, ["s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"], strict=True)))),
    Table("preamble.csv", lambda log: "Exported by X\nDate: 2025-09-03\n\n" + csv(rows(log)), "header is in line 4"),
    Table("start_time.txt", lambda log: "; Start time: 2026-05-04\n" + csv(rows(log)), "the header is in line 2"),
    Table("etas.csv", lambda log: "ETASAsciiItemFile\trecord\n" + csv(
        rows(log), "\t".join(["time", *(name + "\\CCP:1" for name in NAMES[1:])]) + "\n" + "\t".join(["f8"] * 8) +
        "\ns\tm\tm\trad\tm/s\tm/s\trad/s\trad", "\t"), "header is in line 2"),
    Table("labview.csv", lambda log: in_degrees(log, "\t".join(["X_Value", *NAMES[1:]])).replace(",", "\t").replace(
        "X_Value", "Channels\t7\nY_Unit_Label\tm\tm\tdeg\tm/s\tm/s\tdeg/s\tdeg\n***End_of_Header***\nX_Value"),
          "header is in line 4"),
    # Missing cells and rows.
    Table("missing_values.csv", with_missing_values, r"velocity_y .*3 of \d+ rows"),
    Table("short_row.csv", with_short_row, r"1 of \d+ rows \(0\.0\d+ %\) do not have as many cells"),
    Table("late_last_row.csv", with_late_last_row,
          r"the last of \d+ rows is 300\.\d+ s after the previous one"),
    Table("empty_rows.csv", lambda log: csv(rows(log)) + (",,,,,,,\n" * 500)),
    # Numbers.
    Table("decimal_commas.csv", with_decimal_commas),
    Table("thousands_as_spaces.csv", lambda log: with_decimal_commas(log, "\u00a0")),
    Table("thousands_as_commas.csv", lambda log: csv([[f'"{float(cell):,.4f}"' for cell in row] for row in rows(log)])),
    Table("fortran.csv", lambda log: csv(rows(log, "%.12E")).replace("E", "D")),
    Table("minus_sign.csv", lambda log: csv(rows(log)).replace("-", "\u2212")),
    Table("units_in_cells.csv", lambda log: csv(
        [[*row[:4], row[4] + " m/s", row[5], f"{np.degrees(float(row[6])):.6f}°/s", row[7]] for row in rows(log)],
        ";".join(NAMES), ";")),
    # Positions.
    Table("geographic.csv", geographic),
    Table("positions_at_20_hz.csv", lambda log: geographic(log, 5),
          r"about 20 Hz; the positions of the other rows were interpolated"),
    # Times.
    Table("datenum.csv", lambda log: with_times(log, lambda s: f"{739000.5 + s / 86400:.12f}"), "MATLAB date numbers"),
    Table("am_pm.csv", lambda log: with_times(log, lambda s: clock((43190 + s) % 43200) + " AP"[1 + (s < 10)] + "M")),
    Table("day_first.csv", lambda log: with_times(log, lambda s: f"25/04/2026 {clock(NOON + s)}")),
    Table("month_first.csv", lambda log: with_times(log, lambda s: f"04/25/2026 {clock(NOON + s)}")),
    Table("day_first_with_dashes.csv", lambda log: with_times(log, lambda s: f"25-04-2026 {clock(NOON + s)}")),
    Table("day_of_the_week.csv", lambda log: with_times(log, lambda s: f'"Mon, 4 May 2026 {clock(NOON + s)} +0200"')),
    Table("month_before_the_day.csv", lambda log: with_times(log, lambda s: f'"May 4, 2026 {clock(NOON + s)}"')),
    Table("date_and_clock_with_comma.csv", lambda log: with_times(log, lambda s: f'"04 May 2026, {clock(NOON + s)}"')),
    Table("quoted_names.txt", lambda log: "\n".join([" ".join(f'"{name}"' for name in ("sample no", *NAMES)), *(
        "  ".join([str(k), *row]) for k, row in enumerate(rows(log)))])),
    Table("ambiguous_date.csv", lambda log: with_times(log, lambda s: f"05/04/2026 {clock(NOON + s)}"),
          "the order of day, month and year in its dates is ambiguous"),
    Table("two_digits_of_the_year.csv", lambda log: with_times(log, lambda s: f"25/04/26 {clock(86390 + s)}"),
          "the order of day, month and year in its dates is ambiguous"),
    Table("month_first_two_digits.csv", lambda log: with_times(log, lambda s: f"04/25/26 {clock(NOON + s)}")),
    Table("german_two_digits.csv", lambda log: with_times(log, lambda s: f"25.04.26 {clock(NOON + s)}")),
    Table("named_month_two_digits.csv", lambda log: with_times(log, lambda s: f"25-Apr-26 {clock(NOON + s)}")),
    Table("dashes.csv", lambda log: with_times(log, lambda s: f"2026-05-25-{clock(NOON + s).replace(':', '-')}")),
    Table("time_zone.csv", lambda log: with_times(log, lambda s: f"2026-05-04 {clock(NOON + s)} CEST")),
    Table("colon_before_fraction.csv", lambda log: with_times(log, lambda s: clock(NOON + s)[:12].replace(".", ":"))),
    Table("hhmmss.csv", lambda log: with_times(log, lambda s: clock(43190 + s).replace(":", "")),
          "times of column t were read as HHMMSS"),
    Table("date_and_time.csv", lambda log: csv([["2026-05-04", clock(NOON + k * 0.01)[:11], *row[1:]]
                                                for k, row in enumerate(rows(log))],
                                               ",".join(("Date", "Time", *NAMES[1:])))),
    Table("matlab_date.csv", lambda log: with_times(log, lambda s: f"04-May-2026 {clock(NOON + s)}")),
    Table("durations.csv", lambda log: with_times(log, lambda s: f"{s:.6f} sec")),
    Table("minutes.csv", lambda log: with_times(log, lambda s: clock((3590 + s) % 3600)[3:])),
    Table("elapsed.csv", lambda log: csv([[clock(NOON + k * 0.01)[:8], *row] for k, row in enumerate(rows(log))],
                                         ",".join(("Time", "elapsed", *NAMES[1:])))),
    Table("index_of_times.csv", lambda log: csv([[f"2026-05-04 {clock(NOON + k * 0.01)}", *row[1:]]
                                                 for k, row in enumerate(rows(log))], "," + ",".join(NAMES[1:]))),
    Table("timedelta.csv", lambda log: with_times(log, lambda s: f"0 days {clock(s)}")),
    Table("ros_stamps.csv", lambda log: csv(
        [[str(int(float(row[0]))), str(round(float(row[0]) % 1 * 1e9)), *row[1:]] for row in rows(log)],
        ",".join(("header.stamp.sec", "header.stamp.nanosec", *NAMES[1:])))),
    Table("complete_stamps.csv", lambda log: csv(
        [[f"{float(row[0]):.3f}", f"{float(row[0]) * 1e9:.0f}", *row[1:]] for row in rows(log)],
        ",".join(("stamp_sec", "stamp_nsec", *NAMES[1:])))),
    Table("timeval.csv", lambda log: in_seconds_and_fractions(log, ("tv_sec", "tv_usec"), 1e-6)),
    Table("sec_usec.csv", lambda log: in_seconds_and_fractions(log, ("sec", "usec"), 1e-6)),
    Table("milliseconds.csv", lambda log: in_seconds_and_fractions(log, ("time_s", "time_ms"), 1e-3)),
    Table("time_and_milliseconds.csv", lambda log: in_seconds_and_fractions(log, ("Time", "Milliseconds"), 1e-3)),
    *(Table(f"{name}_in_another_column.csv", lambda log, name=name, unit=unit: in_seconds_and_fractions(
        log, ("Time", name), unit)) for name, unit in (("Time_ms", 1e-3), ("time (us)", 1e-6), ("microsec", 1e-6))),
    Table("milliseconds_before_time.csv", lambda log: re.sub(
        r"(?m)^([^,]*),([^,]*)", r"\2,\1", in_seconds_and_fractions(log, ("Time", "Time_ms"), 1e-3))),
    Table("complete_milliseconds.csv", lambda log: csv(
        [[f"{float(row[0]) // 1.0:.0f}", f"{float(row[0]) * 1e3:.0f}", *row[1:]] for row in rows(log)],
        ",".join(("Time", "Time_ms", *NAMES[1:])))),
    Table("clock_and_milliseconds.csv", lambda log: csv(
        [[clock(NOON + (k // 100)), str(k % 100 * 10), *row[1:]] for k, row in enumerate(rows(log))],
        ",".join(("Time", "Millisecond", *NAMES[1:])))),
    Table("clock_and_ms.csv", lambda log: csv(
        [["2026-05-04", str(k % 100 * 10), *row[1:], clock(NOON + (k // 100))[:8]] for k, row in enumerate(rows(log))],
        ",".join(("Date", "ms", *NAMES[1:], "UTC time")))),
    Table("fractions_first.csv", lambda log: re.sub(r"(?m)^([^,]*),([^,]*)", r"\2,\1", in_seconds_and_fractions(
        log, ("timestamp_sec", "timestamp_usec"), 1e-6))),
    Table("complete_microseconds.csv", lambda log: csv(
        [[f"{float(row[0]) // 1.0:.0f}", f"{float(row[0]) * 1e6:.0f}", *row[1:]] for row in rows(log)],
        ",".join(("timestamp_s", "timestamp_us", *NAMES[1:])))),
    Table("comma_before_fraction.csv", lambda log: with_times(
        log, lambda s: f'"2026-05-04 {clock(NOON + s)[:12].replace(".", ",")}"')),
    Table("groups_with_times.csv", with_times_of_two_groups,
          "column Time occurs 2 times; each is the time of the columns after it"),
    Table("navgraph.csv", navgraph),
    Table("times_in_ns.csv", lambda log: with_times(log, lambda s: f"{s * 1e9:.0f}"), r"apart, were read in ns; if"),
    Table("times_in_us.csv", lambda log: with_times(log, lambda s: f"{s * 1e6:.0f}"), r"apart, were read in us; if"),
    Table("compass_heading_as_yaw.csv", lambda log: with_course_velocities(log, header(vx="north_speed", vy="ve")),
          "yaw agrees with the velocities to the east and north only as compass_heading in deg; it was read as such"),
    Table("units_after_commas.txt", lambda log: csv(rows(log), "\t".join(
        f"{name}, {unit}" for name, unit in zip(NAMES, ("s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"),
                                                strict=True)), "\t")),
    *(Table(f"units_in_bars_{k}.csv", lambda log, mark=mark, form=form: csv(rows(log), mark.join(
        form.format(name, unit) for name, unit in zip(NAMES, ("s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"),
                                                      strict=True)), mark)) for k, (mark, form) in enumerate(
        ((";", "{} |{}|"), (";", "{}|{}"), ("\t", "{} |{}|"), (",", "{} |{}|")))),
    Table("magnitudes.csv", lambda log: csv([[*row, "0", "0", "0"] for row in rows(log)], ", ".join(
        [*NAMES, "|slip|", "|a|", "|b|"]))),
    Table("iso_signals.csv", lambda log: csv(rows(log), "t,x,y,IsoYawAngle,IsoVsLongitudinalVelocity,"
                                             f"IsoVsLateralVelocity,IsoVsYawVelocity,{NAMES[7]}")),
    Table("xsens.csv", lambda log: csv(
        [["10", f"{11 + int(s // 60)}", f"{int(s % 60)}", f"{s % 1 * 1e9:.0f}", *row[1:]] for row in rows(log)
         for s in [40 + float(row[0]) - log.ins_time_ns[0] * 1e-9]],
        ",".join(("UTC_Hour", "UTC_Minute", "UTC_Second", "UTC_Nano", *NAMES[1:])))),
    Table("latex.csv", lambda log: csv(rows(log), r"$t$ [s],$x$ [m],$y$ [m],$\psi$ [rad],$v_x$ [m/s],$v_y$ [m/s],"
                                       r"$\omega_z$ [rad/s],$\delta_H$ [rad]")),
    Table("unfilled.csv", lambda log: with_unfilled_columns(log, orientation=False),
          "column yaw is 0 in all rows; it was read as blank"),
    Table("unfilled_orientation.csv", lambda log: with_unfilled_columns(log, orientation=True),
          "column qz is 0 in all rows; it was read as blank"),
    Table("pose_yaw.csv", lambda log: csv(rows(log), header(x="pose_x", y="pose_y", yaw="pose_yaw"))),
    Table("end_of_week.csv", lambda log: with_times(log, lambda s: f"{(604790 + s) % 604800:.6f}")),
    Table("end_of_hour.csv", lambda log: with_times(log, lambda s: f"{(3590 + s) % 3600:.6f}")),
    Table("end_of_32_bits.csv", lambda log: with_times(log, lambda s: f"{(4294957296 + s * 1e6) % 2**32:.0f}").replace(
        "t,", "t_us,", 1)),
    Table("compact_date.csv", lambda log: with_times(log, lambda s: f"20260504_{clock(NOON + s).replace(':', '')}")),
    Table("clock_format.csv", lambda log: with_times(log, lambda s: clock(NOON + s)).replace(
        "t,", "Time (HH:MM:SS.SS),", 1)),
    Table("gps_week.csv", lambda log: csv([["2300", *row, "99"] for row in rows(log)], ",".join(
        ("Time [week]", "TOW [s]", "x", "y", "yaw", "velocity_mpers", "vy [m⁄s]", "“yaw_rate”", NAMES[7],
         "speed_gps")))),
    Table("radians.csv", lambda log: positions_in_radians(geographic(log)),
          "were read in radians: in degrees, they give 1/"),
    Table("header_ends_with_delimiter.csv", lambda log: csv(rows(log), header() + ",")),
    Table("labview.lvm", lambda log: "LabVIEW Measurement\t\nDelta_X\t0.02\n***End_of_Header***\t\n" + csv(
        rows(log), "\t".join(["X_Value", *NAMES[1:], "Comment"]), "\t"), "the header is in line 4"),
    Table("spanish.csv", lambda log: with_times(log, lambda s: f"{clock(s + 3600)} p.\u00a0m.")),
    Table("java.csv", lambda log: with_times(log, lambda s: f"2026-05-04T{clock(NOON + s)}+02:00[Europe/Berlin]")),
    Table("windows.csv", lambda log: with_times(log, lambda s: f"{1.3 * 10**17 + s * 1e7:.0f}"),
          "were read as 0.1 us since 1601"),
    Table("dot_net.csv", lambda log: with_times(log, lambda s: f"{6.39 * 10**17 + s * 1e7:.0f}"),
          "were read as 0.1 us since the year 1"),
    Table("chinese.csv", lambda log: csv(rows(log), "时间(s),X坐标(m),Y坐标(m),横摆角(rad),纵向速度(m/s),横向速度(m/s),"
                                         "横摆角速度(rad/s),方向盘转角(rad)"), encoding="gbk"),
    Table("gbk.csv", lambda log: "# 采集车辆\n" + csv([[*row, "直线"] for row in rows(log)], header() + ",备注"),
          "the header is in line 2", "gbk"),
    Table("time_utc.csv", lambda log: csv(rows(log), header(t="time_utc"))),
    Table("date_time.txt", lambda log: with_times(log, lambda s: f"2026-05-04 {clock(NOON + s)}").replace(
        "t,", "Date Time,", 1)),
    Table("hemispheres.csv", with_hemispheres),
    Table("hemispheres_before.csv", lambda log: "\n".join(
        ",".join([cells[0], cells[2], cells[1], cells[4], cells[3], *cells[5:]])
        for cells in (line.split(",") for line in with_hemispheres(log).splitlines()))),
    Table("mode_after_the_longitude.csv", lambda log: csv(  # W is no side of the latitude, S none of the longitude
        [[*row[:2], "W", row[2], "S", *row[3:]] for row in (
            line.split(",") for line in geographic(log).splitlines()[1:])],
        header(x="latitude", y="longitude", yaw="phi").replace("latitude", "latitude,wheel").replace(
            "longitude", "longitude,mode"))),
    Table("names_above_an_ascii_log.csv", lambda log: csv(
        [["#INSPVAXA", "COM1", "4e77;INS_SOLUTION_GOOD", *row] for row in rows(log)],
        ",".join(("log", "port", "status", *NAMES)))),
    # Names and units of columns.
    Table("quotes_after_blanks.csv", lambda log: "\n".join([f"t,note,{','.join(NAMES[1:])}", *(
        f'{row[0]}, "turn, left", {", ".join(row[1:])}' for row in rows(log))])),
    Table("quoted_units.csv", lambda log: csv([[f'"{cell} {unit}"' for cell, unit in zip(
        row, ("s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"), strict=True)] for row in rows(log)])),
    Table("quoted_units_after_decimal_commas.csv", lambda log: csv([[f'"{cell.replace(".", ",")} {unit}"' for cell, unit
        in zip(row, ("s", "m", "m", "rad", "m/s", "m/s", "rad/s", "rad"), strict=True)] for row in rows(log)])),
    Table("repeated_column.csv", lambda log: with_columns(log, {"vx": "9"}),
          "column vx occurs 2 times; the first is used"),
    Table("row_of_units.csv", lambda log: in_degrees(log, header() + "\ns,m,m,deg,m/s,m/s,deg/s,deg")),
    Table("channel_numbers.csv", lambda log: in_degrees(
        log, header() + "\n1,2,3,4,5,6,7,8\ns,m,m,deg,m/s,m/s,deg/s,deg")),
    Table("topic_paths.csv", lambda log: csv(rows(log), ",".join((
        "__time", "/odom/pose/pose/position/x", "/odom/pose/pose/position/y", "/odom/yaw", "/odom/twist/twist/linear/x",
        "/odom/twist/twist/linear/y", "INS.yaw_rate", "Car/steering_wheel_angle")))),
    Table("gon.csv", lambda log: with_yaw(log, lambda yaw: f"{yaw * 200 / np.pi:.6f}", {}, yaw="yaw [gon]")),
    Table("compass.csv", lambda log: with_yaw(log, lambda yaw: f"{(90 - np.degrees(yaw)) % 360:.6f}", {},
                                              yaw="heading"),
          "column heading agrees with the positions only as compass_heading in deg; it was read as such"),
    Table("yaw_in_degrees.csv", lambda log: with_yaw(log, lambda yaw: f"{np.degrees(yaw):.6f}", {}),
          "column yaw agrees with the positions only as yaw in deg; it was read as such"),
    Table("unwrapped_heading.csv", lambda log: with_yaw(log, lambda yaw: f"{6.5 * np.pi - yaw:.6f}", {},
                                                        yaw="heading")),
    Table("heading_and_pitch.csv", lambda log: with_yaw(log, lambda yaw: f"{np.pi / 2 - yaw:.6f}", {"theta": "0"},
                                                        yaw="heading")),
    Table("tracked_object.csv", lambda log: with_columns(log, {"id": "7", "length": "4.5"})),
    Table("speeds_of_topics.csv", lambda log: csv([[row[0], "99", "5", "6", *row[1:]] for row in rows(log)], ",".join(
        ("t", "engine.speed", "a/speed", "b/speed", *NAMES[1:])).replace("velocity_x", "ins/velocity_x"))),
    Table("sources_in_names.csv", lambda log: csv([[*row, "9", "9", "9", "9"] for row in rows(log)], ",".join((
        "time", "Out/x [m]", "Out/y [m]", "egoYaw", "vx_raw", "Out/vy [m/s]", "Yaw rate IMU [in radians per second]",
        "CAN1::EPS::Steering wheel angle", "acc.x", "Out/vx_max [m/s]", "σ_vx", "Δt")))),
    Table("two_accelerations.csv", lambda log: with_columns(log, {"ax_raw": "9", "ax_filtered": "8"}),
          "columns ax_raw and ax_filtered may each be acceleration_x; none of them is used"),
    Table("two_speeds.csv", lambda log: with_columns(log, {"Speed (OBD)(m/s)": "99"}, vx="Speed (GPS)(m/s)")),
    Table("control_input.csv", lambda log: with_columns(log, {"u": "0"}, vx="v")),
    Table("racecapture.csv", lambda log: in_degrees(log, ",".join(
        f'"{name}"|"{unit}"|-9.0|9.0|25' for name, unit in zip(NAMES, (
            "s", "m", "m", "Degrees", "m/s", "m/s", "Deg/Sec", "deg"), strict=True)))),
    Table("unknown_unit.csv", lambda log: with_columns(log, {"ax [mg]": "9"}),
          "column ax .* is not used: 'mg' is not a unit of acceleration"),
]
# Days since 1970; 0 where the date is not used.
DAYS = {"day_first.csv": 20568, "month_first.csv": 20568, "ambiguous_date.csv": 0}
IN_ANOTHER_MAP = {"geographic.csv", "hemispheres.csv", "hemispheres_before.csv", "mode_after_the_longitude.csv",
                  "positions_at_20_hz.csv", "radians.csv", "unfilled.csv", "unfilled_orientation.csv",
                  "unwrapped_heading.csv"}


@pytest.mark.parametrize("table", TABLES, ids=[table.name for table in TABLES])
def test_table_gives_the_drive(tmp_path: Path, drive_log: DriveLog, table: Table) -> None:
    file = tmp_path / table.name
    file.write_bytes(table.text(drive_log).encode(table.encoding, "surrogateescape"))
    run = read(find_runs([file])[0], CAR)
    assert_same(run.log, drive_log, max_lost=3 if table.name == "missing_values.csv" else 1,
                rotated=table.name in IN_ANOTHER_MAP)
    assert_warned(run.warnings, table.warning)
    if table.name in DAYS:
        assert run.log.ins_time_ns[0] // 86_400_000_000_000 == DAYS[table.name]


def test_an_unknown_hemisphere_has_no_effect_on_other_rows(tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    file.write_text("t,latitude,N/S,longitude,E/W\n0,52,N,1,W\n1,52,nan,1,nan\n2,52,N,1,W\n")
    assert np.sign(read_table(file, Layout()).columns["longitude"]).tolist() == [-1.0, 1.0, -1.0]


@pytest.mark.parametrize("kind", ["csv", "vbo"])
def test_parts_of_a_table_are_one_run(tmp_path: Path, drive_log: DriveLog, kind: str) -> None:
    text = vbo(drive_log) if kind == "vbo" else with_times(drive_log, lambda s: f"25/04/2026 {clock(NOON + s)}")
    head, mark, body = text.partition("\n" if kind == "csv" else "[data]\n")
    lines, third = body.splitlines(keepends=True), len(body.splitlines()) // 3
    (tmp_path / f"whole.{kind}").write_text(text)
    for part in range(3):
        chosen = lines[part * third : (part + 1) * third if part < 2 else None]
        (tmp_path / f"part_{part}.{kind}").write_text(head + mark + "".join(chosen))
    (tmp_path / "parts.run.yaml").write_text(f"{kind}: part_*.{kind}\n")
    settings = VBO_SETTINGS if kind == "vbo" else None
    whole, parts = (read(find_runs([tmp_path / name])[0], CAR, settings)
                    for name in (f"whole.{kind}", "parts.run.yaml"))
    np.testing.assert_array_equal(whole.log.ins_time_ns, parts.log.ins_time_ns)
    np.testing.assert_allclose(whole.log.x, parts.log.x, atol=1e-9)
    assert [run.name for run in find_runs([tmp_path])] == ["parts", "whole"]
    (tmp_path / "parts.run.yaml").write_text(f"{kind}: [part_0.{kind}, whole.{kind}]\n")
    with pytest.raises(RunError, match="it begins before the end of"):
        read(find_runs([tmp_path / "parts.run.yaml"])[0], CAR, settings)


@pytest.mark.parametrize(("text", "error"), [
    (lambda log: csv(rows(log), header(vx="u", vy="v", yaw_rate="r")), "columns u and v may each be velocity_x"),
    (lambda log: csv(rows(log)).replace(".", ","), "its rows have 16 cells, but its header has 8"),
    (lambda log: csv(rows(log), "Zt;Ost;Nord;Kurs;Vor;Quer;Rate;Lenk", ";").replace(".", ","),
     "its columns are Zt, Ost, Nord, Kurs, Vor, Quer, Rate, Lenk"),
    (lambda log: "\0" * 5000, "it contains nothing but blanks or zero bytes; copy it again"),
    (lambda log: csv(rows(log), header(t="Δt")), "no column was recognised as t;"),
    (lambda log: "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n",
     "this is a pointer of Git LFS instead of the file; fetch the file with `git lfs pull`"),
    (lambda log: "<!DOCTYPE html>\n<html>Not found</html>", "this is a web page instead of the file; download the"),
    (lambda log: "PK\x03\x04" + csv(rows(log)), r"this is a compressed file \(zip, or a spreadsheet\); unpack it"),
    (lambda log: with_times(log, lambda s: "5.0"), r"1 of \d+ rows .* have a time later than all previous rows"),
    (lambda log: csv(rows(log)[::-1]), r"times in column t are not in order: \d+ of \d+ rows .* earlier .*; sort"),
    (lambda log: with_times(log, lambda s: f"{0.01 + 0.001 * np.sin(s)}"), "if the column contains time steps, export"),
    (lambda log: with_times(log, lambda s: "04 Mxy 2026 " + clock(s)), r"the first is '04 Mxy 2026 .*export seconds"),
    (lambda log: geographic(log).replace(",5", ",520"),
     r"latitude \(column latitude\) is about 520\d[.\d]* deg, which is impossible; export"),
    (lambda log: re.sub(r",5\d\.(\d*)", r",3125.\1", geographic(log)),
     r"deg, which is .*: \{latitude: min\}; or swap"),
    (lambda log: re.sub(r"(?m)^(\d[^,]*),[^,]*,[^,]*", r"\1,0.0,0", geographic(log)),
     "latitude and longitude are 0 or empty in all rows, so the receiver had no fix; export x and y"),
    (lambda log: re.sub(r"(?m)^(\d[^,]*,[^,]*,[^,]*),[^,]*(.*)", r"\1\2,0,0,0,0", csv(rows(log), header())).replace(
        ",yaw,", ",", 1).replace("\n", ",qx,qy,qz,qw\n", 1), "the orientation quaternion is 0 or empty in all "
     "rows; also export yaw, compass_heading or course"),
    (lambda log: re.sub(r"(,-\d\.\d*)", r"\1W", geographic(log)),
     r"column longitude has no numbers, but text such as '-1\.5\d*W'; export"),
    (lambda log: csv(rows(log), csv(rows(log)[:1]).splitlines()[1]),
     "its first line contains numbers instead of the names"),
    (lambda log: csv(rows(log), header(yaw="yaw [?]")), r"column yaw \[\?\] is not used: '\?'"),
    (lambda log: with_times(log, lambda s: f"{s * 1e9:.0f}").replace("t,", "t [s],", 1),
     r"cannot be in s; .*units: \{t: ns\}"),
    (lambda log: "#datatype,string,dateTime:RFC3339,double,string\n#group,false,false,false,true\n#default,,,,\n,"
                 "result,_time,_value,_field\n,_result,2026-05-04T10:00:00Z,1.5,x\n,_result,2026-05-04T10:00:00Z,1.5,yaw\n",
     r"it has one row for each value \(columns _field and _value\); export one column for each _field"),
    (lambda log: "lap,telemetry_name,telemetry_value,timestamp\n2,Speed,99.1,2025-09-05T00:28:20.593Z\n",
     r"columns telemetry_name and telemetry_value\); export one column for each telemetry_name, with"),
    (lambda log: "time,signal,value\n0.0,YawRate,1.5\n0.0,Speed,3.5\n", "columns signal and value"),
    (lambda log: '"SECONDS";"PID";"VALUE";"UNITS"\n"1.0";"Vehicle speed";"3.5";"km/h"\n',
     r"columns PID and VALUE\); export one column for each PID, with"),
    (lambda log: "$GPRMC,101112.00,A,5200.0,N\n" * 99, "it contains NMEA sentences instead of a table; export time"),
    (lambda log: csv(rows(log), ",".join(NAMES).replace(",x,", ",a/pos_x,b/pos_x,")[:-21]),
     "columns a/pos_x and b/pos_x may each be x; name the right one"),
    (lambda log: csv(rows(log), header(x="a/latitude", y="b/latitude")),
     "columns a/latitude and b/latitude may each be latitude; name the right one"),
    (lambda log: "time,can_id,dlc,bytes\n0.1,0x2,8,AAAA\n", "a table of CAN frames in an unknown format; export it as"),
    (lambda log: csv(rows(log)[:1] * 9, "7," + ",".join(f"2026-05-04 10:11:{k:02d}" for k in range(7))),
     "its first line contains numbers instead of the names of columns"),
    (lambda log: csv([["2300", "0.1", "38 23 45.1", "1 2 3.4", *row[3:]] for row in rows(log)],
                     "Week GPSTime Latitude Longitude Heading VEast VNorth SWA\n(w) (sec) (+/-D M S) (+/-D M S)", " "),
     r"unit row: '\+/-D' of column Latitude is not a unit of latitude or longitude; export decimal degrees"),
    (lambda log: csv([[f"2026-05-04 {clock(NOON)}", *row[1:]] for row in rows(log)], " ".join(NAMES), " "),
     "its rows have 9 cells, but its header has 8"),
    (lambda log: geographic(log).replace("latitude,longitude", "longitude,latitude"), "are swapped: they agree"),
    (lambda log: csv([[*row, ("1.234,5", "1,234.5")[k % 2]] for k, row in enumerate(rows(log))], ";".join(
        [*NAMES, "h"]), ";"), "1,234.5 may be a number .*: the file has decimal commas and decimal points"),
    (with_ambiguous_thousands, r"1,234 may be a number with a decimal mark or with a thousands separator"),
    (lambda log: csv(rows(log), header() + "\ns,m,m,Grad,m/s,m/s,deg/s,deg"), "unit row: 'Grad' of column yaw"),
])
def test_ambiguous_table_is_rejected(tmp_path: Path, drive_log: DriveLog, text, error: str) -> None:
    with pytest.raises(RunError, match=error):
        read_text(tmp_path / "table.csv", text(drive_log))


def test_positions_rounded_to_five_decimals_of_a_degree_cause_no_warning(tmp_path: Path, drive_log: DriveLog) -> None:
    cells = [row.split(",") for row in geographic(drive_log).splitlines()]
    run = read_text(tmp_path / "rounded.csv", "\n".join(",".join(
        [row[0], *(re.sub(r"(\.\d{5})\d+", r"\1", cell) for cell in row[1:3]), *row[3:]]) for row in cells))
    assert not run.warnings


@pytest.mark.parametrize("factor", [1.02, 1.08, 1.14, 1.2, 1.26, 1.32, 1.38])
def test_speed_scale_error_is_not_taken_for_interchanged_coordinates(tmp_path: Path, drive_log: DriveLog,
                                                                     factor: float) -> None:
    run = read_text(tmp_path / "scaled.csv", geographic(replace(drive_log, velocity_x=drive_log.velocity_x / factor)))
    assert len(run.log.x) == len(drive_log.x)


def test_times_in_whole_seconds_cause_a_warning(tmp_path: Path, drive_log: DriveLog) -> None:
    run = read_text(tmp_path / "whole.csv", with_times(drive_log, lambda s: clock(NOON + s)[:8]))
    assert any("has only whole seconds, each in many rows; export fractions" in warning for warning in run.warnings)


def test_rows_after_the_clock_was_set_back_are_left_out_with_their_share(tmp_path: Path, drive_log: DriveLog) -> None:
    file = tmp_path / "back.csv"
    run = read_text(file, with_clock_set_back(drive_log))
    assert abs(len(run.log.x) - len(drive_log.x) / 2) <= 1
    assert_warned(run.warnings, r"the clock was set back by 1\d\.\d+ s: \d+ of \d+ rows \(50 %\)")
    # A yaw rate derived from the yaw is not missing in rows that are not used.
    derived = read_text(file, csv([[*row[:6], row[7]] for row in rows(drive_log)[: len(run.log.x)]] * 2,
                                  ",".join((*NAMES[:6], NAMES[7]))))
    assert not [w for w in derived.warnings if "have no number" in w] and not derived.auxiliary.missing


def test_rows_with_a_time_far_too_late_are_left_out_alone(tmp_path: Path, drive_log: DriveLog) -> None:
    cells = rows(drive_log)
    for k in (500, 501, 900):
        cells[k][0] = f"{float(cells[k][0]) + 500:.6f}"
    run = read_text(tmp_path / "late.csv", csv(cells))
    assert len(run.log.x) == len(cells) - 3
    assert_warned(run.warnings, r"3 of \d+ rows \(0\.\d+ %\) are out of order in time; they were left out")
    (finding,) = [f for f in check(run.log, CAR, run.auxiliary).findings if f.name == "time_order" and "INS" in f.text]
    assert f"3 of {len(cells)} rows" in finding.text


@pytest.mark.parametrize(("settings", "message"), [
    (ReadSettings(steering=SteeringField("/steer")), "--steering-topic /steer, because it is not a bag"),
    (ReadSettings(odometry="/odom"), "--odometry-topic /odom, because it is not a bag"),
    (ReadSettings(offset=2.0), "--offset 2, because all its channels are on one clock")])
def test_option_for_a_recording_of_another_kind_gives_a_warning(tmp_path: Path, drive_log: DriveLog,
                                                                settings: ReadSettings, message: str) -> None:
    run = read_text(tmp_path / "drive.csv", csv(rows(drive_log)), settings)
    assert f"{tmp_path / 'drive.csv'}: this recording does not use {message}" in run.warnings


def test_noisy_course_over_ground_causes_no_finding(tmp_path: Path) -> None:
    """The yaw rate is the derivative of the course, from row to row mostly noise."""
    lines = [line.split(",") for line in (EXAMPLES / "rfs_turn_a.csv").read_text().splitlines()]
    at = [lines[0].index(name) for name in ("t", "x", "y", "yaw", "vx", "vy", "delta")]
    t, x, y, yaw, vx, vy, delta = np.array([[float(row[k]) for k in at] for row in lines[1:1350]]).T
    cells = np.stack([t, x, y, np.pi / 2 - yaw - np.arctan2(vy, vx), np.hypot(vx, vy), delta], axis=1)
    file = tmp_path / "course.csv"
    np.savetxt(file, cells, "%.5f", ",", header="t,x,y,course,speed,delta", comments="")
    car = read_vehicle(load_car("hyundai_genesis").vehicle)
    run = read(find_runs([file])[0], car)
    findings = {finding.name: finding.severity for finding in check(run.log, car, run.auxiliary).findings}
    assert not [name for name in findings if name.startswith(("yaw_rate", "steering"))], findings


def test_compressed_can_log_is_rejected(tmp_path: Path, drive_folder: Path) -> None:
    (tmp_path / "run.ncom").write_bytes((drive_folder / "run.ncom").read_bytes())
    (tmp_path / "run.log").write_bytes(b"\x1f\x8b\x08" + bytes(100))
    with pytest.raises(RunError, match=r"run.log: this is a compressed file \(gzip\); unpack it first"):
        read(find_runs([tmp_path])[0], CAR)


def test_stated_unit_of_yaw_has_priority_over_the_positions(tmp_path: Path, drive_log: DriveLog) -> None:
    run = read_text(tmp_path / "stated.csv", with_yaw(
        drive_log, lambda yaw: f"{np.degrees(yaw):.6f}", {}, yaw="yaw [rad]"))
    assert np.ptp(run.log.yaw) > 10.0 and not run.warnings


def test_positions_from_latitude_and_longitude_are_east_and_north_also_with_a_can_log(
        tmp_path: Path, drive_log: DriveLog, drive_folder: Path) -> None:
    (tmp_path / "run.csv").write_text(geographic(drive_log).replace(NAMES[7], "note"))
    (tmp_path / "run.log").write_bytes((drive_folder / "run.log").read_bytes())
    for folder in (tmp_path, drive_folder):
        assert read(find_runs([folder])[0], CAR).auxiliary.geographic
