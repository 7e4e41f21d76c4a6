"""CAN logs: a real CANedge2 file frame by frame, both MF4 layouts, splits, truncated files, other formats."""

import csv
import itertools
import re
import struct
from pathlib import Path

import can
import numpy as np
import pytest
from asammdf import MDF, Signal
from mdf_files import LogFrame, write_layout_2
from st_recordings.runs.can_formats import is_can_log
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.errors import RunError
from st_recordings.runs.frames import ERROR, EXTENDED, REMOTE, SENT, Frames
from st_recordings.runs.mf4 import parse_session, read_mf4
from support import GOLDEN_DATA, SETS, vectors

REAL = "can/canedge2_2F6913DB_00000004_00000001.MF4"
START_NS = 1_700_000_000_000_000_000
COLUMNS = ("time_ns", "id", "payload", "length", "bus", "flags")


def equal_frames(one: Frames, other: Frames) -> bool:
    return len(one) == len(other) and all((getattr(one, c) == getattr(other, c)).all() for c in COLUMNS)


def make_frames(n: int) -> list[LogFrame]:
    """Frames of three identifiers on two buses, 0.5 ms apart."""
    random = np.random.default_rng(0)
    kinds = ((0x002, 5, False), (0x604, 8, False), (0x18DAF110, 3, True))
    frames = []
    for k in range(n):
        identifier, size, extended = kinds[k % 3]
        frames.append(LogFrame(500 * k, 1 + k % 2, identifier, random.bytes(size), extended, k % 7 == 0))
    return frames


@pytest.mark.parametrize("which", SETS)
def test_real_file_frame_by_frame(which: str) -> None:
    log = read_mf4(vectors(which, REAL))
    frames = log.frames
    with vectors(which, REAL.replace(".MF4", ".frames.csv")).open() as stream:
        expected = list(csv.DictReader(stream))
    assert len(frames) == len(expected) == {"excerpt": 262, "complete": 5588}[which]
    for k, row in enumerate(expected):
        found = (
            f"{(frames.time_ns[k] - log.start_ns) * 1e-9:.6f}", str(frames.bus[k]), str(frames.flags[k] & SENT),
            str(int(frames.id[k] & EXTENDED != 0)), int(frames.id[k] & 0x1FFFFFFF), str(frames.length[k]),
            frames.payload[k, : frames.length[k]].tobytes().hex().upper(),
        )
        reference = (row["t_rel_s"], row["bus"], row["dir_tx"], row["ide"], int(row["id_hex"], 16), row["len"],
                     row["data_hex"])
        assert found == reference, f"frame {k}"


