"""Writes CANedge2 log files of layout 2 (firmware 01.07), block by block as the logger: unfinalised and unsorted.

One data group; one channel group per bus and kind (CAN1_Rx, CAN2_Rx_IDE, ...); 48-bit time in microseconds; 8 payload
bytes in the record; the bus is only in the group's name. Source: ASAM MDF 4.1 and the facts about CANedge2 files.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

UNSIGNED, BYTES = 0, 10
FIXED, MASTER = 0, 2


@dataclass(frozen=True)
class LogFrame:
    """microseconds: since the start of the session."""

    microseconds: int
    bus: int
    identifier: int
    data: bytes
    extended: bool = False
    sent: bool = False

    @property
    def group(self) -> str:
        return f"CAN{self.bus}_{'Tx' if self.sent else 'Rx'}{'_IDE' if self.extended else ''}"


@dataclass
class MdfFile:
    content: bytearray = field(default_factory=bytearray)

    def block(self, name: bytes, links: Sequence[int], data: bytes) -> int:
        at = len(self.content)
        length = 24 + 8 * len(links) + len(data)
        self.content += struct.pack("<4s4xQQ", name, length, len(links)) + struct.pack(f"<{len(links)}Q", *links) + data
        self.content += bytes(-len(self.content) % 8)
        return at

    def text(self, text: str) -> int:
        raw = text.encode() + b"\0"
        return self.block(b"##TX", (), raw + bytes(-len(raw) % 8))

    def link(self, block: int, number: int, target: int) -> None:
        struct.pack_into("<Q", self.content, block + 24 + 8 * number, target)


def _channel(file: MdfFile, name: str, kind: int, data_type: int, byte: int, bit: int, bits: int, composition: int = 0,
             conversion: int = 0) -> int:
    data = struct.pack("<BBBBIIIIBBH6d", kind, kind == MASTER, data_type, bit, byte, bits, 0, 0, 0, 0, 0, *[0.0] * 6)
    return file.block(b"##CN", (0, composition, file.text(name), 0, conversion, 0, 0, 0), data)


def _members(file: MdfFile, extended: bool) -> int:
    """Members of CAN_DataFrame, in the record: time 0-5, id 6-9, DLC 10, length 11, direction 12, payload 13-20."""
    rows = (("ID", UNSIGNED, 6, 29 if extended else 11), ("DLC", UNSIGNED, 10, 4), ("DataLength", UNSIGNED, 11, 7),
            ("Dir", UNSIGNED, 12, 1), ("DataBytes", BYTES, 13, 64))
    first = before = 0
    for name, data_type, byte, bits in rows:
        at = _channel(file, f"CAN_DataFrame.{name}", FIXED, data_type, byte, 0, bits)
        if before:
            file.link(before, 0, at)
        first, before = first or at, at
    return first


def write_layout_2(path: Path, start_ns: int, frames: Sequence[LogFrame]) -> Path:
    """Records in the order given. start_ns: of the session, whole seconds in real files."""
    file = MdfFile(bytearray(64))
    file.content[:32] = struct.pack("<8s8s8s4xHxx", b"UnFinMF ", b"4.11    ", b"CE      ", 411)
    struct.pack_into("<H", file.content, 60, 0x25)
    header = file.block(b"##HD", [0] * 6, struct.pack("<QhhBBBBdd", start_ns, 0, 0, 0, 0, 0, 0, 0.0, 0.0))
    assert header == 64
    group = file.block(b"##DG", [0] * 4, struct.pack("<B7x", 1))
    file.link(header, 0, group)
    names = list(dict.fromkeys(f.group for f in frames)) or ["CAN1_Rx"]
    before = 0
    for number, name in enumerate(names, start=1):
        conversion = file.block(b"##CC", [0] * 4, struct.pack("<BBHHHdddd", 1, 0, 0, 0, 2, 0.0, 0.0, 0.0, 1e-6))
        time = _channel(file, "Timestamp", MASTER, UNSIGNED, 0, 0, 48, conversion=conversion)
        frame = _channel(file, "CAN_DataFrame", FIXED, BYTES, 6, 0, 8 * 15, composition=_members(file, "IDE" in name))
        file.link(time, 0, frame)
        source = file.block(b"##SI", (file.text("CAN"), file.text(name), 0), struct.pack("<BBB5x", 2, 2, 0))
        data = struct.pack("<QQHH4xII", number, 0, 0x6, ord("."), 21, 0)
        at = file.block(b"##CG", (0, time, file.text(name), source, 0, 0), data)
        file.link(before or group, 0 if before else 1, at)
        before = at
    data = file.block(b"##DT", (), b"")
    file.link(group, 2, data)
    for frame in frames:
        file.content += struct.pack(
            "<B6sIBBB8s", names.index(frame.group) + 1, frame.microseconds.to_bytes(6, "little"), frame.identifier,
            len(frame.data), len(frame.data), frame.sent, frame.data.ljust(8, b"\0"))
    path.write_bytes(file.content)
    return path
