"""Reads CANedge2 logs (MDF 4.11) with asammdf, finalised or not, complete or truncated.

There are two layouts. In layout 1 (seen with firmware 01.04), one group contains all buses, each record contains its
bus number, and payloads are in a hidden group. In layout 2 (from firmware 01.07), there is a group for each bus
and kind of frame, and the records contain the payloads of classic frames.
"""

import io
import logging
import mmap
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from . import frames, mdf_blocks
from .errors import RunError, convert_errors, format_count
from .mdf_blocks import VARIABLE_LENGTH, VIRTUAL, DamageError

MAX_RECORDS_PER_READ = 1 << 20
LATEST_START, LONGEST_SESSION = 4 * 10**9, 1e9  # s since 1970, s; their sum in ns fits into int64
MDF_OPTIONS: dict[str, Any] = {"process_bus_logging": False}  # do not decode the frames
MF4_EXTENSIONS = (".mf4", ".mdf")
_VENDOR_KINDS = {".mfc": "compressed", ".mfe": "encrypted", ".mfm": "compressed and encrypted"}
VENDOR_EXTENSIONS = tuple(_VENDOR_KINDS)
_KIND_FLAGS = {"CAN_DataFrame": 0, "CAN_RemoteFrame": frames.REMOTE, "CAN_ErrorFrame": frames.ERROR}
_TIME_CHANNELS = (2, 3)  # channel types of time: master, virtual master
FD_LENGTHS = np.array([*range(9), 12, 16, 20, 24, 32, 48, 64], np.uint8)  # data length code -> bytes, ISO 11898-1
_BUS = re.compile(r"CAN[ _]?(\d+)")
_SPLIT = re.compile(r"^((?P<session>.*_\d{8})_)?(?P<split>\d{8})(-[0-9A-Fa-f]{8})?$")


def parse_session(path: Path) -> tuple[str, int]:
    """(session, number of the split) of a file; the splits of a session are consecutive parts of one recording.

    The logger names files LOG/<device>/<8-digit session>/<8-digit split>[-hex].MF4; a copy may be named
    <anything>_<8-digit session>_<8-digit split>. Any other file is a separate session.
    """
    match = _SPLIT.match(path.stem)
    if match and match["session"]:
        return str(path.parent / match["session"]), int(match["split"])
    if match and re.fullmatch(r"\d{8}", path.parent.name):
        return str(path.parent), int(match["split"])
    return str(path), 1


def is_mdf(head: bytes) -> bool:
    """Whether a file with these first bytes is an MDF file, finalised or not."""
    return head[:4] in (b"MDF ", b"UnFi")


def reject_unreadable(path: Path, head: bytes) -> None:
    """Raises RunError for a compressed or encrypted container of the logger vendor, or an unsupported version of MDF.

    head: at least the first 64 bytes of the file.
    """
    extension, version = path.suffix.lower(), head[8:12]
    if extension in _VENDOR_KINDS or head.startswith(b"Generic File"):
        kind = _VENDOR_KINDS.get(extension, "compressed or encrypted")
        raise RunError(path, f"this is a {kind} log in the container format of CSS Electronics, which cannot be read",
                       "convert it with their mdf2finalized or CANedge MF4 converter, and pass the resulting .MF4")
    if is_mdf(head) and version[:2] != b"4.":
        raise RunError(path, f"this is MDF version {version.decode('latin-1').strip()}; CAN frames are only read from "
                       "version 4", "convert it with asammdf")


def read_mf4(path: Path) -> frames.CanLog:
    """Reads the valid CAN frames of an MDF 4 file in order of time. The warnings do not name the file.

    A file that ends in the middle of a record, as is usual when the ignition is switched off, is read up to that
    record, with a warning if the record is the separate payload of a frame (layout 1). Raises RunError for a file
    without CAN frames, with invalid blocks, or invalid times.
    """
    warnings: list[str] = []
    decoded_signals: list[str] = []
    advice = "copy it again from the logger's SD card"
    with open_mdf(path, lambda: _open_readable_part(path, warnings), advice) as log:
        start_ns = int(log.header.start_time.timestamp()) * 10**9 + int(log.header.abs_time) % 10**9
        if not 0 <= start_ns < LATEST_START * 10**9:
            raise DamageError("the session start time is invalid")
        parts = []
        for group in range(len(log.groups)):
            if (name := _find_frame_channel(log, group)) is None:
                decoded_signals += [c.name for c in log.groups[group].channels if c.channel_type not in _TIME_CHANNELS]
                continue
            pieces = list(_read_group_frames(log, group, name, start_ns))
            if pieces:
                n_recorded, n_valid = log.groups[group].channel_group.cycles_nr, sum(map(len, pieces))
                if n_valid < n_recorded:
                    count = format_count(n_recorded - n_valid, n_recorded, "frames")
                    warnings.append(f"{count} are marked as invalid by the logger; they were left out")
                parts.append(frames.concatenate(pieces))
    if not parts and decoded_signals:
        raise RunError(path, "the log contains no raw CAN frames, only decoded signals: "
                       f"{', '.join(decoded_signals)[:200]}",
                       "pass the log with the raw frames, or list this file under the key csv of a run.yaml")
    if not parts:
        raise RunError(path, "the log contains no CAN frames", "check that the logger was connected to the right bus")
    return frames.build_log(path, parts, warnings, start_ns)


