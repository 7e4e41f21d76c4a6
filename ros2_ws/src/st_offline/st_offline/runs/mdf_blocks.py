"""The blocks of an MDF 4 file, as far as it takes to tell a cut file and to find the last whole frame in it.

Source: ASAM MDF 4.1; checked on a real CANedge2 file cut at every byte of a stretch.
"""

import mmap
import struct

Buffer = bytes | mmap.mmap
_HEADER = 24  # name, reserved, length, number of links
_UNFINISHED = b"UnFinMF "
_MOST_INFLATED = 1032  # deflate cannot pack tighter
_LONGEST_RECORD = 65536  # bytes; a CAN FD frame has some 90
_MOST_CHANNELS = 10_000  # of a group; more are links in a circle
# Blocks whose links lead to data. Comments, sources and conversions may be cut off: they are not needed.
_LINKS_FOLLOWED = {b"##HD": (0,), b"##DG": (0, 1, 2), b"##CG": (0, 1), b"##CN": (0, 1), b"##DL": None, b"##HL": (0,)}


def damage(data: Buffer) -> str:
    """What is missing of the blocks that lead to the frames; empty where nothing is.

    The data block of a file that was never finalised has no length, so its end is not looked at.
    """
    size = len(data)
    if size < 64 + 104:
        return f"it ends after {size} bytes, inside its header"
    unfinished = data[:8] == _UNFINISHED
    waiting, seen = [64], set()
    while waiting:
        at = waiting.pop()
        if not at or at in seen:
            continue
        seen.add(at)
        if at + _HEADER > size:
            return f"its index points to byte {at}, it has {size}"
        name, length = bytes(data[at : at + 4]), struct.unpack_from("<Q", data, at + 8)[0]
        if not name.startswith(b"##"):
            return f"there is no block at byte {at}"
        data_block = name in (b"##DT", b"##DZ", b"##SD", b"##DV")
        if at + length > size and not (data_block and unfinished):
            return f"the block at byte {at} ends at {at + length}, the file at {size}"
        if excess := _EXCESS[name](data, at) if name in _EXCESS else "":
            return excess
        if name in _LINKS_FOLLOWED:
            links, chosen = _links(data, at), _LINKS_FOLLOWED[name]
            waiting += [links[k] for k in chosen if k < len(links)] if chosen is not None else list(links)
    return ""


def _excess_of_group(data: Buffer, at: int) -> str:
    """What a channel group claims and cannot have; memory would be taken for it."""
    _, records, flags, _, _, size, invalid = _channel_group(data, at)
    if not flags & 1 and records * (size + invalid) > _MOST_INFLATED * len(data):
        return f"the block at byte {at} claims {records} records, the file has {len(data)} bytes"
    return ""


def _excess_of_channel(data: Buffer, at: int) -> str:
    offset, bits = struct.unpack_from("<II", data, at + 24 + 8 * len(_links(data, at)) + 4)
    reach = offset + bits // 8
    return f"the channel at byte {at} lies {reach} bytes into a record" if reach > _LONGEST_RECORD else ""


_EXCESS = {b"##CG": _excess_of_group, b"##CN": _excess_of_channel}


def end_of_last_frame(data: Buffer) -> int | None:
    """Where the last whole frame of an unfinalised file ends: behind a record whose payload was written too.

    Records of an unsorted data group: an identifier, then a fixed number of bytes, or a length and as many bytes.
    Source: ASAM MDF 4.1; checked on a real file cut at every byte of a stretch. None for a file without such a group.
    """
    try:
        found = _data_group(data)
    except (struct.error, IndexError, ValueError, RecursionError):
        return None
    if found is None:
        return None
    position, id_size, fixed, variable = found
    end, open_payloads = None, 0
    while position + id_size <= len(data):
        record = int.from_bytes(data[position : position + id_size], "little")
        if record in variable:
            if position + id_size + 4 > len(data):
                break
            size = 4 + struct.unpack_from("<I", data, position + id_size)[0]
            change = -1
        elif record in fixed:
            size, owns_payload = fixed[record]
            change = 1 if owns_payload else 0
        else:
            break
        position += id_size + size
        if position > len(data):
            break
        open_payloads += change
        if open_payloads <= 0:
            end = position
    return end


def _data_group(data: Buffer) -> tuple[int, int, dict[int, tuple[int, bool]], set[int]] | None:
    """(start of the records, bytes of an identifier, id -> (size, has a payload elsewhere), ids of such payloads)."""
    group = _links(data, 64)[0]
    first = _links(data, group)
    id_size = data[group + 24 + 8 * len(first)]
    block = first[2]
    if not id_size or data[block : block + 4] != b"##DT":
        return None
    fixed: dict[int, tuple[int, bool]] = {}
    variable: set[int] = set()
    at, seen = first[1], set()
    while at and at not in seen:
        seen.add(at)
        links = _links(data, at)
        record, _, flags, _, _, size, invalid = _channel_group(data, at)
        if flags & 1:
            variable.add(record)
        else:
            fixed[record] = (size + invalid, _has_payload_elsewhere(data, links[1]))
        at = links[0]
    return block + 24, id_size, fixed, variable


def _has_payload_elsewhere(data: Buffer, channel: int) -> bool:
    for _ in range(_MOST_CHANNELS):
        if not channel:
            return False
        links = _links(data, channel)
        if data[channel + 24 + 8 * len(links)] == 1:  # variable length
            return True
        composition = links[1]
        if composition and data[composition : composition + 4] == b"##CN" and _has_payload_elsewhere(data, composition):
            return True
        channel = links[0]
    raise ValueError("channels without end")


def _channel_group(data: Buffer, at: int) -> tuple[int, ...]:
    """Record id, number of records, flags, two more, bytes of a record, bytes of its invalidation bits."""
    return struct.unpack_from("<QQHHIII", data, at + 24 + 8 * len(_links(data, at)))


def _links(data: Buffer, at: int) -> tuple[int, ...]:
    """The links of a block; its header is 4 bytes of name, 4 reserved, length, number of links."""
    if data[at : at + 2] != b"##":
        raise ValueError("not a block")
    count = struct.unpack_from("<Q", data, at + 16)[0]
    return struct.unpack_from(f"<{count}Q", data, at + 24)