@pytest.mark.parametrize(("which", "middle"), [("excerpt", 20_000), ("complete", 60_000)])
def test_truncated_real_file_gives_the_frames_before_its_end(which: str, middle: int, tmp_path: Path) -> None:
    complete = read_mf4(vectors(which, REAL)).frames
    content = vectors(which, REAL).read_bytes()
    file = tmp_path / "truncated.MF4"
    counts = []
    for end in [*range(middle, middle + 37), *range(len(content) - 37, len(content)), 16_000, 5 * len(content) // 7]:
        file.write_bytes(content[:end])
        frames = read_mf4(file).frames
        assert equal_frames(frames, complete.select(slice(0, len(frames)))), f"truncated at byte {end}"
        counts.append(len(frames))
    assert counts[:37] == sorted(counts[:37])
    assert counts[36] - counts[0] in (1, 2)  # 37 bytes are one frame and its payload
    assert len(complete) - 3 <= min(counts[37:74]) <= max(counts[37:74]) <= len(complete)


@pytest.mark.parametrize(("name", "end"), [(REAL, 5000), ("can/synthetic_leaf_rt.mf4", -5000)])
def test_file_truncated_inside_its_index_is_rejected(tmp_path: Path, name: str, end: int) -> None:
    file = tmp_path / "truncated.MF4"
    file.write_bytes((GOLDEN_DATA / name).read_bytes()[:end])
    with pytest.raises(RunError, match=r"truncated\.MF4: the file is truncated or damaged \(.*\); copy it again from"):
        read_mf4(file)


def test_layout_2_of_firmware_01_07(tmp_path: Path) -> None:
    frames = make_frames(600)
    shuffled = [frames[k] for k in np.random.default_rng(1).permutation(600)]
    in_groups = sorted(shuffled, key=lambda f: (f.group, f.microseconds))  # times are in order only within a group
    log = read_can_logs([write_layout_2(tmp_path / "00000001.MF4", START_NS, in_groups)])
    assert log.start_ns == START_NS
    assert np.array_equal(log.frames.time_ns, [START_NS + f.microseconds * 1000 for f in frames])
    assert np.array_equal(log.frames.bus, [f.bus for f in frames])
    assert np.array_equal(log.frames.id, [f.identifier | (EXTENDED if f.extended else 0) for f in frames])
    found = [bytes(p[:n]) for p, n in zip(log.frames.payload, log.frames.length, strict=True)]
    assert found == [f.data for f in frames]
    assert np.array_equal(log.frames.flags & SENT != 0, [f.sent for f in frames])


def test_splits_of_a_session_are_joined_in_order_of_time(tmp_path: Path) -> None:
    session = tmp_path / "LOG" / "2F6913DB" / "00000004"
    session.mkdir(parents=True)
    frames = make_frames(900)
    names = ("00000001.MF4", "00000002-6099D010.MF4", "00000003.MF4")
    files = [write_layout_2(session / name, START_NS, frames[300 * k : 300 * (k + 1)]) for k, name in enumerate(names)]
    log = read_can_logs([files[2], files[0], files[1]])
    assert np.array_equal(log.frames.time_ns, [START_NS + f.microseconds * 1000 for f in frames])
    assert not log.warnings
    incomplete = read_can_logs([files[0], files[2]])
    assert len(incomplete.frames) == 600
    assert "files of the session are missing: 2" in incomplete.warnings[0]
    repeated = read_can_logs([*files, write_layout_2(session / "00000003-60AA0000.MF4", START_NS, frames[600:])])
    assert len(repeated.frames) == 900
    assert "frames that are in the logs more than once: 300" in repeated.warnings[0]


def test_session_and_number_follow_from_the_path() -> None:
    assert parse_session(Path("LOG/2F6913DB/00000004/00000012.MF4")) == ("LOG/2F6913DB/00000004", 12)
    assert parse_session(Path("00000007/00000001-6099D010.MF4")) == ("00000007", 1)
    assert parse_session(Path("x/canedge2_2F6913DB_00000004_00000003.MF4")) == ("x/canedge2_2F6913DB_00000004", 3)
    assert parse_session(Path("drive.mf4")) == ("drive.mf4", 1)


def test_unreadable_file_among_others_causes_a_warning(tmp_path: Path) -> None:
    readable = write_layout_2(tmp_path / "a.MF4", START_NS, make_frames(100))
    (tmp_path / "b.MF4").write_bytes(b"")
    log = read_can_logs([readable, tmp_path / "b.MF4"])
    assert len(log.frames) == 100
    assert "b.MF4: the file is empty" in log.warnings[0]


def test_frames_marked_as_invalid_are_left_out(tmp_path: Path) -> None:
    numbers = np.arange(100)
    rows = np.zeros(100, [("CAN_DataFrame.ID", "<u4"), ("CAN_DataFrame.DLC", "u1"),
                          ("CAN_DataFrame.DataBytes", "(8,)u1")])
    rows["CAN_DataFrame.ID"], rows["CAN_DataFrame.DLC"] = numbers, 8
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(rows, numbers * 0.01, name="CAN_DataFrame", invalidation_bits=numbers < 7)])
        mdf.save(tmp_path / "a.mf4")
    log = read_can_logs([tmp_path / "a.mf4"])
    assert log.frames.id.tolist() == list(range(7, 100))
    assert "7 of 100 frames (7 %) are marked as invalid by the logger" in log.warnings[0]


def test_times_after_the_clock_was_set_back_are_moved_forward(tmp_path: Path) -> None:
    frames = make_frames(400)
    file = tmp_path / "back.log"
    times = [2000 + f.microseconds * 1e-6 - (1.5 if k >= 200 else 0) for k, f in enumerate(frames)]
    file.write_text("".join(f"({t:.6f}) can0 {f.identifier & 0x7FF:03X}#{f.data.hex()}\n"
                            for t, f in zip(times, frames, strict=True)))
    log = read_can_logs([file])
    assert "clock was set back by 1.500 s; later times were moved forward" in log.warnings[0]
    assert (np.diff(log.frames.time_ns) >= 0).all()
    assert log.frames.time_ns[-1] - log.frames.time_ns[0] == pytest.approx(399 * 500_000, abs=1_000_000)


@pytest.mark.parametrize("error", [3600.0, -20.0])
def test_only_the_times_between_two_opposite_clock_steps_are_corrected(tmp_path: Path, error: float) -> None:
    file = tmp_path / "block.log"
    file.write_text("".join(f"({2000 + 0.001 * k + (error if 100 <= k < 200 else 0):.6f}) can0 002#{k:04X}\n"
                            for k in range(400)))
    log = read_can_logs([file])
    assert np.allclose(log.frames.time_ns * 1e-9, 2000 + 0.001 * np.arange(400), atol=0.002) and not log.steps
    assert f"clock was wrong by {error:+.3f} s for 0.099 s; these times were" in log.warnings[0]


