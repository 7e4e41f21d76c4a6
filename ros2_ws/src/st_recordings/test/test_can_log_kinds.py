"""One drive in CAN logs of many programs: read correctly, with a warning on what is not used, or rejected."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np
import pandas as pd
import pytest
from drive_kinds import CAR, NAMES, assert_same, assert_warned, clock, csv, rows, vbo, write_bag
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.can_formats import _find_number_formats, _find_time_unit, is_can_log
from st_recordings.runs.raw import read_pair
from st_recordings.runs.run_types import SteeringField
from st_recordings.runs.write import import_run
from support import shared


# Text of CAN logs, made of the lines of run.log.
@pytest.fixture(scope="module")
def frame_lines(drive_folder: Path) -> list[str]:
    return (drive_folder / "run.log").read_text().splitlines()


@pytest.fixture
def ncom_folder(drive_folder: Path, tmp_path: Path) -> Path:
    """A folder with run.ncom, to which a test adds a CAN log."""
    (tmp_path / "run.ncom").write_bytes((drive_folder / "run.ncom").read_bytes())
    return tmp_path


def map_steering_frames(lines: list[str], change: Callable[[str, str], str]) -> str:
    """change(head, data) -> frame, for the steering frames."""
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


def trc(lines: list[str], eight_digits: bool) -> str:
    begin = float(lines[0].split()[0][1:-1])
    out = [";" + "#" * 74, ";   run.trc", ";", ";    Start time: 03.09.2025 18:00:00.005", ";---+--  ----+---  --+-"]
    for k, line in enumerate(lines, 1):
        stamp, _, rest = line.split()[:3]
        identifier, data = rest.split("#")
        number = int(identifier, 16)
        out.append(f"{k:6d}) {(float(stamp[1:-1]) - begin) * 1e3:9.1f}  {number:{'08X' if eight_digits else '04X'}}  "
                   f"{len(data) // 2}  {' '.join(data[j : j + 2] for j in range(0, len(data), 2))}")
    return "\r\n".join(out) + "\r\n"


def trc_1_2(lines: list[str]) -> str:
    begin = float(lines[0].split()[0][1:-1])
    out = [";$FILEVERSION=1.2", ";$STARTTIME=45903.7500000579", ";   C:\\M\u00fcller\\run.trc", ";---+--   ----+--"]
    for k, line in enumerate(lines, 1):
        stamp, channel, rest = line.split()[:3]
        identifier, data = rest.split("#")
        time = f"{k:6d}) {(float(stamp[1:-1]) - begin) * 1e3:12.3f} {int(channel[-1]) + 1}"
        if k % 1000 == 0:
            out.append(f"{time}  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY")
        out.append(f"{time}  Rx     {int(identifier, 16):04X}  {len(data) // 2}  "
                   f"{' '.join(data[j : j + 2] for j in range(0, len(data), 2))} ")
    return "\r\n".join(out) + "\r\n"


def split_frame(line: str) -> tuple[float, int, str, str]:
    """(time [s], bus from 0, identifier, data) of a line of candump."""
    stamp, channel, rest = line.split()[:3]
    return float(stamp[1:-1]), int(channel[-1]), *rest.split("#")[:2]


def savvycan(lines: list[str]) -> str:
    """CSV in the format GVRET, with microseconds since the first frame."""
    begin = split_frame(lines[0])[0]
    out = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for time, bus, identifier, data in map(split_frame, lines):
        cells = [data[k : k + 2] for k in range(0, 16, 2)]
        out.append(f"{(time - begin) * 1e6:.0f},{int(identifier, 16):08X},{str(len(identifier) > 3).lower()},Rx,{bus},"
                   f"{len(data) // 2},{','.join(cells)},")
    return "\n".join(out) + "\n"


def mdf2csv(lines: list[str]) -> str:
    """CSV of the converter of CSS Electronics."""
    out = ["TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes"]
    for time, bus, identifier, data in map(split_frame, lines):
        size = len(data) // 2
        out.append(f"{time:.6f};{bus + 1};{identifier};{len(identifier) > 3:d};{size};{size};0;0;0;{data}")
    return "\n".join(out) + "\n"


def quoted(lines: list[str]) -> str:
    """mdf2csv with quotes around every cell, blanks between the bytes, and dates."""
    rows = [line.split(";") for line in mdf2csv(lines).splitlines()]
    for row in rows[1:]:
        row[0] = datetime.fromtimestamp(float(row[0]), UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
        row[-1] = bytes.fromhex(row[-1]).hex(" ")
    return "\n".join(",".join(f'"{cell}"' for cell in row) for row in rows) + "\n"


def with_times(lines: list[str], names: tuple[str, str], to_text: Callable[[float, float], str]) -> str:
    """mdf2csv with other names of the times and the data. to_text(s since 1970, s since the first frame) -> time."""
    rows = [line.split(";") for line in mdf2csv(lines).splitlines()]
    times = [float(row[0]) for row in rows[1:]]
    rows[0][0], rows[0][-1] = names
    for row, time in zip(rows[1:], times, strict=True):
        row[0] = to_text(time, time - times[0])
    return "\n".join(map(";".join, rows)) + "\n"


def busmaster(lines: list[str]) -> str:
    """Times of a day, with a header as BUSMASTER writes it."""
    out = ["***BUSMASTER Ver 3.2.2***", "***START DATE AND TIME 3:9:2025 18:0:0:5***", "***HEX***",
           "***SYSTEM MODE***", "***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***"]
    for time, bus, identifier, data in map(split_frame, lines):
        stamp = clock(time % 86400.0).replace(".", ":")[:-2]
        out.append(f"{stamp} Rx {bus + 1} 0x{identifier} {'x' if len(identifier) > 3 else 's'} {len(data) // 2} "
                   f"{bytes.fromhex(data).hex(' ').upper()} ")
    return "\r\n".join([*out, "***[STOP LOGGING SESSION]***", ""])


def cl2000(lines: list[str]) -> str:
    """Days of the month and milliseconds; the header gives year and month."""
    start = datetime.fromtimestamp(split_frame(lines[0])[0], UTC)
    out = ["# Logger type: CL2000", f"# Time: {start:%Y%m%dT%H%M%S}", "# Time format: 4", "Timestamp;Type;ID;Data"]
    for time, _, identifier, data in map(split_frame, lines):
        stamp = datetime.fromtimestamp(round(time, 3), UTC)
        out.append(f"{stamp:%dT%H%M%S}{stamp.microsecond // 1000:03d};{int(len(identifier) > 3)};{identifier.lower()};"
                   f"{data.lower()}")
    return "\n".join([*out, ""])


def move_to_end_of_month(lines: list[str]) -> list[str]:
    """The log with its month ending after 10 s."""
    start = datetime.fromtimestamp(split_frame(lines[0])[0], UTC)
    return [shift_stamp(line, (datetime(2025, 10, 1, tzinfo=UTC) - start).total_seconds() - 10.0) for line in lines]


def zlg(lines: list[str], is_old: bool) -> str:
    """CSV of ZLG's CANTest. is_old: times in 0.1 ms and the direction of each frame, instead of times in s."""
    start = split_frame(lines[0])[0] - 600.0
    out = ["序号,系统时间,时间标识,CAN通道,ID号,帧类型,帧格式,CAN类型,长度,数据"]
    for number, (time, bus, identifier, data) in enumerate(map(split_frame, lines)):
        frame_format = "扩展帧" if len(identifier) > 3 else "标准帧"
        octets = f"x| {bytes.fromhex(data).hex(' ').upper()}"
        stamp = f"0x{round((time - start) * 1e4):06X}" if is_old else f"{time - start:.6f}"
        out.append(f'{number:05d},="12:04:59.533{chr(34) * is_old},{stamp},ch{bus + 1},' + (
            f"接收,0x{identifier.zfill(4)},数据帧,{frame_format},0x{len(data) // 2:02X},{octets} " if is_old else
            f"0x{identifier.lstrip('0')},数据帧,{frame_format},CAN,{len(data) // 2},{octets}"))
    return "\r\n".join([*out, ""])


