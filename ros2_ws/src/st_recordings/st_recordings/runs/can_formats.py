"""Reads CAN logs in text and binary formats with python-can; unreadable lines are skipped."""

import io
import mmap
import re
import zlib
from base64 import b64decode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib import import_module
from itertools import dropwhile, islice, pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from canedge_bridge.units import UNITS, normalise
from oxts_bridge.file_decoder import CAPTURE_MAGIC

from .binary_table import is_signal_table
from .columns import MOTION_CHANNELS, Layout, find_columns, find_times
from .csv_table import split_row
from .errors import CP1252_FALLBACK, FOREIGN_MAGIC, RunError, find_codec, format_count, shorten
from .frames import MAX_EXTENDED_ID, MAX_STANDARD_ID
from .mf4 import FD_LENGTHS, MF4_EXTENSIONS, VENDOR_EXTENSIONS, is_mdf
from .table_times import DAY, PLAUSIBLE_EPOCH, ROLLOVER_STEP, month_number, parse_stamp

_BLF_HEAD_LENGTH = 16  # bytes: "LOBJ", header size, header version, object size, object type
_BLF_CONTAINER = re.compile(rb"LOBJ.{8}\x0a\0\0\0", re.DOTALL)  # head of a container
_BLF_PADDING = 3  # bytes; largest padding after a container, which the format aligns to four bytes
_ASC_DATE_LINE = re.compile(r"(?i)^(date|begin\s+triggerblock)\s+\S+\s+(\S+)(.*)")
_TABLE_EXTENSIONS = (".csv", ".txt")
LINE_FORMAT = "candump, BUSMASTER, CRTD, CL2000, Kvaser or ZLG"  # formats with one frame per line, parsed by _LINES
_LINES = (
    # candump -l: "(1436509052.249713) can0 044#2A36", with CAN FD "044##12A36", direction "044#2A36 T"
    re.compile(r"\s*\((?P<time>\S+)\)\s+(?P<bus>\S+)\s+(?P<id>[0-9A-Fa-f]+)#(?P<fd>#[0-9A-Fa-f])?"
               r"(?P<data>[0-9A-Fa-f]*|[Rr]\d*)(?:\s+(?P<direction>[RTrt]))?\s*$"),
    # candump without -l, stamped by -t a, -t z or -t A: " (1436509052.249713)  can0  RX - -  044   [8]  2A 36".
    re.compile(
        r"\s*\((?P<time>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d+|\d+\.\d+)\)\s+(?P<bus>\S+)\s+"
        r"(?:(?P<direction>RX|TX)\s+\S+\s+\S+\s+)?(?P<id>[0-9A-F]{3}|[0-9A-F]{8})\s+\[(?P<length>\d+)\]\s*"
        r"(?P<data>(?:[0-9A-F]{2}(?:[\s`]+|$))*|remote request\s*)(?:'.*'|::.*)?\s*$"),
    # BUSMASTER: "11:49:12:9420 Rx 1 0x023 s 1 40", or 35 s 1 064 in decimal; the last part of the time is in 0.1 ms.
    re.compile(r"(?P<time>\d+:\d\d?:\d\d?:\d{4}) (?P<direction>[RT]x) (?P<bus>\d+) (0x(?P<id>[0-9A-Fa-f]+)|"
               r"(?P<decimal>\d+)) (?P<kind>[sx]r?) \d+(?P<data>(?: [0-9A-Fa-f]{2,3})*)\s*$"),
    # CRTD (OVMS, SavvyCAN): "1436509052.249713 1R11 044 2A 36"
    re.compile(r"(?P<time>\d+\.\d+) (?P<bus>\d*)(?P<direction>[RT])(?P<kind>11|29) (?P<id>[0-9A-Fa-f]+)"
               r"(?P<data>(?: [0-9A-Fa-f]{2})*)\s*$"),
    # CL1000, CL2000 and CL3000: "22T140315133;0;201;10a87d00271000ff", with the day, or the date, before T
    re.compile(r"(?P<time>[\d/.-]{2,10}T[\d:.,]{9,12});(?P<kind>[0189]);(?P<id>[0-9A-Fa-f]+);"
               r"(?P<data>[0-9A-Fa-f]*)\s*$"),
    # Kvaser loggers: "    0.005500  1         600    Rx             8  19 14 09 03 00 12 00 12        1"
    re.compile(r"\s*(?P<time>\d+\.\d+) +(?P<bus>\d+) +(?P<id>[0-9A-F]{1,8})(?P<kind>x?) +(?P<direction>[RT]x)(?:Rq)?"
               r"[ EFBPRW#]+(?P<length>\d+) +(?P<data>(?:[0-9A-F]{2} )*|RTR) +\d+\s*$"),
    # CanKing with hexadecimal numbers: " 0    0000014B         1  00                                1675.570498 T"
    re.compile(r"\s*(?P<index>\d+) +(?P<id>[01][0-9A-F]{7}) +(?P<kind>X?R?) +(?P<length>\d+)  "
               r"(?P<data>(?:[0-9A-F]{2} +)*) *(?P<time>\d+\.\d+) (?P<direction>[RT])\s*$"),
    # python-can: "Timestamp: 1436509052.249713    ID:      044    S Rx                DL:  2    2A 36", and HCRL
    re.compile(r"Timestamp: +(?P<time>\d+\.\d+) +ID: +(?P<id>[0-9A-Fa-f]+) +(?:(?P<kind>[SX]) (?P<direction>[RT]x)"
               r"(?:EI|[ FBS])*|\d+) +DLC?: +(?P<length>\d+)(?P<data>(?: +[0-9A-Fa-f]{2}\b)*)(?: +'.*')?"
               r"(?: +Channel: (?:(?P<index>\d+)|(?P<bus>\S+)))?\s*$"),
    # CANTest of ZLG: '007,="12:04:59.533",0x592897,ch1,接收,0x0009001C,数据帧,扩展帧,0x08,x| 05 C3', in units of 0.1 ms
    re.compile(r'\d+,="[\d:.]+"?,(?P<time>0x[0-9A-Fa-f]+|\d+\.\d+),ch(?P<bus>\d+),(?:(?P<direction>[^,0]+),)?'
               r'0x(?P<id>[0-9A-Fa-f]+),[^,]*,(?P<kind>[^,]+),(?:CAN\w*,)?\w+,x\|(?P<data>(?: [0-9A-Fa-f]{2})*)\s*$'))