@contextmanager
def open_mdf(path: Path, open_file: Callable[[], Any], advice: str) -> Iterator[Any]:
    """Opens an MDF file with `open_file` and closes it; its errors, and those raised in the context, become a RunError.

    The output of asammdf is suppressed, because it also prints the errors that it raises.
    """
    from asammdf.blocks.mdf_v4 import MDF4

    # The destructor would also close the file, and print an error on stderr after a failed __init__.
    MDF4.__del__ = lambda mdf: None  # type: ignore[method-assign]
    logger = logging.getLogger("asammdf")
    level, mdf = logger.level, None
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with convert_errors(path, "asammdf cannot read the file", advice, Exception), convert_errors(
                path, "the file is truncated or damaged", advice, DamageError), redirect_stdout(io.StringIO()):
            mdf = open_file()
            yield mdf
    finally:
        logger.setLevel(level)
        if mdf is not None:
            mdf.close()


def _open_readable_part(path: Path, warnings: list[str]) -> Any:
    from asammdf import MDF

    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        layout = mdf_blocks.check_blocks(data)
    log: Any = None
    try:
        log = MDF(path, **MDF_OPTIONS)
        if all(_has_payloads(log, group) for group in range(len(log.groups))):
            if layout is not None:
                warnings += _describe_unread_records(log, layout)
            return log
    except Exception:  # any, from asammdf: the file is truncated or damaged
        pass
    if log is not None:
        log.close()
    content = path.read_bytes()
    end = mdf_blocks.find_end_of_last_frame(content, layout) if layout else None
    if end is None:
        raise DamageError("it contains no complete frame")
    mdf_blocks.check_blocks(content[:end])
    count = format_count(len(content) - end, len(content), "bytes")
    warnings.append(f"no complete frame follows byte {end}; the last {count} are not used")
    log = MDF(io.BytesIO(content[:end]), **MDF_OPTIONS)
    if not all(_has_payloads(log, group) for group in range(len(log.groups))):
        log.close()
        raise DamageError("the payload offsets in its frames are invalid")
    return log


def _describe_unread_records(log: Any, layout: mdf_blocks.RecordLayout) -> list[str]:
    """A warning if asammdf stopped at an invalid record; none if only the last record is incomplete."""
    size = 0
    for content in log.groups:
        group = content.channel_group
        payloads = [list(content.get_signal_data_blocks(index)) for index in range(len(content.channels))]
        size += group.cycles_nr * (layout.id_size + group.samples_byte_nr + group.invalidation_bytes_nr)
        size += sum(group.cycles_nr * layout.id_size + sum(block.original_size for block in blocks)
                    for blocks in payloads if blocks)
    if layout.size - size <= layout.id_size + max((length for length, _ in layout.frame_records.values()), default=0):
        return []
    return [f"the record at byte {layout.start + size} is invalid; the last "
            f"{format_count(layout.size - size, layout.size, 'bytes of records')} are not used"]


def _find_frame_channel(log: Any, group: int) -> str | None:
    names = {channel.name for channel in log.groups[group].channels}
    return next((name for name in _KIND_FLAGS if name in names), None)


def _has_payloads(log: Any, group: int) -> bool:
    """Whether every frame of a group has its payload, which layout 1 stores separately from the frame.

    asammdf follows the offsets in the frames and allocates the longest payload that it finds, which can be terabytes
    for one wrong byte. Therefore offsets and lengths are checked first, with private functions of asammdf.
    """
    if _find_frame_channel(log, group) is None or not log.groups[group].channel_group.cycles_nr:
        return True
    content, reader = log.groups[group], log._mdf
    for index, channel in enumerate(content.channels):
        if channel.channel_type != VARIABLE_LENGTH:
            continue
        offsets = reader._get_scalar(
            channel=channel, group=content, group_index=group, channel_index=index, dependency_list=None, raster=None,
            data=None, ignore_invalidation_bits=True, record_offset=0, record_count=None, master_is_required=False,
            skip_vlsd=True)[0]
        payloads = np.frombuffer(reader._load_signal_data(content, index), np.uint8)
        if not len(offsets) or (offsets[1:] < offsets[:-1]).any() or int(offsets[-1]) + 4 > len(payloads):
            return False
        offsets = offsets.astype(np.int64)
        length = payloads[offsets].astype(np.int64)
        if ((length > frames.MAX_DATA_LENGTH) | (offsets + 4 + length > len(payloads))
                | (payloads[offsets + 1] | payloads[offsets + 2] | payloads[offsets + 3] != 0)).any():
            return False
    return True


