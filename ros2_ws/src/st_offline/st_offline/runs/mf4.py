"""CANedge2 logs (MDF 4.11): both layouts, finalised or not, cut or not, through asammdf."""

import io
import logging
import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import mdf_blocks
from .errors import RunError, check_readable
from .frames import ERROR, EXTENDED, FD, REMOTE, SENT, Frames, continued, in_file_order, joined, set_back

PIECE = 1 << 20  # records
MAKERS_CONTAINERS = (".mfc", ".mfe", ".mfm")
_KINDS = {"CAN_DataFrame": 0, "CAN_RemoteFrame": REMOTE, "CAN_ErrorFrame": ERROR}
_BUS = re.compile(r"CAN[ _]?(\d+)")
_SPLIT = re.compile(r"^(\d{8})(-[0-9A-Fa-f]{8})?$")


@dataclass(frozen=True)
class Mf4:
    """Content of one file. start_ns: header start of the session, UTC. warnings: for the user, not naming the file."""

    frames: Frames
    start_ns: int
    warnings: tuple[str, ...]


def session_of(path: Path) -> tuple[str, int]:
    """(session, split): files with the same session are one recording, cut into splits.

    From the logger's own tree LOG/<device>/<8-digit session>/<8-digit split>[-hex].MF4, or from a flat copy named
    <anything>_<8-digit session>_<8-digit split>; any other file is a session by itself.
    """
    match = _SPLIT.match(path.stem)
    if match and re.fullmatch(r"\d{8}", path.parent.name):
        return str(path.parent), int(match.group(1))
    flat = re.match(r"^(.*_\d{8})_(\d{8})(-[0-9A-Fa-f]{8})?$", path.stem)
    if flat:
        return str(path.parent / flat.group(1)), int(flat.group(2))
    return str(path), 1


def refuse_makers_container(path: Path) -> None:
    """Raises RunError for the compressed or encrypted container of the logger's maker, by name or by content."""
    if path.suffix.lower() in MAKERS_CONTAINERS or _head(path).startswith(b"Generic File"):
        kinds = {".mfc": "compressed", ".mfe": "encrypted", ".mfm": "compressed and encrypted"}
        kind = kinds.get(path.suffix.lower(), "compressed or encrypted")
        raise RunError(path, f"this is a {kind} log in CSS Electronics' own container, not MF4",
                       "convert it with their mdf2finalized / CANedge MF4 converter first, then give the .MF4")


def read_mf4(path: Path) -> Mf4:
    """All CAN frames of one file, in order of time.

    A file that ends in the middle of a record (the usual end of a log when the ignition goes off) is read up to there,
    with a warning. Raises RunError for what is no MF4 log, holds no CAN frames, or is cut so that its index is gone.
    """
    check_readable(path)
    refuse_makers_container(path)
    if _head(path)[:4] not in (b"MDF ", b"UnFi"):
        raise RunError(path, "this is not an MF4 file (no MDF mark at its start)",
                       "give it the extension of what it is, or take it off the list")
    warnings: list[str] = []
    with _opened(path, warnings) as log:
        start_ns = int(log.header.start_time.timestamp()) * 10**9 + int(log.header.abs_time) % 10**9
        parts = []
        steps: list[float] = []
        for group in range(len(log.groups)):
            pieces = list(_group_frames(log, group, start_ns))
            if pieces:
                part, found = continued(in_file_order(pieces))
                steps += found
                parts.append(part)
    if not parts:
        raise RunError(path, "the log holds no CAN frames", "check that the logger was on the right bus")
    warnings += set_back(steps)
    return Mf4(joined(parts), start_ns, tuple(warnings))


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(64)


@contextmanager
def _opened(path: Path, warnings: list[str]) -> Iterator[Any]:
    """The file as an asammdf MDF. asammdf prints what it raises as well, so its output is held back meanwhile."""
    logger = logging.getLogger("asammdf")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    log = None
    try:
        with redirect_stdout(io.StringIO()):
            log = _open_whole(path, warnings)
            yield log
    except RunError:
        raise
    except Exception as error:
        raise RunError(path, f"asammdf cannot read it ({' '.join(str(error).split())[:120]})",
                       "copy it from the logger's card again") from None
    finally:
        if log is not None:
            log.close()
        logger.setLevel(level)