_COMMENT = re.compile(r"(?!Timestamp: (?!.*[RT]x E))([#\t]|[^\x00-\x7f]{2}|.*(ERRORFRAME|ERROR FRAME +\d+)\s*$|\*\*\*|"
                      r"\d+\.\d+ \d*C[A-Z]{2} |\s*([A-Z][a-z]|CAN |\w+: |\)|=|[\d.]+ +Trigger))")
"""Lines without data: explanations (candump -e, cantools decode), headers of BUSMASTER and Kvaser, comments."""
_ERROR_FLAG = 1 << 29  # bit of the identifier that marks an error frame
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # colour codes of candump -c
_UNSTAMPED_LINE = re.compile(rb"^\s*\w+\s+[0-9A-F]{3,8}(#|\s+\[\d+\]\s)", re.MULTILINE)
"""A line that candump writes without -l and -t, or that cansend reads."""
_ASC_LINE = re.compile(rb"^\s*\d+[.,]\d+\s+\d+\s+[0-9A-Fa-f]+x?\s+[RT]x\s+[dr]\s", re.MULTILINE)
_TRC_LINE = re.compile(rb"^\s*\d+\)\s", re.MULTILINE)
_ASC_DATE = re.compile(rb"(?i)date \S+ \S+ +\d+ +\d")  # not "Date Time;x;y" of a table
_ASC_STAMP = re.compile(r"\s*(\d+)[.,](\d+)\s+")
_ASC_FRAME = re.compile(r"(?i)(?:(\d+)\s+(?=\w+\s+[TR]x|ErrorFrame)|CANFD\s+)(.*)", re.ASCII)
# Columns of the CSV logs of python-can, mdf2csv (CSS Electronics), SavvyCAN (GVRET), Vehicle Spy, IXXAT and Cabana
_CSV_COLUMNS = {
    "time": "timestampepoch timestamp timestamps time times abstimesec timeabs",
    "id": "arbitrationid id idhex iddec canid identifier arbid identifierhex addr messageid",
    "length": "datalength len length dlc messagelength",
    "data": "databytes data datahex datafield payload d0 d1 data0 data1 byte0 byte1 b0 b1 message"}