@pytest.mark.parametrize("count", [1, 150])
def test_frames_of_zeros_are_no_change_of_the_clock(tmp_path: Path, count: int) -> None:
    """A damaged part of an MF4 has the time 0; the frames after it keep their times."""
    seconds = 15 + 0.001 * np.arange(2000)
    seconds[1000:1000 + count] = 0
    file = tmp_path / "zeros.log"
    file.write_text("".join(f"({2000 + t:.6f}) can0 002#{k:04X}\n" for k, t in enumerate(seconds)))
    log = read_can_logs([file])
    assert log.frames.time_ns[-1] == 2016_999_000_000 and not log.steps
    assert "the logger's clock was wrong by -" in log.warnings[0]


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("extension", ["log", "asc", "trc", "csv"])
def test_text_logs_in_utf_16_are_read(tmp_path: Path, extension: str, codec: str) -> None:
    file = tmp_path / f"drive.{extension}"
    with can.Logger(file) as writer:
        for k in range(50):
            writer.on_message_received(can.Message(timestamp=1.7e9 + 0.01 * k, arbitration_id=2, data=[k],
                                                   is_extended_id=False))
    file.write_bytes(file.read_text(encoding="utf-8").encode(codec))
    assert is_can_log(file)
    assert read_can_logs([file]).frames.payload[:, 0].tolist() == list(range(50))


@pytest.mark.parametrize("extension", [".mfc", ".mfe", ".mfm", ".MF4"])
def test_compressed_or_encrypted_logger_file_is_rejected_with_its_converter(tmp_path: Path, extension: str) -> None:
    file = tmp_path / f"00000001{extension}"
    file.write_bytes(b"Generic File" + bytes(100))
    with pytest.raises(RunError, match=r"container format of CSS Electronics, .*; convert it with their mdf2finalized"):
        read_can_logs([file])


@pytest.mark.parametrize("extension", [".log", ".asc", ".blf", ".trc", ".csv"])
def test_logs_written_by_python_can(tmp_path: Path, extension: str) -> None:
    frames = make_frames(300)
    file = tmp_path / f"drive{extension}"
    with can.Logger(file) as writer:
        for f in frames:
            writer.on_message_received(can.Message(
                timestamp=START_NS * 1e-9 + f.microseconds * 1e-6, arbitration_id=f.identifier,
                is_extended_id=f.extended, data=f.data, channel=f.bus - 1))
    log = read_can_logs([file])
    found = log.frames
    assert np.array_equal(found.id, [f.identifier | (EXTENDED if f.extended else 0) for f in frames])
    assert [bytes(p[:n]) for p, n in zip(found.payload, found.length, strict=True)] == [f.data for f in frames]
    # ASC and TRC have milliseconds and fractions of them, and a start in local time.
    elapsed_us = (found.time_ns - found.time_ns[0]) // 1000
    assert np.abs(elapsed_us - [f.microseconds for f in frames]).max() <= 100
    if extension in (".log", ".blf", ".csv"):
        assert found.time_ns[0] == START_NS
    if extension in (".log", ".blf"):
        assert np.array_equal(found.bus, [f.bus for f in frames])


