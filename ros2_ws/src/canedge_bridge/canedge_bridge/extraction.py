"""Extracts physical values of DBC signals from a single frame, or from all frames of a log as arrays.

cantools decodes single frames. The array decoder for logs gives bit-identical values. Checked by:
test_extraction.py, test_log_decode.py.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from cantools.database import DecodeError
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal

EXTENDED = 0x8000_0000  # added to the identifier of a 29-bit frame in the `ids` of `decode_log`
PADDING = frozenset((0x00, 0x55, 0xAA, 0xCC, 0xFF))
"""Bytes that controllers append to fill a frame up to the next valid length."""


def strip_padding(data: bytes, length: int) -> bytes | None:
    """The first `length` bytes of a frame; None if it is shorter, or if anything but padding follows."""
    tail = data[length:]
    if len(data) < length or (tail and (tail[0] not in PADDING or tail.count(tail[0]) != len(tail))):
        return None
    return data[:length]


def has_length(payload: np.ndarray, lengths: np.ndarray, length: int) -> np.ndarray:
    """Mask (n,) of the frames that `strip_padding` accepts. payload: (n, width) uint8. lengths: (n,), in bytes."""
    fits = lengths == length
    longer = np.flatnonzero(lengths > length)
    if longer.size:
        tail = payload[longer, length:]
        inside = np.arange(length, payload.shape[1]) < lengths[longer, None]
        fits[longer] = np.isin(tail[:, 0], list(PADDING)) & ((tail == tail[:, :1]) | ~inside).all(axis=1)
    return fits


def decode_frame(message: DbcMessage, data: bytes) -> Mapping[str, float]:
    """Physical values of the signals in a frame by DBC name. data: exactly as long as the message."""
    try:
        return cast("dict[str, float]", message.decode(data, decode_choices=False))
    except DecodeError:  # the DBC does not list the multiplexer's value; signals that are not multiplexed are valid
        columns = _decode_columns(message, np.frombuffer(data, np.uint8)[None])
        return {name: float(values[0]) for name, values in columns.items() if not np.isnan(values[0])}


def multiplexer_conditions(message: DbcMessage, signal: DbcSignal) -> list[tuple[DbcSignal, frozenset[int]]]:
    """Conditions for a multiplexed signal to be in a frame: (selector, allowed raw values), innermost selector first.

    All of them must be met; empty for a signal that is not multiplexed.
    """
    conditions = []
    while signal.multiplexer_signal:
        selector = message.get_signal_by_name(signal.multiplexer_signal)
        conditions.append((selector, frozenset(signal.multiplexer_ids or ())))
        signal = selector
    return conditions


@dataclass(frozen=True)
class MessageColumns:
    """All frames of one message. rows: their indices in the input arrays. signals: physical values by DBC name, NaN
    where a multiplexed signal is not in the frame."""

    rows: np.ndarray
    signals: Mapping[str, np.ndarray]


def decode_log(database: Any, ids: np.ndarray, payload: np.ndarray, lengths: np.ndarray,
               messages: Iterable[str] | None = None) -> dict[str, MessageColumns]:
    """Decoded frames by message name, in input order; messages without a frame are omitted.

    database: from `signals.load_dbc`. ids: (n,) identifiers, plus EXTENDED for 29-bit frames. payload: (n, 8 or more)
    uint8; bytes after the end of a frame are ignored. lengths: (n,) bytes in each frame; a frame that is shorter than
    in the DBC, or longer by anything but padding, is skipped. messages: names to decode, None: all.
    Raises KeyError for an unknown message name, ValueError for a wrong shape.
    """
    payload = np.ascontiguousarray(payload, dtype=np.uint8)
    ids, lengths = np.asarray(ids, dtype=np.uint32), np.asarray(lengths)
    if payload.ndim != 2 or payload.shape[0] != ids.size or payload.shape[1] < 8 or lengths.shape != ids.shape:
        raise ValueError("ids, payload, lengths: expected shapes (n,), (n, 8 or more), (n,), "
                         f"not {ids.shape}, {payload.shape}, {lengths.shape}")
    selected = database.messages if messages is None else map(database.get_message_by_name, messages)
    # numpy uses radix sort, which is several times as fast, only for up to 16 bits; 29-bit identifiers need more.
    order = np.argsort(ids.astype(np.uint16) if ids.size and ids.max() < 2**16 else ids, kind="stable")
    sorted_ids = ids[order]
    decoded = {}
    for message in selected:
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        first, last = np.searchsorted(sorted_ids, [key, key + 1])
        rows = order[first:last]
        rows = rows[has_length(payload[rows], lengths[rows], message.length)]
        if rows.size:
            decoded[message.name] = MessageColumns(rows, _decode_columns(message, payload[rows]))
    return decoded


def _extract_raw(signal: DbcSignal, payload: np.ndarray) -> np.ndarray:
    """The bits of one signal from (n, width) payload bytes, as right-aligned uint64."""
    first, lead = signal.start // 8, 7 - signal.start % 8 if signal.byte_order == "big_endian" else signal.start % 8
    # Nine bytes: a signal of up to 64 bits may start inside a byte.
    window = np.zeros((len(payload), 9), np.uint8)
    available = payload[:, first : first + 9]
    window[:, : available.shape[1]] = available
    mask = np.uint64((1 << signal.length) - 1)
    end = lead + signal.length
    if signal.byte_order == "little_endian":
        words = np.ascontiguousarray(window[:, :8]).view("<u8").ravel().astype(np.uint64) >> np.uint64(lead)
        return (words | window[:, 8].astype(np.uint64) << np.uint64(64 - lead) if end > 64 else words) & mask
    words = np.ascontiguousarray(window[:, :8]).view(">u8").ravel().astype(np.uint64)
    if end > 64:
        return (words << np.uint64(end - 64) | window[:, 8].astype(np.uint64) >> np.uint64(72 - end)) & mask
    return words >> np.uint64(64 - end) & mask


def _decode_columns(message: DbcMessage, payload: np.ndarray) -> dict[str, np.ndarray]:
    columns = {}
    for signal in message.signals:
        values = _raw_to_physical(signal, _extract_raw(signal, payload))
        for selector, ids in multiplexer_conditions(message, signal):
            values = np.where(np.isin(_extract_raw(selector, payload), list(ids)), values, np.nan)
        columns[signal.name] = values
    return columns


def _raw_to_physical(signal: DbcSignal, raw: np.ndarray) -> np.ndarray:
    if signal.is_float:
        unsigned, floating = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}[
            signal.length]
        values = raw.astype(unsigned).view(floating).astype(np.float64)
    elif signal.is_signed:
        unused_bits = 64 - signal.length  # shifting left and back right extends the sign
        values = ((raw << np.uint64(unused_bits)).view(np.int64) >> np.int64(unused_bits)).astype(np.float64)
    else:
        values = raw.astype(np.float64)
    return values * signal.scale + signal.offset