_HEXADECIMAL_IDS, _DECIMAL_IDS = ("idhex", "identifierhex", "arbid"), ("iddec", "addr")  # names that imply the base
_EXTENDED_COLUMNS = ("extended", "ide", "xtd", "format")
_FURTHER_HEADER = re.compile(r'[^\d"]*Line,')  # further header of Vehicle Spy, for frames with other columns
MAX_HEADER_LINES = 30  # lines at the start of a file searched for the names of the columns
EXTENDED_DIGITS = 8  # hexadecimal digits of an extended identifier
DECIMAL_IDS = "its identifiers were read as decimal numbers"
AMBIGUOUS_IDS = "its identifiers may be decimal or hexadecimal numbers; they were read as hexadecimal"
MAX_SCANNED_ROWS = 5000  # rows from which the unit of times and the base of identifiers and bytes are inferred
MIN_STEPS = 50  # minimum number of positive time steps from which the unit of the times is inferred
MAX_STEPS = {"s": 0.15, "ms": 50.0}
"""Unit of times since the start -> largest median step (7 frames/s, 20 frames/s); above both, the unit is us."""
MIN_FRAME_DURATION = 40.0  # us; every frame takes longer at 1 Mbit/s


class Lines(io.TextIOWrapper):
    """The lines of a text log in UTF-8, UTF-16, GBK or Windows-1252. number: number of the last line read, from 1."""

    def __init__(self, file: Path):
        self.file, self.number = file, 0
        stream = io.BufferedReader(io.FileIO(file), 1 << 16)
        # Comments and dates may contain Windows-1252 characters, even after the first 64 KiB.
        super().__init__(stream, find_codec(stream.peek()), CP1252_FALLBACK)

    def __next__(self) -> str:  # type: ignore[override]
        line = io.TextIOWrapper.__next__(self)  # faster than super()
        self.number += 1
        return line


@dataclass(frozen=True)
class Format:
    """A log format. messages(file, notes): yields python-can messages in file order, and appends notes on the file."""

    name: str
    extensions: tuple[str, ...]  # lower case
    matches: Callable[[bytes], bool]  # whether the first bytes of a file have this format
    messages: Callable[[Path, list[str]], Iterator[Any]]


def _read_text(file: Path, notes: list[str], make_parser: Callable[[Lines, list[str]], Callable[[str], Any]]
               ) -> Iterator[Any]:
    """Yields the messages of a text format and skips lines that cannot be parsed.

    make_parser(lines, notes): may read the header from the lines, and returns a function that converts a line to a
    message, or to None if it has no data.
    """
    unreadable_lines: list[int] = []
    with Lines(file) as lines:
        parse = make_parser(lines, notes)
        for line in lines:
            try:
                message = parse(line)
            except Exception:  # any, from int() or indexing in python-can
                unreadable_lines.append(lines.number)
                continue
            if message is not None:
                yield message
        if unreadable_lines:
            notes.insert(0, f"{format_count(len(unreadable_lines), lines.number, 'lines')} cannot be read and were "
                         f"skipped; the first is line {unreadable_lines[0]}")


def _complete_date(time: str, previous: str) -> str:
    """Converts a time of a CL1000, CL2000 or CL3000, with the day or the date before T, to a form such as
    "20260504 101112.500". previous: date of the previous line, which is at most 15 days earlier or later."""
    day, clock = re.sub("[^0-9T]", "", time).split("T")
    if len(day) == 2 and abs(step := int(day) - int(previous[6:])) > 15:  # in the next or the previous month
        previous = f"{datetime.strptime(previous[:6], '%Y%m') + timedelta(45 if step < 0 else -15):%Y%m}"
    return f"{previous[:8 - len(day)]}{day} {clock[:6]}.{clock[6:]}"