@pytest.mark.parametrize("kind", ["content", "head", "length", "type", "method"])
def test_blf_is_read_behind_a_damaged_container(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "drive.blf"
    with can.BLFWriter(file) as writer:
        for k in range(20_000):
            writer.on_message_received(can.Message(
                timestamp=1.7e9 + 0.001 * k, arbitration_id=2, is_extended_id=False, data=k.to_bytes(4, "little")))
    content = bytearray(file.read_bytes())
    second = content.index(b"LOBJ\x10\0", content.index(b"LOBJ\x10\0") + 1)
    offset, damage = {"content": (300, bytes(64)), "head": (0, bytes(8)), "length": (8, b"\xff" * 3),
                      "type": (12, b"\x63"), "method": (16, b"\x63")}[kind]
    content[second + offset : second + offset + len(damage)] = damage
    file.write_bytes(content)
    log = read_can_logs([file])
    numbers = log.frames.payload[:, :4].copy().view("<u4")[:, 0]
    assert len(set(numbers)) == len(numbers) < 20_000
    assert numbers[-1] == 19_999 and (np.diff(numbers.astype(int)) == 1).sum() == len(numbers) - 2
    assert re.search(r"damaged after frame \d+ .*; frames in \d+ of \d+ bytes \(\d\d %\) may be", log.warnings[0])


DATE = "date Mon May 4 10:11:12.000 am 2026\n"
BUSMASTER = "***BUSMASTER Ver 3.2.2***\n***HEX***\n***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***\n"
ASC = "  1  2             Rx   d 3 01 02 03\n"
KVASER = "      Kvaser Memorator Log\n      ====================\n\nSettings:\n   Format of id field:   HEX\n"
VEHICLE_SPY = "Line,Abs Time(Sec),Rel Time (Sec),Status,Er,Tx,Description,Network,Node,{},Value,Trigger,Signals\n"


@pytest.mark.parametrize(("name", "lines"), [
    ("a.log", [f" (1436509052.{k}00000)  can0  002   [3]  01 02 03\n" for k in range(3)]),
    ("a.log", [f" (2015-07-10 06:17:32.{k}00000)  can0  RX - -  002   [3]  01 02 03   '...'\n" for k in range(3)]),
    ("a.log", [f" (\x1b[34m1436509052.{k}00000\x1b[0m)  can0  002   [3]  01 02 03\n" for k in range(3)]),
    ("a.log", [f" (1436509052.{k}00000)  can0  002   [3]  03`02`01\n" for k in range(3)]),
    ("a.log", [f" (1436509052.{k}00000)  can0  002   [3]  01 02 03 ::\nSteer(\n    angle: 3\n)\n" for k in range(3)]),
    ("a.log", [*(f" (1436509052.{k}00000)  can0  002   [3]  01 02 03\n" for k in range(3)),
               " (1436509052.300000)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n",
               "\tcontroller-problem{rx-error-warning}\n"]),
    ("a.log", [f" (1436509052.{k}00000)  can0  20000088   [8]  00 00 08 00 00 00 00 00   ERRORFRAME\n\tbus-error\n"
               f" (1436509052.{k}00000)  can0  002   [3]  01 02 03\n" for k in range(3)]),
    ("steps.log", [f" (000.{100000 * (k > 0):06d})  can0  002   [3]  01 02 03\n" for k in range(3)]),
    ("a.crtd", ["1436509051.900000 CXX OVMS\n", *(f"1436509052.{k}00000 1R11 002 01 02 03\n" for k in range(3))]),
    ("busmaster.log", [BUSMASTER, *(f"11:49:12:{k}000 Rx 1 0x002 s 3 01 02 03 \n" for k in range(3))]),
    ("busmaster.log", [BUSMASTER.replace("HEX", "DEC"), *(
        f"11:49:12:{k}000 Rx 1 2 s 3 001 002 003 \n" for k in range(3))]),
    ("a.log", [f"(1436509052.{k}00000) can0 {frame}\n" for k in range(3) for frame in (
        "20000004#0004000000000000", "002#010203")]),
    ("kvaser.txt", [KVASER, *(f"{k / 10:12.6f}  1  {2:10X}    Rx          3  01 02 03 {k + 1:9d}\n" for k in range(3)),
                    "    0.300000  1  ErrorFrame    Rx               ERROR FRAME               4\n"]),
    ("canking.log", ["Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir\n", *(
        f" 0    00000002         3  01  02  03                      {k / 10:12.6f} R\n" for k in range(3))]),
    ("vehicle_spy.csv", ["Vehicle Spy 3 Bus Traffic File\nStart Time,6:00:00 PM\n\n", *(
        VEHICLE_SPY.format(names) for names in (
            "ID,Cycle,Ch,B1-256", "Arb ID,Remote/EDL-BRS-ESI,Xtd,B1,B2,B3,B4", "PT,Trgt,Src,B1,B2,B3,B4")), *(
        f"{k + 1},{k / 10:.9f},0.1,67371008,F,F,HS CAN $2,HS CAN,,2,F,F,01,02,03,,,\n" for k in range(3))]),
    ("ixxat.csv", ['"Bus","No","Time (abs)","State","ID (hex)","DLC","Data (hex)","ASCII"\n', *(
        f'"CAN","{k + 999:,}","11:49:12.{k}00000","","2","3","01 02 03","..."\n' for k in range(3))]),
    ("busmaster.log", [BUSMASTER, *(f"0:0:0:{1000 * (k > 0):04d} Rx 1 0x002 s 3 01 02 03\n" for k in range(3))]),
    ("a.txt", [*(f"Timestamp: 1436509052.{k}00000    ID:      002    S Rx                DL:  3    01 02 03"
                 f"{'Channel: can0':>30}\n" for k in range(3)),
               "Timestamp: 1436509052.300000    ID:      000    X Rx E              DL:  0\n"]),
    ("a.txt", [f"Timestamp: 1436509052.{k}00000    ID:      002    S Rx     F BS EI    DL:  3    01 02 03"
               f"{'Channel: 0':>27}\n" for k in range(3)]),
    ("a.txt", [f"Timestamp: 1436509052.{k}00000        ID: 0002    000    DLC: 3    01 02 03\n" for k in range(3)]),
    ("a.asc", [DATE, "base hex  timestamps absolute\n", *(f"   {k / 10:.6f}{ASC}" for k in range(3))]),
    ("a.asc", [DATE, "base hex  timestamps relative\n", *(f"   {0.1 * (k > 0):.6f}{ASC}" for k in range(3))]),
    ("a.asc", [DATE, "base hex  timestamps absolute\n", *(f"   0,{k}00000{ASC}" for k in range(3))]),
    ("a.asc", [DATE, "base hex  timestamps absolute\n", *(
        f"   0.{k}00000  1  Steering  Rx   d 3 01 02 03  Length = 0 BitCount = 0 ID = 2\n" for k in range(3))]),
    ("version_3.trc", [";$FILEVERSION=3.0\n;$STARTTIME=46146.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n", *(
        f"{k + 1:7} {100 * k:13.3f} DT 1      0002 Rx -  3    01 02 03\n" for k in range(3))]),
    ("rostopic.csv", ["%time,field.header.seq,field.header.stamp,field.id,field.is_rtr,field.is_extended,"
                      "field.is_error,field.dlc,field.data0,field.data1,field.data2,field.data3\n", *(
        f"1436509052{k}00000000,{k},0,2,0,0,0,3,1,2,3,0\n" for k in range(3))]),
])
def test_variants_of_candump_and_asc(tmp_path: Path, name: str, lines: list[str]) -> None:
    (tmp_path / name).write_text("".join(lines))
    log = read_can_logs([tmp_path / name])
    frames = log.frames.select(log.frames.flags & ERROR == 0)
    assert np.diff(frames.time_ns).tolist() == [10**8, 10**8] and frames.id.tolist() == [2, 2, 2]
    assert frames.payload[:, :4].tolist() == [[1, 2, 3, 0]] * 3
    assert frames.bus.tolist()[0] in (1, 2) or name.endswith(".csv")
    assert not any("lines" in warning for warning in log.warnings)
    assert not name.startswith("a.") or name == "a.asc" or frames.time_ns[0] == 1_436_509_052_000_000_000


@pytest.mark.parametrize(("header", "row", "data"), [
    ("Time,ID,DLC,B0,B1,B2,B3", "0.1,1A2,3,A1,B2,C3,00", "a1b2c3"),
    ("Time,ID,Message,DLC,D0,D1,D2", "0.1,1A2,Steering,3,A1,B2,C3", "a1b2c3"),
    ("Time,ID,Message,DLC,Payload", "0.1,1A2,Steering,3,A1B2C3", "a1b2c3"),
    ("Time;Chn;ID;Name;Dir;DLC;Data", "0.1;CAN 1;18FEF100x;;Rx;2;0A 02", "0a02"),
    ("Time,ID,Format,DLC,Data", "0.1,18FEF100,Extended,2,0A02", "0a02"),
    ("Time,ID,DLC,Data", f"0.1,1A2,15,{'0A' * 64}", "0a" * 64),  # lengths of CAN FD as a code
    ("Time,ID,DLC,Data", f"0.1,1A2,12,{'0A' * 24}", "0a" * 24),
    ("Time,ID,DLC,Data", f"0.1,1A2,12,{'0A' * 12}", "0a" * 12),
    ("Time,ID,DLC,D0,D1", f"0.1,1A2,9{',0A' * 12}", "0a" * 12),
    ("Time,ID,DLC,D0,D1", f"0.1,1A2,12{',0A' * 12}", "0a" * 12),
    ("Time,ID,DLC,Data", "0.1,0x1A2,2,0x0A 0x1B", "0a1b"), ("Time,ID,DLC,Data", "0.1,1A2,3,0xAB", "d31001"),  # base 64
    ("time,addr,bus,data", "0.1,418,0,0a1b", "0a1b"), ("time,addr,bus,data", "0.1,0x1a2,0,0x0A1B", "0a1b"),  # Cabana
    ("Time,Bus,MessageID,Message,MessageLength", "0.1,0,0x1a2,0x0a1b,2", "0a1b"),  # panda
    ("timestamp,arbitration_id,data_field,attack", "0.1,1A2,0A1B,0", "0a1b"),
    (VEHICLE_SPY.format("Arb ID,Remote,Xtd," + ",".join(f"B{k}" for k in range(1, 10))).strip(),
     "1,0.1,0.1,6,F,F,,HS CAN,,1A2,F,F,0A,02,03,04,05,06,07,08,09,3C,,", "0a0203040506070809")])
def test_bytes_of_csv_logs(tmp_path: Path, header: str, row: str, data: str) -> None:
    (tmp_path / "log.csv").write_text(f"{header}\n{row}\n")
    frames = read_can_logs([tmp_path / "log.csv"]).frames
    assert bytes(frames.payload[0, :frames.length[0]]).hex() == data
    assert frames.id[0] in (0x1A2, 0x18FEF100 | EXTENDED)


def test_channels_of_kvaser_are_buses(tmp_path: Path) -> None:
    rows = [f"0.{k},{k},1A2,,2,0A,1B,{k}\n" for k in (1, 2)]
    (tmp_path / "log.csv").write_text("Time,Channel,ID,Flags,DLC,Data0,Data1,Counter\n" + "".join(rows))
    assert read_can_logs([tmp_path / "log.csv"]).frames.bus.tolist() == [1, 2]


def test_networks_of_vehicle_spy(tmp_path: Path) -> None:
    names = "Arb ID,Remote,Xtd,B1,B2,B3"
    rows = [f"1,0.1,0.1,6,F,F,,{network},,1A2,F,F,{data},,\n" for network, data in (
        ("HS CAN", "0A,02,03"), ("MS CAN", "0A,02,03"), ("HS CAN", "0A,,03"))]
    (tmp_path / "log.csv").write_text(VEHICLE_SPY.format(names) + "".join(rows))
    log = read_can_logs([tmp_path / "log.csv"])
    assert log.frames.bus.tolist() == [1, 2]
    assert any("1 of 4 lines" in warning for warning in log.warnings)


@pytest.mark.parametrize(("start", "pause"), [(3590, 0), (3590, 1500), (86390, 0), (86390, 100), (86390, 40000)])
@pytest.mark.parametrize("busmaster", [False, True])
def test_clock_times_continue_past_the_hour_and_midnight_also_after_a_pause(
        tmp_path: Path, start: int, pause: int, busmaster: bool) -> None:
    """A spreadsheet writes minutes and seconds without the hour."""
    ms = 1000 * start + 10 * np.arange(2000) + 1000 * pause * (np.arange(2000) >= 1000)
    h, m, s = ms // 3_600_000 % 24, ms // 60_000 % 60, ms % 60_000 / 1000
    texts = [f"{a:02d}:{b:02d}:{c:06.3f}" for a, b, c in zip(h, m, s, strict=True)]
    if busmaster:
        lines = [BUSMASTER, *(f"{text.replace('.', ':')}0 Rx 1 0x123 s 2 01 02\n" for text in texts)]
    else:
        lines = ["Time,ID,DLC,Data\n", *(f"{text[3 * (start < 3600):]},1A3,2,0102\n" for text in texts)]
    (tmp_path / f"a.{'log' if busmaster else 'csv'}").write_text("".join(lines))
    log = read_can_logs([next(tmp_path.iterdir())])
    np.testing.assert_array_equal(log.frames.time_ns, ms * 10**6)
    assert not log.warnings


def test_candump_with_a_coarse_clock_from_0_is_not_read_as_time_steps(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("".join(f" (000.{k // 3:03d}000)  can0  002   [1]  01\n" for k in range(600)))
    frames = read_can_logs([tmp_path / "a.log"]).frames
    assert frames.time_ns[-1] - frames.time_ns[0] == 199_000_000


def test_asc_date_in_a_code_page_far_behind_the_header(tmp_path: Path) -> None:
    begin = "Begin Triggerblock Mon {} 4 {} am 2024\n"
    lines = ["date Mon Mar 4 10:11:12 am 2024\n", "base hex  timestamps absolute\n", begin.format("Mar", "10:11:12"),
             *(f"   {k / 1000:.6f}{ASC}" for k in range(3000)), begin.format("M\u00e4r", "10:21:12"),
             *(f"   {k / 1000:.6f}{ASC}" for k in range(10)), "End TriggerBlock\n"]
    (tmp_path / "a.asc").write_bytes("".join(lines).encode("cp1252"))
    log = read_can_logs([tmp_path / "a.asc"])
    assert log.frames.time_ns[3000] - log.frames.time_ns[0] == 600 * 10**9 and not log.warnings


def test_frame_types_of_a_busmaster_log(tmp_path: Path) -> None:
    lines = ["10:00:00:0000 Tx 2 0x18FEF100 x 2 01 02", "10:00:00:1000 Rx 1 0x123 sr 8 ", "10:00:00:2000 Rx 1 0x7 s 0"]
    (tmp_path / "a.log").write_text(BUSMASTER + "\n".join(lines) + "\n***[STOP LOGGING SESSION]***\n")
    frames = read_can_logs([tmp_path / "a.log"]).frames
    assert frames.id.tolist() == [0x18FEF100 | EXTENDED, 0x123, 7] and frames.bus.tolist() == [2, 1, 1]
    assert frames.length.tolist()[::2] == [2, 0] and frames.flags.tolist() == [SENT, REMOTE, 0]


def test_candump_in_bits_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(" (1436509052.000000)  can0  002   [1]  00000001\n" * 3)
    with pytest.raises(RunError, match="this is not a CAN log of a known format"):
        read_can_logs([tmp_path / "a.log"])


def test_candump_without_times_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("  can0  002   [3]  01 02 03\n" * 3)
    with pytest.raises(RunError, match=r"this output of candump has no time stamps; record again with candump -l"):
        read_can_logs([tmp_path / "a.log"])


def test_log_with_the_wrong_extension_is_read_by_its_content(tmp_path: Path) -> None:
    content = "(1700000000.000000) can0 002#1D000007B0\n(1700000000.010000) can0 002#1D000007B1\n"
    file = tmp_path / "drive.asc"
    file.write_text(content)
    log = read_can_logs([file])
    assert len(log.frames) == 2
    assert "is a candump, BUSMASTER, CRTD, CL2000, Kvaser or ZLG log with the extension .asc" in log.warnings[0]
    mf4 = write_layout_2(tmp_path / "drive.log", START_NS, make_frames(10))
    assert len(read_can_logs([mf4]).frames) == 10


@pytest.mark.parametrize(("name", "content", "message"), [
    ("empty.MF4", b"", "the file is empty"),
    ("text.MF4", b"time,value\n1,2\n", "this is not an MF4 file"),
    ("noise.log", bytes(range(256)) * 10, "this is not a CAN log of a known format"),
    ("packets.asc", b"\xe7" + bytes(71), "this is not a CAN log of a known format"),
    ("can.pcap", b"\xd4\xc3\xb2\xa1\2\0\4\0" + bytes(8) + b"\0\0\4\0\xe3\0\0\0" + bytes(64),
     r"this is a network capture \(pcap\) of CAN frames"),
    ("can.pcapng", b"\n\r\r\n\0\0\0\x1c\x1a\x2b\x3c\x4d\0\1\0\0" + b"\xff" * 8 + b"\0\0\0\x1c"
     + b"\0\0\0\1\0\0\0\x14\0\xe3" + bytes(64), r"this is a network capture \(pcap\) of CAN frames"),
    ("nothing.log", b"(1.0) can0 002#not hexadecimal\n", "it contains no usable frames"),
])
def test_file_that_is_not_a_can_log_is_rejected(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    assert is_can_log(file) is (name not in ("noise.log", "packets.asc"))
    with pytest.raises(RunError, match=rf"{name}: ({message})"):
        read_can_logs([file])


def test_truncated_last_line_is_skipped_with_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "truncated.log"
    file.write_text("(1700000000.000000) can0 002#1D000007B0\n(1700000000.010000) can0 002#1D0000\n(17000000")
    log = read_can_logs([file])
    assert len(log.frames) == 2
    assert "1 of 3 lines (33 %) cannot be read and were skipped; the first is line 3" in log.warnings[0]


def test_damaged_identifier_is_skipped_with_a_warning(tmp_path: Path) -> None:
    """A lost digit and # give an identifier of more than 32 bits."""
    lines = [f"(1700000000.{k}00000) can0 002#1D000007B0\n" for k in range(4)]
    (tmp_path / "a.log").write_text("".join([*lines, "(1700000000.500000) can0 0021D000007B#01\n"]))
    log = read_can_logs([tmp_path / "a.log"])
    assert log.frames.id.tolist() == [2] * 4 and "; the first is line 5" in log.warnings[0]


@pytest.mark.parametrize("start", ["45903,75", "1e13"])
def test_trc_with_an_unreadable_start_is_relative(tmp_path: Path, start: str) -> None:
    rows = [f"{k} {k}.0 DT 0123 Rx 2 01 02\n" for k in range(1, 4)]
    (tmp_path / "a.trc").write_text(f";$FILEVERSION=2.0\n;$STARTTIME={start}\n;$COLUMNS=N,O,T,I,d,l,D\n{''.join(rows)}")
    log = read_can_logs([tmp_path / "a.trc"])
    assert log.frames.time_ns.tolist() == [10**6, 2 * 10**6, 3 * 10**6] and not log.is_utc
    assert "; the first is line 2" in log.warnings[0]


@pytest.mark.parametrize(("header", "row"), [
    (";$FILEVERSION=1.1\n;\n", "{k}) {k}.0 Rx 0123 2 01 02\n"),
    (";$FILEVERSION=1.3\n;\n", "{k}) {k}.0 2 Rx 0123 - 2 01 02\n"),
    (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n", "{k} {k}.0 DT 2 0123 Rx - 2 01 02\n")])
def test_trc_has_the_bus_numbers_of_the_file(tmp_path: Path, header: str, row: str) -> None:
    (tmp_path / "a.trc").write_text(header + "".join(row.format(k=k) for k in range(1, 4)))
    expected = 1 if "1.1" in header else 2  # version 1.1 has no buses
    assert read_can_logs([tmp_path / "a.trc"]).frames.bus.tolist() == [expected] * 3


def test_mf4_without_can_frames_is_rejected(tmp_path: Path) -> None:
    file = write_layout_2(tmp_path / "quiet.MF4", START_NS, [])
    with pytest.raises(RunError, match=r"quiet\.MF4: the log contains no CAN frames"):
        read_can_logs([file])


@pytest.mark.parametrize(("version", "message"), [
    ("4.10", "the log contains no raw CAN frames, only decoded signals: SteeringWheelAngle; .*under the key csv of"),
    ("3.30", r"this is MDF version 3.30; CAN frames are only read from version 4; convert it with asammdf"),
])
def test_mdf_of_decoded_signals_or_of_version_3_is_rejected(tmp_path: Path, version: str, message: str) -> None:
    with MDF(version=version) as log:
        log.append([Signal(np.sin(np.arange(9.0)), np.arange(9.0), name="SteeringWheelAngle", unit="deg")])
        file = log.save(tmp_path / "decoded.mf4")
    with pytest.raises(RunError, match=message):
        read_can_logs([Path(file)])


def test_fd_frames_of_64_bytes(tmp_path: Path) -> None:
    file = tmp_path / "fd.log"
    file.write_text(f"(1700000000.000000) can0 123##1{'AB' * 64}\n(1700000000.100000) can0 002#1D000007B0\n")
    frames = read_can_logs([file]).frames
    assert frames.payload.shape == (2, 64)
    assert (frames.payload[0] == 0xAB).all()
    assert frames.length.tolist() == [64, 5]
    assert struct.unpack("<h", frames.payload[1, :2].tobytes()) == (29,)


@pytest.mark.parametrize(("known_ids", "ids", "warning"), [
    ({2, 644, 645}, [2, 644, 645, 716], "its identifiers were read as decimal numbers"),
    ({0x2, 0x644, 645, 0x716}, [0x2, 0x644, 0x645, 0x716], ""),
    ((), [0x2, 0x644, 0x645, 0x716], "its identifiers may be decimal or hexadecimal numbers; they were read as hexa")])
def test_dbc_decides_whether_identifiers_are_decimal(tmp_path: Path, known_ids, ids: list[int], warning: str) -> None:
    lines = [f"{0.01 * k:.3f},{name},1,1A" for k, name in enumerate((2, 644, 645, 716))]
    (tmp_path / "a.csv").write_text("\n".join(["Time,ID,DLC,Data", *lines, ""]))
    log = read_can_logs([tmp_path / "a.csv"], known_ids)
    assert log.frames.id.tolist() == ids
    assert (warning in log.warnings[0]) if warning else not log.warnings


def test_decimal_identifier_that_is_extended_only_as_a_hexadecimal_number(tmp_path: Path) -> None:
    lines = [f"{0.01 * k:.3f},{1000 if k > 5500 else 100},1,1A" for k in range(5600)]
    (tmp_path / "a.csv").write_text("\n".join(["Time,ID,DLC,Data", *lines, ""]))
    assert {*read_can_logs([tmp_path / "a.csv"], {100, 1000}).frames.id.tolist()} == {100, 1000}


def test_letter_far_behind_the_header_shows_that_identifiers_are_hexadecimal(tmp_path: Path) -> None:
    lines = [f"{0.01 * k:.3f},{'64A' if k == 5500 else 644},1,1A" for k in range(5600)]
    (tmp_path / "a.csv").write_text("\n".join(["Time,ID,DLC,Data", *lines, ""]))
    log = read_can_logs([tmp_path / "a.csv"], {644})
    assert {*log.frames.id.tolist()} == {0x644, 0x64A} and not log.warnings


def test_csv_with_unreadable_times_is_rejected_with_what_to_export(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Time,ID,DLC,Data\n" + "noon:ish,7A,1,1A\n" * 9)
    with pytest.raises(RunError, match=r"no usable frames .*; export its times in seconds, and identifiers and"):
        read_can_logs([tmp_path / "a.csv"])


@pytest.mark.parametrize(("number", "stamp"), [(40, "1699999500.0"), *itertools.product(
    (0, 40, 99), ("nan", "-5.0", "0.5", "4100000000.0", "1" + "0" * 300))])
def test_frame_with_an_impossible_time_is_skipped_and_counted(tmp_path: Path, number: int, stamp: str) -> None:
    lines = [f"({1_700_000_000 + 0.01 * k:.6f}) can0 123#{k:02X}" for k in range(100)]
    lines[number] = f"({stamp}) can0 123#FF"
    (tmp_path / "log.log").write_text("\n".join(lines) + "\n")
    log = read_can_logs([tmp_path / "log.log"])
    np.testing.assert_array_equal(log.frames.payload[:, 0], np.delete(np.arange(100), number))
    assert log.warnings == (f"{tmp_path / 'log.log'}: frames with an impossible time were skipped: 1",)


@pytest.mark.parametrize("extension", [".asc", ".trc"])
def test_frames_of_two_buses_written_slightly_out_of_order_are_no_time_steps(tmp_path: Path, extension: str) -> None:
    times = [t for i in range(500) for t in (0.01 * i, 0.01 * i - 0.0003 if i else 0.0002)]
    asc = "base hex  timestamps absolute\ninternal events logged\n" + "".join(
        f"{t:11.6f} {1 + k % 2}  123             Rx   d 2 01 02\n" for k, t in enumerate(times))
    trc = ";$FILEVERSION=1.1\n;\n" + "".join(
        f"{k:6d}) {1e3 * t:11.1f}  Rx     0123  2  01 02\n" for k, t in enumerate(times, 1))
    file = tmp_path / f"log{extension}"
    file.write_text(asc if extension == ".asc" else trc)
    log = read_can_logs([file])
    assert np.ptp(log.frames.time_ns) * 1e-9 == pytest.approx(4.99, abs=0.01)
    assert not any("were summed" in warning for warning in log.warnings)