def crtd(lines: list[str]) -> str:
    """As OVMS writes it."""
    frames = [f"{time:.6f} {bus + 1}R{29 if len(identifier) > 3 else 11} {identifier} {bytes.fromhex(data).hex(' ')}"
              for time, bus, identifier, data in map(split_frame, lines)]
    return "\n".join(["1756922400.000000 CXX OVMS", *frames]) + "\n"


def decimal_numbers(lines: list[str]) -> str:
    """Identifiers and bytes are decimal, as pandas writes a table of frames."""
    frames = [(time, bus, int(identifier, 16), bytes.fromhex(data))
              for time, bus, identifier, data in map(split_frame, lines)]
    table = pd.DataFrame({"Time": [frame[0] for frame in frames], "Bus": [frame[1] for frame in frames],
                          "ID": [frame[2] for frame in frames], "DLC": [len(frame[3]) for frame in frames]})
    for number in range(8):
        table[f"Data{number}"] = pd.array([frame[3][number] if number < len(frame[3]) else None for frame in frames],
                                          "Int64")
    table["Label"] = "R"
    return table.to_csv(index=False)


def python_can(lines: list[str], style: str) -> str:
    """CSV of python-can, but with hexadecimal data. style: of the identifiers."""
    out = ["timestamp,arbitration_id,extended,remote,error,dlc,data"]
    for time, _, identifier, data in map(split_frame, lines):
        number, is_extended = format(int(identifier, 16), style), len(identifier) > 3
        out.append(f"{time:.6f},{number},{is_extended:d},0,0,{len(data) // 2},{data}")
    return "\n".join(out) + "\n"