def _make_line_parser(lines: Lines, notes: list[str]) -> Callable[[str], Any]:
    make_message = import_module("can").Message
    date = "20000101"  # of the previous line; the first date of a CL1000, which has no clock

    def parse(line: str) -> Any:
        nonlocal date
        line = _COLOUR.sub("", line)
        if not line.strip() or _COMMENT.match(line):
            date = line[8:16] if line.startswith("# Time: ") else date
            return None
        match = next(filter(None, (form.match(line) for form in _LINES)), None)
        if match is None:
            raise ValueError("not a frame")
        cells = {"kind": "-", **dict.fromkeys(("length", "fd", "bus", "index", "decimal", "direction"), ""),
                 **match.groupdict("")}
        time, kind, bus, data = cells["time"], cells["kind"].lower(), cells["bus"], cells["data"].replace("`", " ")
        if "T" in time:
            date = (time := _complete_date(time, date))[:8]
        if " " in time:
            seconds = datetime.fromisoformat(time).replace(tzinfo=UTC).timestamp()
        elif ":" in time:
            hours, minutes, whole_seconds, fraction = time.split(":")
            seconds = 3600 * int(hours) + 60 * int(minutes) + float(f"{whole_seconds}.{fraction}")
        else:
            seconds = int(time, 16) * 1e-4 if time.startswith("0x") else float(time)
        identifier = int(cells["decimal"]) if cells["decimal"] else int(cells["id"], 16)
        if identifier >= 2 * _ERROR_FLAG:
            raise ValueError("not an identifier")
        if identifier & _ERROR_FLAG:
            return make_message(timestamp=seconds, is_error_frame=True)
        is_remote = data[:1] in ("r", "R") or kind.endswith("r")
        octets = b"" if is_remote else bytes(map(int, data.split())) if cells["decimal"] else bytes.fromhex(data)
        # candump writes an extended identifier with eight digits; other formats mark it.
        digits = cells["id"] if kind == "-" else cells["id"].lstrip("0")
        channel: int | str = int(cells["index"]) if cells["index"] else (
            int(bus) - (kind != "-") if bus.isdigit() else bus or "can0")
        return make_message(
            timestamp=seconds, arbitration_id=identifier, is_remote_frame=is_remote, channel=channel,
            is_extended_id=(len(digits) > 3 and kind[:1] != "s") or kind in ("x", "xr", "29", "1", "9", "扩展帧"),
            is_rx=cells["direction"][:1] not in ("T", "t", "发") and kind not in ("8", "9"),
            is_fd=bool(cells["fd"]) or len(cells["length"]) > 1 or len(octets) > 8,  # two digits for CAN FD
            data=octets[::-1] if "`" in cells["data"] else octets)  # candump -S prints the last byte first

    return parse


class _AscParser:
    """Parses the lines of a Vector ASC log; python-can parses the frames."""

    def __init__(self, lines: Lines, notes: list[str]):
        self._reader: Any = import_module("can.io.asc").ASCReader(lines)
        self._notes, self._are_relative = notes, False  # are_relative: times are relative to the previous line
        self._start = self._seconds = 0.0  # start [s since 1970]; time of the latest line [s since the start]

    def __call__(self, line: str) -> Any:
        if (stamp := _ASC_STAMP.match(line)) is None:
            self._parse_header(line)
            return None
        seconds = float(".".join(stamp.groups()))
        self._seconds = seconds + (self._seconds if self._are_relative else 0.0)
        if (frame := _ASC_FRAME.match(line, stamp.end())) is None:
            return None
        values: dict[str, Any] = {"timestamp": round(self._seconds, 6) + self._start}
        channel, text = frame.groups()
        name = text.split(maxsplit=1)[0].rstrip("x")
        if (stated := re.search(r"\bID = (\d+)(x?)", text)) and not re.fullmatch("[0-9A-Fa-f]+", name):
            number = format(int(stated[1]), "X" if self._reader._converted_base == 16 else "d")
            text = re.sub(r"^\S+", f"{number}{stated[2]}", text)
        if channel is None:
            return self._reader._process_fd_can_frame(text, {**values, "is_fd": True})
        return self._reader._process_classic_can_frame(text, {**values, "channel": int(channel) - 1})

    def _parse_header(self, line: str) -> None:
        if base := re.match(r"(?i)base\s+(hex|dec)", line):
            self._reader._converted_base = 16 if base[1].lower() == "hex" else 10
            self._are_relative = "timestamps relative" in line.lower()
        if (match := _ASC_DATE_LINE.match(line)) is None:
            return
        key, month, day_and_time = match.groups()
        if key.lower().startswith("begin"):
            self._seconds = 0.0
        hour = re.search(r"\s(\d{1,2}):", day_and_time)
        if hour and not 1 <= int(hour.group(1)) <= 12:  # a 24-hour time, in spite of a.m. or p.m.
            day_and_time = re.sub(r"(?i)\s[ap]\.?m\.?(?=\s)", "", day_and_time)
        try:
            self._start = self._reader._datetime_to_timestamp(f"{month_number(month) or month}{day_and_time}".strip())
        except ValueError:
            self._start = 0.0
            note = f"its date {f'{month}{day_and_time}'[:40]!r} cannot be read, so its times are relative to the start"
            self._notes += [note] if note not in self._notes else []


