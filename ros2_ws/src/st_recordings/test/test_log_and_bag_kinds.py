"""One drive in CAN logs and bags that people bring: read the same, with a warning on what is not used, or refused."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from drive_kinds import CAR, NAMES, assert_same, assert_warned, csv, rows, vbo, write_bag
from mcap.writer import CompressionType, IndexType
from raw_drives import write_drives
from st_core.checks import check
from st_core.log import DriveLog
from st_recordings.runs import ReadSettings, RunError, find_runs, read
from st_recordings.runs.raw import read_pair
from st_recordings.runs.run_types import SteeringField
from st_recordings.runs.write import import_run
from support import shared


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DriveLog]:
    """(folder with run.ncom and run.log, the drive in them)."""
    folder = write_drives(tmp_path_factory.mktemp("drive"), {}, 0, (("sweep", 26.0),)) / "sweep"
    return folder, read(find_runs([folder])[0], CAR).log


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
    ("run.log", lambda lines: spoilt(lines, 3000), "utf-8", r"lines \(0\.03\d? %\) cannot be read .* line 3000"),
    ("run.log", "\n".join, "utf-16", ""),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}#{d}000000"), "utf-8", "bytes are padding"),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}##1{d.ljust(24, '0')}"), "utf-8", "have 12 bytes"),
    ("run.log", lambda lines: changed(lines, lambda h, d: f"{h}##1{d.ljust(128, 'A')}"), "utf-8", "have 64 bytes"),
    ("run.log", lambda lines: replaced(lines, lines[5000].split("#")[0] + "#" + "AA" * 70), "utf-8",
     "frames with more than 64 bytes were skipped: 1"),
    ("run.log", lambda lines: replaced(lines, "(1e300) " + lines[5000].split(" ", 1)[1]), "utf-8",
     "frames with an impossible time were skipped: 1"),
    ("run.asc", lambda lines: asc(lines, comment="// Prüfstand"), "cp1252", ""),
    ("run.asc", lambda lines: asc(lines, "Wed Sep 3 18:00:00.005 pm 2025"), "utf-8", ""),
    ("run.asc", lambda lines: asc(lines, "Mi Mär 3 18:00:00.005 2025"), "cp1252", ""),
    ("run.asc", lambda lines: asc(lines, "mercredi 3 septembre"), "utf-8", "its date .* cannot be read"),
    ("run.asc", lambda lines: asc(lines) * 2, "utf-8", r"the 2\d\.\d of 5\d\.\d s \(50 %\) that match"),
    ("run.log", lambda lines: "\n".join([*lines, *earlier(lines)]), "utf-8", r" of 3\d\.\d s \(75 %\) that match the"),
    ("run.log", lambda lines: "\n".join([*earlier(lines), *lines]), "utf-8", r" of 3\d\.\d s \(75 %\) that match the"),
    ("run.log", lambda lines: replaced(lines, later(lines[5001])), "utf-8", ""),
    ("run.trc", lambda lines: trc(lines, True), "ascii", ""),
    ("run.trc", lambda lines: trc(lines, False), "ascii", ""),
    ("run.trc", trc_1_2, "cp1252", ""),
    ("run.asc", lambda lines: "\n".join(asc(lines).splitlines()[4:]), "utf-8", ""),
    ("run.txt", "\n".join, "utf-8", "is a candump log with the extension .txt"),
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
    (lambda h, d: f"{h}#{d[:8]}", r"2\d+ of 2\d+ frames \(100 %\) have 4 bytes instead of 5 as in the DBC"),
    (lambda h, d: f"{h}#{d}010203", r"have 8 bytes instead of 5 as in the DBC; 2\d+ frames are not used"),
    (lambda h, d: f"{h.replace(' 002', ' 00000002')}#{d}", "has 11 bits in the DBC, but 29 bits in "),
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
    assert re.search(r"100 of \d+ frames between .* were received but not used: .*SteeringWheelAngle implausible "
                     r"\(up to -?3276.7 deg\) in 100", found["values_missing"].text)
    assert "1 gap of the steering" in found["time_gaps"].text
    assert found["time_gaps"].value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("name", "warning"), [
    ("run.log", r"\d+\.\d of 2\d\.\d s of the INS \(5\d %\) are not used: no usable sample of the steering"),
    ("run.ncom", r"\d+\.\d of 2\d\.\d s of the steering \(5\d %\) are not used: no usable sample of the INS"),
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
     r"all \d+ stamps of /odom are 0 s; the times of reception are used"),
    ("stamps of whole seconds", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="seconds"), ReadSettings(),
     r"stamps \(9\d %\) of /odom repeat the previous one; the times of reception are used"),
    ("stamps since boot", lambda folder, log: write_bag(folder / "a.mcap", log, stamps="boot"), ReadSettings(),
     "do not overlap in time; the times of reception are used for both"),
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
    assert_warned(second.warnings, "2 files between drive_3.mcap and this one are missing, so these two are")


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
    with pytest.raises(RunError, match="its messages are encoded as json, but only CDR, the encoding of ROS 2"):
        read(find_runs([file])[0], CAR)


def test_another_definition_of_a_known_type_is_named(tmp_path: Path, drive) -> None:
    file = write_bag(tmp_path / "a.mcap", drive[1], 0, 5, compression=CompressionType.NONE, enable_crcs=False)
    file.write_bytes(file.read_bytes().replace(b"Vector3 linear", b"Vector3 planar"))
    with pytest.raises(RunError, match=r"nav_msgs/msg/Odometry differs from the ROS 2 definition.*linear"):
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