def truncate_lines(lines: list[str], every: int) -> str:
    return "\n".join(line[:20] if k % every == every - 1 else line for k, line in enumerate(lines)) + "\n"


def replace_line_5000(lines: list[str], line: str) -> str:
    return "\n".join([*lines[:5000], line, *lines[5001:]])


def shift_stamp(line: str, seconds: float) -> str:
    stamp, _, frame = line.partition(" ")
    return f"({float(stamp[1:-1]) + seconds:.6f}) {frame}"


def earlier_drive(lines: list[str]) -> list[str]:
    """The first third, an hour earlier."""
    return [shift_stamp(line, -3600.0) for line in lines[: len(lines) // 3]]


@pytest.mark.slow
def test_can_logs_of_other_times_are_named(ncom_folder: Path, drive_log: DriveLog, frame_lines: list[str]) -> None:
    (ncom_folder / "monday.log").write_text("\n".join(frame_lines))
    (ncom_folder / "sunday.log").write_text("\n".join(earlier_drive(frame_lines)))
    run = read(find_runs([ncom_folder])[0], CAR)
    assert_same(run.log, drive_log, max_lost=0, steering=0.003)
    assert [w for w in run.warnings if w.endswith("CAN logs that do not overlap it in time are not used: sunday.log")]


class Log(NamedTuple):
    """text: made of the lines of run.log; warning: pattern of an expected warning, empty if none is expected."""

    title: str
    name: str
    text: Callable[[list[str]], str]
    warning: str = ""
    encoding: str = "utf-8"


LOGS = [
    Log("truncated lines", "run.log", lambda lines: truncate_lines(lines, 3000),
        r"lines \(0\.03\d? %\) cannot be read .* line 3000"),
    Log("UTF-16", "run.log", "\n".join, encoding="utf-16"),
    Log("zeros as padding", "run.log", lambda lines: map_steering_frames(lines, lambda h, d: f"{h}#{d}000000"),
        "bytes are padding"),
    Log("FD, 12 bytes", "run.log", lambda lines: map_steering_frames(lines, lambda h, d: f"{h}##1{d.ljust(24, '0')}"),
        "have 12 bytes"),
    Log("FD, 64 bytes", "run.log", lambda lines: map_steering_frames(lines, lambda h, d: f"{h}##1{d.ljust(128, 'A')}"),
        "have 64 bytes"),
    Log("a frame of 70 bytes", "run.log", lambda lines: replace_line_5000(
        lines, lines[5000].split("#")[0] + "#" + "AA" * 70), "frames with more than 64 bytes were skipped: 1"),
    Log("a frame 0.8 s late", "run.log", lambda lines: replace_line_5000(lines, shift_stamp(lines[5001], 0.8))),
    Log("then an earlier drive", "run.log", lambda lines: "\n".join([*lines, *earlier_drive(lines)]),
        r" of 3\d\.\d s, 75 %\)"),
    Log("an earlier drive first", "run.log", lambda lines: "\n".join([*earlier_drive(lines), *lines]),
        r" of 3\d\.\d s, 75 %\)"),
    Log("candump as .txt", "run.txt", "\n".join),
    Log("BUSMASTER", "run.log", busmaster),
    Log("CL2000", "run.txt", cl2000),
    Log("CL2000 at the end of a month", "run.txt", lambda lines: cl2000(move_to_end_of_month(lines))),
    Log("ZLG, 0.1 ms", "run.csv", lambda lines: zlg(lines, is_old=True), encoding="gbk"),
    Log("ZLG, s", "run.csv", lambda lines: zlg(lines, is_old=False), encoding="utf-8-sig"),
    Log("CRTD", "run.crtd", crtd),
    Log("CRTD as .txt", "run.txt", crtd),
    Log("comment", "run.asc", lambda lines: asc(lines, comment="// Prüfstand"), encoding="cp1252"),
    Log("24 hours and pm", "run.asc", lambda lines: asc(lines, "Wed Sep 3 18:00:00.005 pm 2025")),
    Log("German date", "run.asc", lambda lines: asc(lines, "Mi Mär 3 18:00:00.005 2025"), encoding="cp1252"),
    Log("French date", "run.asc", lambda lines: asc(lines, "mercredi 3 septembre"), "its date .* cannot be read"),
    Log("without a header", "run.asc", lambda lines: "\n".join(asc(lines).splitlines()[4:])),
    Log("recorded twice", "run.asc", lambda lines: asc(lines) * 2, r"\(2\d\.\d of 5\d\.\d s, 50 %\)"),
    Log("8 digits", "run.trc", lambda lines: trc(lines, eight_digits=True), encoding="ascii"),
    Log("4 digits", "run.trc", lambda lines: trc(lines, eight_digits=False), encoding="ascii"),
    Log("version 1.2", "run.trc", trc_1_2, encoding="cp1252"),
    Log("SavvyCAN", "run.csv", savvycan),
    Log("mdf2csv", "run.csv", mdf2csv),
    Log("quoted", "run.csv", quoted),
    Log("times of day", "run.csv", lambda lines: with_times(lines, ("Time", "Data"), lambda _, elapsed: clock(
        (86390.0 + elapsed) % 86400.0))),
    Log("ISO 8601", "run.csv", lambda lines: with_times(lines, ("Time", "Data"), lambda time, _: datetime.fromtimestamp(
        time, UTC).isoformat())),
    Log("us since 1970", "run.csv", lambda lines: with_times(lines, ("timestamp", "Data"), lambda time, _: str(
        round(time * 1e6))), "its times were read in us"),
    Log("ns since 1970", "run.csv", lambda lines: with_times(lines, ("timestamp", "Data"), lambda time, _: str(
        round(time * 1e6) * 1000)), "its times were read in ns"),
    Log("ms", "run.csv", lambda lines: with_times(lines, ("time", "Data"), lambda _, elapsed: f"{elapsed * 1e3:.3f}"),
        "its times were read in ms"),
    Log("us", "run.csv", lambda lines: with_times(lines, ("time", "Data"), lambda _, elapsed: f"{elapsed * 1e6:.0f}"),
        "its times were read in us"),
    Log("us since the boot", "run.csv", lambda lines: with_times(
        lines, ("time", "Data"), lambda _, elapsed: f"{(2000.0 + elapsed) * 1e6:.0f}"), "its times were read in us"),
    Log("ms in the name", "run.csv", lambda lines: with_times(lines, ("Time [ms]", "Data"), lambda _, elapsed: (
        f"{elapsed * 1e3:.3f}".replace(".", ",")))),
    Log("decimal numbers", "run.csv", decimal_numbers, "its identifiers were read as decimal numbers"),
    Log("python-can, decimal", "run.csv", lambda lines: python_can(lines, "d"), "were read as decimal numbers"),
    Log("python-can, hexadecimal", "run.csv", lambda lines: python_can(lines, "#x")),
    Log("mdf2csv, truncated", "run.csv", lambda lines: truncate_lines(mdf2csv(lines).splitlines(), 3000),
        r"lines \(0\.03\d? %\) cannot be read .* line 3000"),
]


@pytest.mark.slow
@pytest.mark.parametrize("log", LOGS, ids=[f"{log.name}: {log.title}" for log in LOGS])
def test_can_log_gives_the_steering(ncom_folder: Path, drive_log: DriveLog, frame_lines: list[str], log: Log) -> None:
    (ncom_folder / log.name).write_bytes(log.text(frame_lines).encode(log.encoding))
    (ncom_folder / "README").write_text("no data")
    run = read(find_runs([ncom_folder])[0], CAR)
    assert_same(run.log, drive_log, max_lost=0, steering=0.003)
    assert_warned([w for w in run.warnings if "alignment" not in w], log.warning)


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "reason"), [
    (ReadSettings(search=(-9.0, 9.0)), "the INS time in the log determines the offset"),
    (ReadSettings(search=(-9.0, 9.0), offset=0.0), "the offset is given"), (ReadSettings(), "")])