def _make_trc_parser(lines: Lines, notes: list[str]) -> Callable[[str], Any]:
    base: Any = import_module("can.io.trc").TRCReader
    header: list[str] = []

    class Reader(base):
        def _parse_msg_v1_0(self, columns: tuple[str, ...]) -> Any:
            if not columns[3].isdigit():  # version 1.2, which is 1.3 without the reserved column
                return self._parse_cols_v1_3((*columns[:5], "-", *columns[5:]))
            message = super()._parse_msg_v1_0(columns)
            if message is not None:  # version 1.0 may write every identifier with eight digits
                message.is_extended_id = message.arbitration_id > MAX_STANDARD_ID
            return message

    reader = Reader(lines)
    reader.file = header

    def parse(line: str) -> Any:
        line = line.strip()
        if line.startswith(";$STARTTIME="):  # in days; for an invalid one, python-can would raise at every later line
            start = datetime(1899, 12, 30, tzinfo=UTC) + timedelta(float(line.partition("=")[2]))
            reader._start_time = start.timestamp()
            return None
        line = re.sub(r"(?<=^;\$FILEVERSION=)[3-9].*", "2.1", line)  # the columns are stated as in version 2.1
        if not line or line.startswith(";"):
            header.extend([line] if line else [])
            return None
        if header:
            reader._extract_header()
            header.clear()
        line = re.sub(r"^(\d+\)?\s+\d+),(?=\d)", r"\1.", line)  # decimal comma of the time
        message = reader._parse_cols(tuple(line.split(maxsplit=reader._num_columns)))
        if message is not None:
            message.channel -= 1  # python-can counts channels from 0 in other formats
        return message

    return parse


def _normalise_names(cells: Sequence[str]) -> list[str]:
    return [normalise(re.sub(r"^field\.(is_)?", "", cell)) for cell in cells]  # field.is_error of `rostopic echo -p`


def _split_csv_header(line: str) -> tuple[list[str], str, dict[str, int]]:
    """(normalised names of the columns, delimiter, column of each role in _CSV_COLUMNS)."""
    delimiter = next((mark for mark in ";\t" if mark in line), ",")
    cells = split_row(line, delimiter)
    names = _normalise_names(cells)
    found = {role: next(filter(names.__contains__, known.split()), None) for role, known in _CSV_COLUMNS.items()}
    roles = {role: names.index(name) for role, name in found.items() if name}
    if "time" not in roles and (times := find_times(cells)):  # with a unit in its name
        roles["time"] = times[0].column
    return names, delimiter, roles


def _is_csv_header(line: str) -> bool:
    """Whether a line is the header of a CAN log in CSV. Without a length, another name must be typical of a CAN log."""
    names, _, roles = _split_csv_header(line)
    is_typical = "length" in roles or not {"addr", "datahex", "datafield", "b0", "b1"}.isdisjoint(names)
    return (is_typical and roles.keys() >= {"time", "id", "data"}
            and MOTION_CHANNELS.isdisjoint(find_columns(Path(), names, Layout())))


def _make_csv_parser(lines: Lines, notes: list[str]) -> Callable[[str], Any]:
    make_message = import_module("can").Message
    header = next(filter(_is_csv_header, lines), "")
    names, delimiter, roles = _split_csv_header(header)
    id_base, byte_base, unit, times_are_whole = _find_number_formats(lines.file, names, delimiter, roles)
    if id_base != 16:
        notes.append(AMBIGUOUS_IDS if id_base == 0 else DECIMAL_IDS)
    stated = next((source.unit for source in find_times(split_row(header, delimiter))
                   if source.column == roles["time"] and source.has_stated_unit), None)
    if (names[roles["time"]], names[roles["data"]]) == ("timestamp", "d1"):  # SavvyCAN (GVRET)
        unit = "us" if times_are_whole else "s"
    elif not stated and unit != "s":
        notes.append(f"its times were read in {unit}")
    factor = UNITS["time"][stated or unit][0]
    n_columns = _count_byte_columns(names)
    networks: dict[str, int] = {}  # name of a bus -> its number, in order of appearance

    def parse(line: str) -> Any:
        if not line.strip() or _FURTHER_HEADER.match(line):
            return None
        row = split_row(line, delimiter)
        cells = dict(zip(names, row, strict=False))
        data = _read_csv_data(cells, row, names[roles["data"]], roles, byte_base, n_columns)
        identifier = int(row[roles["id"]].rstrip("x"), id_base or 16)
        is_extended = _read_flag(cells, *_EXTENDED_COLUMNS)
        if identifier > MAX_STANDARD_ID and (is_extended is False or ("xtd" in cells and not is_extended)):
            raise ValueError(f"standard identifier {identifier:x}")  # a fault, or a row of J1939, whose columns differ
        bus = cells.get("bus") or cells.get("buschannel") or cells.get("channel") or cells.get("network", "")
        time = row[roles["time"]]
        stamp = parse_stamp(time) if ":" in time else None
        return make_message(
            timestamp=stamp[0] if stamp else float(time.replace(",", ".")) * factor, arbitration_id=identifier,
            data=data, is_fd=len(data) > 8,
            is_extended_id=identifier > MAX_STANDARD_ID if is_extended is None else is_extended,
            is_remote_frame=_read_flag(cells, "remote", "rtr"), is_error_frame=_read_flag(cells, "error", "er"),
            is_rx=not _read_flag(cells, "dir", "tx"),
            channel=int(bus) - ("bus" not in cells) if bus.isdigit() else (
                networks.setdefault(bus, len(networks)) if bus else None))

    return parse