def _read_group_frames(log: Any, group: int, name: str, start_ns: int) -> Iterator[frames.Frames]:
    content = log.groups[group]
    source = content.channel_group.acq_source
    texts = (content.channel_group.acq_name, getattr(source, "name", None), getattr(source, "path", None))
    # The bus number is in the name of a group or its source, such as CAN1_Rx (layout 2); 0: unknown.
    bus = next((int(match[1]) for text in texts if (match := _BUS.search(text or ""))), 0)
    if not content.channel_group.samples_byte_nr:
        raise DamageError("its records have length zero")
    if not any(channel.channel_type in _TIME_CHANNELS for channel in content.channels):
        raise DamageError("its records have no time channel")
    count = content.channel_group.cycles_nr
    for first in range(0, count, MAX_RECORDS_PER_READ):
        # asammdf allocates as many records as requested. Invalid times only cause warnings; _build_frames rejects them.
        with np.errstate(all="ignore"):
            signal = log.get(name, group=group, raw=True, ignore_invalidation_bits=False, record_offset=first,
                             record_count=min(MAX_RECORDS_PER_READ, count - first))
        yield _build_frames(name, signal, bus, start_ns, {c.name.rsplit(".", 1)[-1]: c for c in content.channels})


def _build_frames(name: str, signal: Any, bus: int, start_ns: int, channels: Mapping[str, Any]) -> frames.Frames:
    """Builds the columns of some frames of a group; checks every column, because a file can describe any layout.

    channels: short name -> channel. A virtual channel uses no bytes of the record, and its conversion gives a constant.
    Firmware 01.07 and later stores bus, identifier type (IDE) and direction in virtual channels.
    """
    rows, n = signal.samples, len(signal.samples)
    members = {m.rsplit(".", 1)[-1]: m for m in rows.dtype.names or ()}
    required_members = {"CAN_DataFrame": ("ID", "DataBytes"), "CAN_RemoteFrame": ("ID",)}.get(name, ())
    if missing := [member for member in required_members if member not in members]:
        raise DamageError(f"its frames have no {missing[0]}")

    def get_column(short_name: str, default: int = 0) -> np.ndarray:
        channel = channels.get(short_name)
        if channel is not None and channel.channel_type in VIRTUAL:  # its conversion is 0 * row + constant
            slope, value = getattr(channel.conversion, "a", 1.0), getattr(channel.conversion, "b", 0.0)
            if slope or not 0 <= value <= 255 or value != int(value):
                raise DamageError(f"{channel.name} is a virtual channel but not constant")
            return np.full(n, int(value), np.uint8)
        if short_name not in members:
            return np.full(n, default, np.uint8)
        column = rows[members[short_name]]
        if column.ndim != 1 or column.dtype.kind not in "bui":
            raise DamageError(f"the {short_name} of its frames is not an integer")
        return column

    seconds = signal.timestamps
    if seconds.shape != (n,) or not (np.abs(seconds) < LONGEST_SESSION).all():  # also rejects NaN
        raise DamageError("the times of its frames are invalid")
    payload = rows[members["DataBytes"]] if "DataBytes" in members else np.zeros((n, 8), np.uint8)
    if payload.ndim != 2 or payload.dtype != np.uint8:
        raise DamageError("the DataBytes of its frames are not bytes")
    if payload.shape[1] not in (8, 64):
        width = 8 if payload.shape[1] < 8 else 64
        payload = np.pad(payload[:, :width], ((0, 0), (0, max(width - payload.shape[1], 0))))
    identifier = get_column("ID").astype(np.uint32)
    is_extended = get_column("IDE").astype(bool) | (identifier > frames.MAX_STANDARD_ID)
    length = _convert_lengths(get_column("DataLength"), channels["DataLength"]) if "DataLength" in members else \
        FD_LENGTHS[get_column("DLC", 8) & 15]
    flags = np.full(n, _KIND_FLAGS[name], np.uint8)
    flags[get_column("Dir").astype(bool)] |= frames.SENT
    flags[get_column("EDL").astype(bool)] |= frames.FD
    return frames.Frames(
        time_ns=start_ns + np.round(seconds * 1e9).astype(np.int64),
        id=identifier & frames.MAX_EXTENDED_ID | np.where(is_extended, np.uint32(frames.EXTENDED), np.uint32(0)),
        payload=np.ascontiguousarray(payload), bus=get_column("BusChannel", bus).astype(np.uint8), flags=flags,
        length=np.minimum(length, payload.shape[1]).astype(np.uint8),  # codes 9 to 15 of a classic frame also mean 8
    )


def _convert_lengths(codes: np.ndarray, channel: Any) -> np.ndarray:
    """Converts stored lengths, which are numbers of bytes or CAN FD length codes, to numbers of bytes."""
    if channel.conversion is None or not len(codes):
        return FD_LENGTHS[codes & 15] if channel.bit_count <= 4 else codes
    length = np.asarray(channel.conversion.convert(codes.astype(np.int64)))
    if length.dtype.kind not in "biuf" or not ((length >= 0) & (length <= frames.MAX_DATA_LENGTH)).all():
        raise DamageError("the lengths of its frames are invalid")
    return length