def test_unused_search_is_reported(drive_folder: Path, settings: ReadSettings, reason: str) -> None:
    notes = [w for w in read(find_runs([drive_folder])[0], CAR, settings).warnings if "--search" in w]
    assert notes == ([f"--search is not used: {reason}"] if reason else [])


@pytest.mark.slow
@pytest.mark.parametrize("shift", [7200.0, 18.0 - 315964800.0])  # s, of a time zone, and of GPS time since 1980
def test_table_with_a_different_clock_is_aligned_by_its_signals(drive_folder: Path, drive_log: DriveLog,
                                                                tmp_path: Path, shift: float) -> None:
    cells = [[f"{float(row[0]) + shift:.3f}", *row[1:-1]] for row in rows(drive_log)]
    (tmp_path / "run.csv").write_text(csv(cells, ",".join(NAMES[:-1])))
    (tmp_path / "run.log").write_bytes((drive_folder / "run.log").read_bytes())
    alignment, expected = (read(find_runs([folder])[0], CAR).alignment for folder in (tmp_path, drive_folder))
    assert alignment is not None and expected is not None and "in GPS time?" in alignment.reasons[-1]
    difference = alignment.offset_at_ns(expected.at_ns) - expected.offset_at_ns(expected.at_ns)
    assert alignment.verdict == "doubtful" and abs(difference * 1e-9 - shift) < 0.005