def _read_flag(cells: Mapping[str, str], *names: str) -> bool | None:
    """The flag in the first of these columns that is not blank; None if all are blank or its text is unknown."""
    text = next(filter(None, map(cells.get, names)), "").lower()
    is_set = text in ("1", "t", "true", "yes", "tx") or text.startswith("ext")
    return is_set if is_set or text in ("0", "f", "false", "no") or text.startswith("std") else None


def _find_number_formats(file: Path, names: Sequence[str], delimiter: str, roles: Mapping[str, int]
                         ) -> tuple[int, int, str, bool]:
    """(base of the identifiers: 16, 10, or 0 if either is possible; base of the bytes in separate columns; unit of
    numeric times; whether all these times are whole numbers), from the first rows."""
    ids: list[tuple[str, int]] = []
    data: list[tuple[str, int]] = []
    times: list[float] = []
    with Lines(file) as lines:
        rows = (split_row(line, delimiter) for line in lines)
        for row in islice(dropwhile(lambda row: _normalise_names(row) != names, rows), 1, MAX_SCANNED_ROWS):
            if len(row) <= max(roles.values()):
                continue
            identifier = row[roles["id"]].rstrip("x")  # Vector marks an extended identifier by x
            flag = _read_flag(dict(zip(names, row, strict=False)), *_EXTENDED_COLUMNS)
            is_extended = len(identifier) >= EXTENDED_DIGITS if flag is None else flag
            limit = MAX_EXTENDED_ID if is_extended else MAX_STANDARD_ID
            ids.append((identifier, -1 if names[roles["id"]] in _DECIMAL_IDS else limit))
            length = row[roles["length"]] if "length" in roles else str(_count_byte_columns(names))
            data += [(cell, 0xFF) for cell in row[roles["data"]:][:int(length) if length.isdecimal() else 0] if cell]
            with suppress(ValueError):
                times.append(float(row[roles["time"]].replace(",", ".")))
    data_base, is_padded = _find_base(data), any(re.fullmatch("0[0-9]+", text) for text, _ in ids)
    time_format = _find_time_unit(np.array(times)), all(time.is_integer() for time in times)
    is_hexadecimal = names[roles["id"]] in _HEXADECIMAL_IDS or not all(text.isdecimal() for text, _ in ids if text)
    if not ids or is_hexadecimal or is_padded:
        return 16, data_base, *time_format
    return 10 if 10 in (data_base, _find_base(ids)) else 0, data_base, *time_format


def _find_time_unit(times: np.ndarray) -> str:
    """Unit of the times of a log: s, ms, us or ns since 1970; or s, ms or us since the start, by the median step."""
    steps = np.diff(times)[np.diff(times) > 0]
    step = np.median(steps) if len(steps) >= MIN_STEPS else 0.0
    for unit in ("s", "ms", "us", "ns") if len(times) else ():
        is_plausible = PLAUSIBLE_EPOCH[0] <= times[0] * UNITS["time"][unit][0] <= PLAUSIBLE_EPOCH[1]
        # In a long log, us since the start may look like s since 1970, but their steps are larger.
        if is_plausible and (unit != "s" or step < MIN_FRAME_DURATION):
            return unit
    return next((unit for unit, limit in MAX_STEPS.items() if step < limit), "us")


def _find_base(cells: Sequence[tuple[str, int]]) -> int:
    """10 if all texts are decimal and one exceeds its limit read as hexadecimal; else 16. cells: (text, limit)."""
    cells = [cell for cell in cells if cell[0]]
    is_decimal = all(text.isdecimal() for text, _ in cells) and any(int(text, 16) > limit for text, limit in cells)
    return 10 if is_decimal else 16


