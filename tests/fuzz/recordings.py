"""Fuzz targets for recordings: recovery and reading of bags, CAN logs, CSV drives, VBOX files."""

import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import can
import numpy as np
from bags import DEFINITION, TYPE, TYPE_HASH, numbered, read_numbers
from can.io import ASCWriter, BLFWriter, CanutilsLogWriter, TRCWriter
from drives import read_csv, weave, write_drive
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from mdf_files import LogFrame, write_layout_2
from rosbags.rosbag2 import ReaderError
from st_recordings.mcap import BagWriter
from st_recordings.mcap_contents import read_records
from st_recordings.recovery import RecoveryError, recover
from st_recordings.runs import csv
from st_recordings.runs.bag import ODOMETRY, STEERING, read_bag
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.can_signals import decode_signals, load_signal_table
from st_recordings.runs.cdr import load_typestore
from st_recordings.runs.columns import Layout
from st_recordings.runs.errors import RunError
from st_recordings.runs.vbo import read_vbo
from support import ROOT

from .harness import Target, one_line

CAN = ROOT / "config" / "can"
START_NS = 1_790_000_000_000_000_000


def _bytes_of(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        write(file)
        return file.read_bytes()


def _own_bag(folder: Path) -> Path:
    bag = BagWriter(folder / "bag", {"configuration": {"hash": "0123"}})
    a = bag.add_topic("/a", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
    for k in range(12):
        bag.write(a, numbered(k, "text"), START_NS + k * 10**7)
        if k % 4 == 3:
            bag.flush()
    bag.close()
    return bag.path


def _other_bag(folder: Path, compression: CompressionType, chunked: bool = True) -> Path:
    """A bag of the mcap library; without compression, mutations reach the messages."""
    file = folder / "other_0.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, compression=compression, use_chunking=chunked, enable_crcs=False)
        writer.start("ros2", "other recorder")
        schema = writer.register_schema(TYPE, "ros2msg", DEFINITION.encode())
        channel = writer.register_channel("/a", "cdr", schema, {"offered_qos_profiles": "", "x": "y"})
        for k in range(8):
            writer.add_message(channel, START_NS + k, numbered(k), START_NS + k)
        writer.add_attachment(START_NS, START_NS, "note.txt", "text/plain", b"a note")
        writer.add_metadata("about", {"car": "a car"})
        writer.finish()
    return file


def _bags() -> list[bytes]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = _own_bag(folder).read_bytes()
        others = [_other_bag(folder, *options).read_bytes() for options in (
            (CompressionType.NONE,), (CompressionType.NONE, False), (CompressionType.LZ4,), (CompressionType.ZSTD,))]
    return [own, own[:len(own) // 2], *others, others[0][:-40]]


def _recover(data: bytes, folder: Path) -> str:
    """The result is a valid bag, the original is preserved, and a second recovery changes nothing."""
    bag = folder / "bag"
    bag.mkdir()
    file = bag / "bag_0.mcap"
    file.write_bytes(data)
    try:
        report = recover(bag)
    except RecoveryError as error:
        assert [path.name for path in bag.iterdir()] == ["bag_0.mcap"] and file.read_bytes() == data
        return one_line(error, data)
    originals = [file, *bag.glob("*.cut*")]
    assert any(path.read_bytes() == data for path in originals), "the original is lost"
    assert all(line.isprintable() for line in str(report).splitlines())
    repaired = file.read_bytes()
    assert all(part.is_intact for part in recover(bag).files) and file.read_bytes() == repaired
    with file.open("rb") as stream:
        last = [record.opcode for record in read_records(stream, len(repaired))][-1:]
    assert last == [Opcode.FOOTER]
    changed = "unchanged" if file.read_bytes() == data else "repaired"
    return f"{changed}, damaged {min(report.files[0].damaged_records, 3)}, {_read_with_rosbags(bag)}"


def _read_with_rosbags(bag: Path) -> str:
    """Outcome of rosbags, which rejects some contents that no recorder writes."""
    try:
        return f"{len(read_numbers(bag))} topics"
    except ReaderError as error:
        return f"rosbags: {error}"
    except Exception as error:
        return f"rosbags: {type(error).__name__}"


def _make(name: str, **values: object) -> object:
    """A message; fields without a value are zero."""
    store = load_typestore()
    fields = {}
    for field, (kind, detail) in store.get_msgdef(name).fields:
        if field in values:
            fields[field] = values[field]
        elif kind.name == "NAME":
            fields[field] = _make(detail)
        elif kind.name == "BASE":
            fields[field] = "" if detail[0] == "string" else detail[0] == "bool" or 0
        else:
            fields[field] = np.zeros(detail[1])
    return store.types[name](**fields)


def _drive_bag(folder: Path) -> Path:
    store, bag = load_typestore(), BagWriter(folder / "drive")
    topics = {}
    for name, topic in ((ODOMETRY, "/ins/odometry"), (STEERING, "/vehicle/steering")):
        definition, _ = store.generate_msgdef(name, ros_version=2)
        topics[name] = bag.add_topic(topic, name, definition=definition, type_hash=TYPE_HASH)
    for k in range(10):
        stamp = _make("builtin_interfaces/msg/Time", sec=1_790_000_000, nanosec=k * 10**7)
        for name, topic in topics.items():
            message = _make(name, header=_make("std_msgs/msg/Header", stamp=stamp, frame_id="map"))
            bag.write(topic, bytes(store.serialize_cdr(message, name)), START_NS + k * 10**7)
    bag.close()
    return bag.path


def _drive_bags() -> list[bytes]:
    with tempfile.TemporaryDirectory() as name:
        bag = _drive_bag(Path(name)).read_bytes()
    return [bag, bag[:-300]]


def _read_bag(data: bytes, folder: Path) -> str:
    file = folder / "drive.mcap"
    file.write_bytes(data)
    try:
        return f"read, {len(read_bag(file).warnings)} warnings"
    except RunError as error:
        return one_line(error, data)


@cache
def _table():
    return load_signal_table(CAN / "leaf_ze0.dbc", CAN / "leaf_ze0.yaml")


def _log(writer: type, name: str) -> bytes:
    def write(file: Path) -> None:
        with writer(str(file)) as log:
            for k in range(6):
                log(can.Message(timestamp=1.79e9 + k / 100, arbitration_id=(2, 0x284, 0x18FEF100)[k % 3], channel=0,
                                is_extended_id=k % 3 == 2, data=bytes([k] * (5, 8, 8)[k % 3])))

    return _bytes_of(write, name)


def _mf4() -> bytes:
    frames = [LogFrame(k * 10_000, 1 + k % 2, (2, 0x284)[k % 2], bytes([k] * (5, 8)[k % 2])) for k in range(12)]
    return _bytes_of(lambda file: write_layout_2(file, START_NS, frames), "log.mf4")


def _can_log(suffix: str) -> Callable[[bytes, Path], str]:
    def run(data: bytes, folder: Path) -> str:
        file = folder / f"log{suffix}"
        file.write_bytes(data)
        try:
            log = read_can_logs([file])
        except RunError as error:
            return one_line(error, data)
        signals = decode_signals(log.frames, _table())
        return f"read, {len(log.warnings)} warnings, {len(signals.signals)} signals, {len(signals.faults)} faults"

    return run


def _csv(data: bytes, folder: Path) -> str:
    file = folder / "drive.csv"
    file.write_bytes(data)
    csv.find_missing_in_header(file)
    try:
        warnings = read_csv(file).warnings
    except RunError as error:
        return one_line(error, data)
    return f"read, {len(warnings)} warnings"


def _csv_seed() -> list[bytes]:
    return [_bytes_of(lambda file: write_drive(file, weave(1.0)), "drive.csv").replace(b"\n", b"\r\n", 3)]


def _vbo(data: bytes, folder: Path) -> str:
    file = folder / "drive.vbo"
    file.write_bytes(data)
    try:
        drive = csv.build_drive(read_vbo(file, Layout()))
    except RunError as error:
        return one_line(error, data)
    return f"read, {len(drive.warnings)} warnings"


VBO = b"""File created on 03/09/2025 @ 12:00:00

[header]
satellites
time
latitude
longitude
velocity kmh
heading
steering wheel angle

[channel units]
deg

[column names]
sats time lat long velocity heading steering_wheel_angle

[data]
""" + b"".join(b"010 1200%05.2f +03120.%08d +00090.00000000 036.000 %06.2f %+.4E\n" % (k / 10, k * 5000, k % 3, k * 0.5)
              for k in range(20))


MCAP_FRAGMENTS = (b"\x89MCAP0\r\n", b"\x06" + b"\xff" * 8, b"\x0f\x0d\0\0\0\0\0\0\0", b"zstd", b"lz4", b"\x04", b"\x03")
MF4_FRAGMENTS = (b"##DG", b"##CG", b"##CN", b"##DT", b"##DZ", b"##DL", b"##HL", b"##SD", b"##CC", b"MDF     ",
                 b"UnFinMF ")
LOG_FRAGMENTS = (b"(1.0) can0 002#1D000007B0\n", b"##", b"#R", b" R", b"date Mon Sep 30 15:06:13.191 2022\n", b"CANFD",
                 b"nan", b"base hex  timestamps absolute", b";$FILEVERSION=2.1\n", b";$COLUMNS=N,O,T,I,d,l,D\n",
                 b"ErrorFrame", b"\xff", b"\0", b"1e400", b"-1")


TARGETS = (
    Target("mcap_recover", _bags, _recover, MCAP_FRAGMENTS),
    Target("bag_read", _drive_bags, _read_bag, MCAP_FRAGMENTS),
    Target("mf4", lambda: [_mf4()], _can_log(".mf4"), MF4_FRAGMENTS, fragile=True),
    Target("log_candump", lambda: [_log(CanutilsLogWriter, "x.log")], _can_log(".log"), LOG_FRAGMENTS, text=True),
    Target("log_asc", lambda: [_log(ASCWriter, "x.asc")], _can_log(".asc"), LOG_FRAGMENTS, text=True),
    Target("log_trc", lambda: [_log(TRCWriter, "x.trc")], _can_log(".trc"), LOG_FRAGMENTS, text=True),
    Target("log_blf", lambda: [_log(BLFWriter, "x.blf")], _can_log(".blf"), (b"LOBJ", b"LOGG")),
    Target("csv", _csv_seed, _csv, (b"nan", b"inf", b"1e400", b"\xef\xbb\xbf", b";", b"\t", b'"', b"\0"), text=True),
    Target("vbo", lambda: [VBO, VBO.replace(b"\n", b"\r\n")], _vbo,
           (b"nan", b"1e400", b"235959.99", b"[data]\n", b"[column names]\n", b"[channel units]\n", b"\0"), text=True),
)