@pytest.mark.parametrize("head", [
    b'x"y\rz\nid,length,data\n', b't,"a\rb",c',
    b"id,length,payload,time,x,y,yaw,vx,vy,yaw_rate,delta\n1,4.5,1,0,0,0,0,5,0,0,0\n"])
def test_other_files_are_no_can_log(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "other.csv").write_bytes(head)
    assert not is_can_log(tmp_path / "other.csv")


@pytest.mark.parametrize("ids, bytes_, bases", [
    ("2000,2001,,2002", "1,2", (10, 16)), ("600,601", "200,256", (10, 10)), ("0316,0317", "1,2", (16, 16)),
    ("600,601", "1,2", (0, 16)), ("600,6A1", "1,2", (16, 16)), ("600,0x601", "1,2", (16, 16))])
def test_number_base_of_a_table_of_frames(tmp_path: Path, ids: str, bytes_: str, bases: tuple[int, int]) -> None:
    rows = [f"{k},{name},2,{bytes_},R" for k, name in enumerate(ids.split(","))]
    (tmp_path / "a.csv").write_text("\n".join(["time,id,dlc,data0,data1,label", *rows, ""]))
    names = ["time", "id", "dlc", "data0", "data1", "label"]
    roles = {"time": 0, "id": 1, "length": 2, "data": 3}
    assert _find_number_formats(tmp_path / "a.csv", names, ",", roles) == (*bases, "s", True)