def _count_byte_columns(names: Sequence[str]) -> int:
    """Number of columns B0, B1, ...: the maximum length of a frame if no column gives the length, as in Vehicle Spy."""
    return sum(re.fullmatch(r"b\d+", name) is not None for name in names)


def _read_csv_data(cells: Mapping[str, str], row: Sequence[str], name: str, roles: Mapping[str, int], base: int,
                   n_columns: int) -> bytes:
    """Data of a frame in any of the CSV formats. Raises ValueError if it does not have the stated length."""
    digits = "".join(row[roles["data"]].split()).replace("0x", "")
    length = int(row[roles["length"]]) if "length" in roles else None
    if length is not None and 8 < length < len(FD_LENGTHS):  # may be a data length code (DLC)
        n_bytes = len(list(takewhile(bool, row[roles["data"]:]))) if name[-1].isdigit() else len(digits) // 2
        length = n_bytes if n_bytes == FD_LENGTHS[length] else length
    if name[-1].isdigit():  # blank cells may follow the bytes, but not separate them
        texts = row[roles["data"]:][:n_columns if length is None else length]
        data = bytes(int(text, base) for text in texts[:sum(map(bool, texts))])
    elif name == "data" and length is not None and not re.fullmatch(f"[0-9A-Fa-f]{{{2 * length}}}", digits):
        data = b64decode(row[roles["data"]], validate=True)
    else:
        data = bytes.fromhex(digits)
    if length not in (None, len(data)) and not _read_flag(cells, "remote", "rtr"):
        raise ValueError(f"{len(data)} bytes instead of {length}")
    return data


def _unpack_blf_container(container: bytes, tail: bytes) -> bytes:
    """The objects in a container, preceded by `tail`, the incomplete object at the end of the previous container.
    Raises ValueError or zlib.error for damage, such as an object shorter than its header, on which python-can would
    never return."""
    method, content = int.from_bytes(container[16:18], "little"), container[32:]
    if method not in (0, 2):
        raise ValueError(f"unknown compression {method}")
    data = zlib.decompressobj().decompress(content) if method else content
    # After damage, a container may begin with the end of a lost object.
    data = tail + data if tail else data[max(data.find(b"LOBJ"), 0):]
    offset = data.find(b"LOBJ", 0, 8)
    while 0 <= offset <= len(data) - _BLF_HEAD_LENGTH:
        length = int.from_bytes(data[offset + 8:offset + 12], "little")
        if length < _BLF_HEAD_LENGTH:
            raise ValueError(f"an object has a length of {length} bytes")
        offset = data.find(b"LOBJ", offset + length, offset + length + 8)
    return data