def _open_whole(path: Path, warnings: list[str]) -> Any:
    from asammdf import MDF

    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        damage = mdf_blocks.damage(data)
    if damage:
        raise RunError(path, f"the file is cut or damaged: {damage}", "copy it from the logger's card again")
    log = None
    try:
        log = MDF(path)
        if all(_is_whole(log, group) for group in range(len(log.groups))):
            return log
    except Exception:  # asammdf lets through whatever its parsing runs into; all of it means "cut or damaged".
        pass
    if log is not None:
        log.close()
    data = path.read_bytes()
    end = mdf_blocks.end_of_last_frame(data)
    if end is None:
        raise RunError(path, "the file is cut or damaged: no whole frame is in it",
                       "copy it from the logger's card again")
    warnings.append(f"the file ends in the middle of a frame ({len(data) - end} bytes dropped)")
    return MDF(io.BytesIO(data[:end]))


def _frame_channel(log: Any, group: int) -> str | None:
    names = {channel.name for channel in log.groups[group].channels}
    return next((name for name in _KINDS if name in names), None)


def _is_whole(log: Any, group: int) -> bool:
    """Whether every frame of a group has its payload: in layout 1 the two are written one after the other."""
    name = _frame_channel(log, group)
    if name != "CAN_DataFrame" or not log.groups[group].channel_group.cycles_nr:
        return True
    try:
        log.get("CAN_DataFrame.DataBytes", group=group, raw=True)
    except Exception:
        return False
    return True


def _group_frames(log: Any, group: int, start_ns: int) -> Iterator[Frames]:
    """The frames of a group, a million at a time."""
    name = _frame_channel(log, group)
    if name is None:
        return
    bus = _bus_of(log, group)
    for first in range(0, log.groups[group].channel_group.cycles_nr, PIECE):
        signal = log.get(name, group=group, raw=True, ignore_invalidation_bits=True, record_offset=first,
                         record_count=PIECE)
        yield _frames(name, signal, bus, start_ns)


def _frames(name: str, signal: Any, bus: int, start_ns: int) -> Frames:
    rows, n = signal.samples, len(signal.samples)
    members = {m.rsplit(".", 1)[-1]: m for m in rows.dtype.names or ()}

    def member(short: str, default: int = 0) -> np.ndarray:
        return rows[members[short]] if short in members else np.full(n, default, np.uint8)

    identifier = member("ID").astype(np.uint32)
    extended = member("IDE").astype(bool) | (identifier > 0x7FF)
    payload = member("DataBytes").reshape(n, -1) if "DataBytes" in members else np.zeros((n, 8), np.uint8)
    payload = np.ascontiguousarray(payload, dtype=np.uint8)
    if payload.shape[1] not in (8, 64):
        width = 8 if payload.shape[1] < 8 else 64
        payload = np.pad(payload[:, :width], ((0, 0), (0, max(width - payload.shape[1], 0))))
    length = member("DataLength") if "DataLength" in members else member("DLC", 8)
    flags = np.full(n, _KINDS[name], np.uint8)
    flags |= np.where(member("Dir").astype(bool), SENT, 0).astype(np.uint8)
    flags |= np.where(member("EDL").astype(bool), FD, 0).astype(np.uint8)
    return Frames(
        time_ns=start_ns + np.round(signal.timestamps * 1e9).astype(np.int64),
        id=identifier & 0x1FFF_FFFF | np.where(extended, np.uint32(EXTENDED), np.uint32(0)),
        payload=payload, length=length.astype(np.uint8),
        bus=member("BusChannel", bus).astype(np.uint8), flags=flags,
    )


def _bus_of(log: Any, group: int) -> int:
    """Bus of a group whose records do not say it (layout 2): from the group's name, CAN1_Rx."""
    channel_group = log.groups[group].channel_group
    source = channel_group.acq_source
    for text in (channel_group.acq_name, getattr(source, "name", None), getattr(source, "path", None)):
        match = _BUS.search(text or "")
        if match:
            return int(match.group(1))
    return 0