@pytest.mark.slow
@pytest.mark.parametrize(("change", "error"), [
    (lambda h, d: f"{h}#{d[:8]}", r"2\d+ of 2\d+ frames \(100 %\) have 4 bytes instead of 5 as in the DBC"),
    (lambda h, d: f"{h}#{d}010203", r"have 8 bytes instead of 5 as in the DBC; 2\d+ frames are not used"),
    (lambda h, d: f"{h.replace(' 002', ' 00000002')}#{d}", "has 11 bits in the DBC, but 29 bits in "),
])
def test_steering_frames_that_do_not_match_the_dbc_are_rejected(ncom_folder: Path, frame_lines: list[str], change,
                                                               error: str) -> None:
    (ncom_folder / "run.log").write_text(map_steering_frames(frame_lines, change))
    with pytest.raises(RunError, match=error):
        read(find_runs([ncom_folder])[0], CAR)


def test_steering_frames_without_a_usable_value_are_not_a_time_gap(ncom_folder: Path, frame_lines: list[str]) -> None:
    lines = [*frame_lines]
    steering = [k for k, line in enumerate(lines) if " 002#" in line]
    implausible, lost = steering[500:600], {*steering[1000:1100]}
    for k in implausible:  # low byte first: the largest angle that the signal can have
        head, _, data = lines[k].partition("#")
        lines[k] = f"{head}#FF7F{data[4:]}"
    (ncom_folder / "run.log").write_text("\n".join(line for k, line in enumerate(lines) if k not in lost))
    run = read(find_runs([ncom_folder])[0], CAR)
    findings = {finding.name: finding for finding in check(run.log, CAR, run.auxiliary).findings}
    assert re.search(r"100 of \d+ frames between .* were received but not used: .*SteeringWheelAngle implausible "
                     r"\(up to -?3276.7 deg\) in 100", findings["values_missing"].text)
    assert "1 gap in the steering data" in findings["time_gaps"].text
    assert findings["time_gaps"].value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("name", "warning"), [
    ("run.log", r"\d+\.\d of 2\d\.\d s of the INS \(5\d %\) are not used: no usable sample of the steering"),
    ("run.ncom", r"\d+\.\d of 2\d\.\d s of the steering \(5\d %\) are not used: no usable sample of the INS"),
])
def test_file_that_ends_early_causes_a_warning_with_the_unused_time_of_the_other(
        tmp_path: Path, drive_folder: Path, name: str, warning: str) -> None:
    """Nothing in the file itself shows that it is truncated."""
    for file in ("run.ncom", "run.log"):
        content = (drive_folder / file).read_bytes()
        (tmp_path / file).write_bytes(content[: content.rindex(b"\n", 0, len(content) * 45 // 100) + 1] if file == name
                                      else content)
    (run,) = find_runs([tmp_path])
    imported = import_run(run, CAR, tmp_path / "bag", ReadSettings(), lambda drive: ())
    for warnings in (read(run, CAR).warnings, imported.warnings):
        assert any(re.search(warning, text) for text in warnings)


def test_clock_of_a_vbo_is_aligned_with_a_can_log(tmp_path: Path, drive_folder: Path, drive_log: DriveLog) -> None:
    """This includes a VBO with a steering column, which other commands read as a complete drive."""
    (tmp_path / "run.vbo").write_text(vbo(drive_log))
    aligned = read_pair([tmp_path / "run.vbo", drive_folder / "run.log"], ReadSettings())
    reference = read_pair([drive_folder / "run.ncom", drive_folder / "run.log"], ReadSettings())
    shift = int(aligned.ins.time_ns[0]) - int(reference.ins.time_ns[0])
    assert aligned.alignment.offset_ns - reference.alignment.offset_ns == pytest.approx(shift, abs=10_000_000)


def test_alignment_names_the_log_it_finds_and_rejects_a_file_it_cannot_use(tmp_path: Path, drive_folder: Path) -> None:
    (tmp_path / "signals.csv").write_text("t,x,y,yaw,vx,vy,yaw_rate,delta\n0,0,0,0,0,0,0,0\n")
    pair = read_pair([drive_folder / "run.ncom"], ReadSettings())
    assert pair.warnings[0].endswith("run.ncom: its CAN log in the same folder is used: run.log")
    with pytest.raises(RunError, match=r"signals\.csv: this is neither the INS recording run\.ncom nor one of its CAN"):
        read_pair([drive_folder / "run.ncom", tmp_path / "signals.csv"], ReadSettings())


def test_vbo_without_steering_is_paired_with_the_can_log(tmp_path: Path, drive_folder: Path,
                                                         drive_log: DriveLog) -> None:
    head, mark, data = vbo(drive_log).partition("[data]\n")
    rows = "\n".join(row.rpartition(" ")[0] for row in data.splitlines())
    (tmp_path / "run.vbo").write_text(head.replace("\nSteer\n", "\n").replace(" Steer\n", "\n") + mark + rows + "\n")
    (tmp_path / "run.log").write_bytes((drive_folder / "run.log").read_bytes())
    for given in ([tmp_path], [tmp_path / "run.vbo", tmp_path / "run.log"]):
        (found,) = find_runs(given)
        run = read(found, CAR)
        assert len(found.can) == 1 and run.log.duration == pytest.approx(drive_log.duration, abs=0.1)
        assert "acceleration_x" not in run.auxiliary.missing  # it was not recorded


def test_truncated_blf_is_read_up_to_its_end_with_a_warning(ncom_folder: Path, drive_folder: Path,
                                                            drive_log: DriveLog) -> None:
    blf = ncom_folder / "run.blf"
    with can.BLFWriter(str(blf)) as writer:
        for message in can.LogReader(str(drive_folder / "run.log")):
            message.channel = int(str(message.channel)[-1])
            writer.on_message_received(message)
    (complete,) = find_runs([ncom_folder])
    assert_same(read(complete, CAR).log, drive_log, max_lost=0, steering=0.003)
    blf.write_bytes(blf.read_bytes()[: blf.stat().st_size // 2])
    run = read(find_runs([ncom_folder])[0], CAR)
    assert_warned(run.warnings, r"run\.blf: .*(truncated|header)")


@pytest.mark.parametrize("options", [(), ("--no-fd",)], ids=["with FD group", "without FD group"])
def test_mf4_of_firmware_with_virtual_channels(ncom_folder: Path, drive_folder: Path, drive_log: DriveLog,
                                               options: tuple[str, ...]) -> None:
    make = shared("failing/canedge_current_firmware_mf4/make.py")
    subprocess.run([sys.executable, make, drive_folder / "run.log", ncom_folder / "run.MF4", *options], check=True)
    run = read(find_runs([ncom_folder])[0], CAR)
    assert_same(run.log, drive_log, max_lost=0, steering=0.003)
    assert not [w for w in run.warnings if "alignment" not in w]


def test_steering_field_for_an_ins_with_can_logs_is_unused_or_replaces_them(tmp_path: Path, drive_folder: Path,
                                                                             drive_log: DriveLog) -> None:
    (source,) = find_runs([drive_folder / "run.ncom", drive_folder / "run.log"])
    settings = ReadSettings(steering=SteeringField("", "Steer", "wheel", "deg"))
    assert any("does not use --steering-field Steer, because its steering angle is in CAN logs" in warning
               for warning in read(source, CAR, settings).warnings)
    table = tmp_path / "run.vbo"
    table.write_text(vbo(drive_log))
    run = read(replace(source, kind="vbo", files=(table,)), CAR, settings)
    assert_warned(run.warnings, "this recording does not use its CAN logs, because an option names the steering angle")


def test_text_export_next_to_its_recording_is_not_a_run(tmp_path: Path, drive_log: DriveLog) -> None:
    (tmp_path / "a.csv").write_text(csv(rows(drive_log)))
    (tmp_path / "a.txt").write_text(csv([row[:-1] for row in rows(drive_log)], "\t".join(NAMES[:-1]), "\t"))
    assert [run.files for run in find_runs([tmp_path])] == [(tmp_path / "a.csv",)]


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_csv_or_bag_of_an_ins_is_paired_with_a_can_log(tmp_path: Path, drive_folder: Path, drive_log: DriveLog,
                                                       kind: str) -> None:
    (tmp_path / "run.log").write_bytes((drive_folder / "run.log").read_bytes())
    if kind == "csv":
        (tmp_path / "run.csv").write_text(csv([row[:7] for row in rows(drive_log)], ",".join(NAMES[:7])))
    else:
        write_bag(tmp_path / "run.mcap", drive_log, custom_steering=True)
    (source,) = find_runs([tmp_path])
    assert len(source.can) == 1 and source.problem is None
    run = read(source, CAR)
    assert_same(run.log, drive_log, max_lost=0, steering=0.003)
    assert run.provenance["reader"] == f"{kind} and CAN log"


@pytest.mark.slow
def test_yaw_of_a_csv_with_a_can_log_is_corrected(tmp_path: Path, drive_folder: Path, drive_log: DriveLog) -> None:
    (tmp_path / "run.log").write_bytes((drive_folder / "run.log").read_bytes())
    cells = [[*row[:3], f"{np.degrees(float(row[3])) % 360:.6f}", *row[4:7]] for row in rows(drive_log)]
    (tmp_path / "run.csv").write_text(csv(cells, ",".join(NAMES[:7])))
    (tmp_path / "run.yaml").write_text(f"csv: run.csv\ncan: run.log\ncorrect: {{yaw: {{scale: {np.pi / 180}}}}}\n")
    (source,) = find_runs([tmp_path / "run.yaml"])
    log = read(source, CAR).log
    np.testing.assert_allclose(np.cos(log.yaw - drive_log.yaw), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.diff(log.yaw), np.diff(drive_log.yaw), atol=1e-6)


@pytest.mark.parametrize(("times", "unit"), [
    (1.7e9 + 0.2 * np.arange(200), "s"), (1.7e9 + np.arange(200), "s"), (1.7e12 + 2.0 * np.arange(200), "ms"),
    (2.0e9 + 250.0 * np.arange(200), "us"), (0.02 * np.arange(200), "s"), (np.arange(200.0), "ms")])
def test_unit_of_times_in_a_table_of_frames(times: np.ndarray, unit: str) -> None:
    assert _find_time_unit(times) == unit