def _read_blf(file: Path, notes: list[str]) -> Iterator[Any]:
    """Yields the messages of a log; continues with the next container after a damaged one."""
    size, count, lost, damage = file.stat().st_size, 0, 0, ""
    with import_module("can.io.blf").BLFReader(str(file)) as reader, mmap.mmap(
            reader.file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        first = reader.file.tell()
        starts = dict.fromkeys(match.start() for match in _BLF_CONTAINER.finditer(content, first))
        for start, next_start in pairwise(dict.fromkeys([first, *starts, size])):
            end = start + int.from_bytes(content[start + 8:start + 12], "little")
            unread = start
            try:
                if start not in starts or end > next_start < size:
                    raise ValueError(f"the container at byte {start} has an invalid header or length")
                data, reader._tail = _unpack_blf_container(content[start:end], reader._tail), b""
                for message in reader._parse_container(data):
                    count += 1
                    yield message
                unread = end
                if next_start - end > _BLF_PADDING:
                    raise ValueError(f"no container at byte {end}")
            except Exception as error:  # any, from python-can
                damage = damage or f"is damaged after frame {count} ({shorten(error)})"
                lost += next_start - unread
                reader._tail = b""
    if damage:
        notes.append(f"{damage}; frames in {format_count(lost, size, 'bytes')} may be missing")
    if not reader.file_size:
        notes.append("was not closed by its logger; its end may be missing")
    elif size < reader.file_size:
        notes.append(f"is truncated: {format_count(reader.file_size - size, reader.file_size, 'bytes')} are missing")


def _has_line_format(head: bytes) -> bool:
    forms = (re.compile(r"\W*\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#"), *_LINES[1:])
    lines = _COLOUR.sub("", head.decode("latin-1")).splitlines()
    return b"field: DEC" not in head and any(form.match(line) for line in lines for form in forms)


FORMATS = (
    Format(LINE_FORMAT, (".log", ".candump", ".crtd", *_TABLE_EXTENSIONS), _has_line_format, partial(
        _read_text, make_parser=_make_line_parser)),
    Format("Vector ASC", (".asc",), lambda head: b"\nbase hex" in head or b"\nbase dec" in head or bool(
        _ASC_DATE.match(head.lstrip(b"\xef\xbb\xbf \t\r\n")) or _ASC_LINE.search(head)), partial(
        _read_text, make_parser=_AscParser)),
    Format("Vector BLF", (".blf",), lambda head: head.startswith(b"LOGG"), _read_blf),
    Format("PEAK trace", (".trc",), lambda head: b";$FILEVERSION" in head or (head.lstrip().startswith(b";") and (
        b"Message Number" in head or (b"Start time:" in head and _TRC_LINE.search(head) is not None))), partial(
        _read_text, make_parser=_make_trc_parser)),
    Format("CSV", _TABLE_EXTENSIONS, lambda head: any(
        map(_is_csv_header, head.decode("utf-8-sig", "ignore").splitlines()[:MAX_HEADER_LINES])), partial(
        _read_text, make_parser=_make_csv_parser)),
)
SHARED_EXTENSIONS = (".log", ".asc", "", ".pcap", ".pcapng", ".cap", *_TABLE_EXTENSIONS)
"""Extensions that CAN logs share with files of other programs."""
EXTENSIONS = frozenset({e for f in FORMATS for e in f.extensions}.difference(_TABLE_EXTENSIONS)
                       | {*MF4_EXTENSIONS, *VENDOR_EXTENSIONS})


def read_head(file: Path) -> bytes:
    """First bytes of a file; those of a text in UTF-16 are converted to UTF-8. Raises OSError."""
    with file.open("rb") as stream:
        head = stream.read(4096)
    codec = find_codec(head)
    return head.decode(codec, "ignore").encode() if codec.startswith("utf-16") else head


def check_format(file: Path, head: bytes) -> None:
    """Raises RunError for CAN frames in a form that cannot be read."""
    if _is_can_capture(head):
        raise RunError(file, "this is a network capture (pcap) of CAN frames, which cannot be read",
                       "convert it to .asc or .blf, or record with candump -l")
    if _UNSTAMPED_LINE.search(head):
        raise RunError(file, "this output of candump has no time stamps", "record again with candump -l")


def _is_can_capture(head: bytes) -> bool:
    """Whether a file with these first bytes is a network capture (pcap, pcapng) whose first interface is SocketCAN."""
    if head[:4] != CAPTURE_MAGIC[-1]:
        return head[:4] in CAPTURE_MAGIC and head[20:24] in (b"\xe3\0\0\0", b"\0\0\0\xe3")
    start = int.from_bytes(head[4:8], "little" if head[8:9] == b"\x4d" else "big") + 8
    return head[start:start + 2] in (b"\xe3\0", b"\0\xe3")


def find_restart(head: bytes) -> tuple[float, float]:
    """(period after which the times of a log restart at 0, smallest backward jump that counts as a restart) [s]. The
    jump is half of the period for times of day or since the full hour, and nearly a day for numeric times, which may
    be relative."""
    lines = head.decode("utf-8-sig", "ignore").splitlines()
    _, delimiter, roles = _split_csv_header(next(filter(_is_csv_header, lines), ""))
    column, delimiter = (roles["time"], delimiter) if "time" in roles else (0, " ")  # BUSMASTER
    cells = (cell for line in lines for cell in split_row(line, delimiter)[column:column + 1])
    _, period = next(filter(None, map(parse_stamp, cells)), (0.0, 0.0))
    return (period, period / 2) if period else (DAY, DAY - ROLLOVER_STEP)


def is_can_log(file: Path) -> bool:
    """Whether a file is a CAN log, by its extension, or by its content if other programs also use the extension.

    A .log or .asc file that is empty, unreadable or begins with FOREIGN_MAGIC counts as a CAN log; its reader reports
    the problem.
    """
    extension = file.suffix.lower()
    if extension in MF4_EXTENSIONS:
        return not is_signal_table(file)
    if extension not in SHARED_EXTENSIONS:
        return extension in EXTENSIONS
    try:
        head = read_head(file)
    except OSError:
        head = b""
    if extension == ".csv":
        return any(kind.matches(head) for kind in FORMATS if extension in kind.extensions)
    return is_mdf(head) or _is_can_capture(head) or any(kind.matches(head) for kind in FORMATS) or (
        extension in (".log", ".asc") and (not head or head.lower().startswith(tuple(FOREIGN_MAGIC))))
