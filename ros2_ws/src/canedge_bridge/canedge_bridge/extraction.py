"""Values of DBC signals out of frames: one frame for the live bridge, all frames of a log as arrays.

cantools decodes every signal of a message into a dictionary, which takes up to twenty times as long; the values here
are equal to its values to the last bit. Checked by: test_extraction.py, test_log_decode.py.
"""

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal

from .signals import ANGLES, SignalSpec, wrap

EXTENDED = 0x8000_0000
"""Added to the identifier of a 29-bit frame in the `ids` of `decode_log`."""
PADDING = frozenset((0x00, 0x55, 0xAA, 0xCC, 0xFF))
"""Bytes with which controllers fill a frame up to the next length it can have."""
_FLOATS = {16: struct.Struct("<e"), 32: struct.Struct("<f"), 64: struct.Struct("<d")}


def without_padding(data: bytes, length: int) -> bytes | None:
    """The first `length` bytes of a frame; None for a frame that is shorter, or longer by anything but padding."""
    rest = data[length:]
    if len(data) < length or (rest and (rest[0] not in PADDING or rest.count(rest[0]) != len(rest))):
        return None
    return data[:length]


def has_length(payload: np.ndarray, lengths: np.ndarray, length: int) -> np.ndarray:
    """Frames that `without_padding` takes: (n,) bool of payload (n, width) and lengths (n,) in bytes."""
    fits = lengths == length
    longer = np.flatnonzero(lengths > length)
    if longer.size:
        rest = payload[longer, length:]
        inside = np.arange(length, payload.shape[1]) < lengths[longer, None]
        fits[longer] = np.isin(rest[:, 0], list(PADDING)) & ((rest == rest[:, :1]) | ~inside).all(axis=1)
    return fits


class Extractor:
    """SI values of some signals of a message, frame by frame."""

    def __init__(self, message: DbcMessage, signals: Sequence[SignalSpec]):
        self._places = [(s, _reader(s.dbc, message.length), s.sign_signal and _reader(s.sign_signal, message.length),
                         [(_reader(selector, message.length), ids) for selector, ids in gates(message, s.dbc)])
                        for s in signals]

    def si(self, data: bytes) -> dict[str, float]:
        """Name -> value of the signals that this frame carries. data: as many bytes as the message has."""
        frame = int.from_bytes(data, "little"), int.from_bytes(data, "big")
        values = {}
        for signal, read, negative, selectors in self._places:
            if any(selector(frame) not in ids for selector, ids in selectors):
                continue
            physical = read(frame) * signal.dbc.scale + signal.dbc.offset
            value = signal.gain * (-physical if negative and negative(frame) else physical) + signal.bias
            values[signal.name] = wrap(value) if signal.name in ANGLES else value
        return values


def gates(message: DbcMessage, signal: DbcSignal) -> list[tuple[DbcSignal, frozenset[int]]]:
    """(selector, its raw values) that must all hold for a multiplexed signal to be in a frame; empty for others."""
    found = []
    while signal.multiplexer_signal:
        selector = message.get_signal_by_name(signal.multiplexer_signal)
        found.append((selector, frozenset(signal.multiplexer_ids or ())))
        signal = selector
    return found


def _reader(signal: DbcSignal, length: int) -> Callable[[tuple[int, int]], float]:
    """Raw value of a signal in the payload as an integer, (low byte first, high byte first)."""
    big = signal.byte_order == "big_endian"
    # The DBC counts bits of a byte from its low end, bytes from the front; the integer's top bit is byte 0, bit 7.
    shift = 8 * length - 8 * (signal.start // 8) - 7 + signal.start % 8 - signal.length if big else signal.start
    mask, sign = (1 << signal.length) - 1, 1 << (signal.length - 1)
    if signal.is_float:
        form = _FLOATS[signal.length]
        return lambda frame: form.unpack((frame[big] >> shift & mask).to_bytes(form.size, "little"))[0]
    if signal.is_signed:
        return lambda frame: ((frame[big] >> shift & mask) ^ sign) - sign
    return lambda frame: frame[big] >> shift & mask


@dataclass(frozen=True)
class MessageColumns:
    """All frames of one message. rows: their places in the arrays given. signals: DBC name -> physical values, NaN
    where a multiplexed signal is not in the frame."""

    rows: np.ndarray
    signals: Mapping[str, np.ndarray]


def decode_log(database: Any, ids: np.ndarray, payload: np.ndarray, lengths: np.ndarray,
               messages: Iterable[str] | None = None) -> dict[str, MessageColumns]:
    """Every frame of the messages of a DBC, in the order given; a message without a frame is left out.

    database: from `signals.load_dbc`. ids: (n,) integer, plus EXTENDED for 29-bit frames. payload: (n, 8 or more)
    uint8, bytes after the frame's end are ignored. lengths: (n,) bytes in the frame; a frame that is shorter than in
    the DBC, or longer by more than padding, is left out, as in the live decoder. messages: only these.
    Raises KeyError for an unknown message name, ValueError for a wrong shape.
    """
    payload = np.ascontiguousarray(payload, dtype=np.uint8)
    ids, lengths = np.asarray(ids, dtype=np.uint32), np.asarray(lengths)
    if payload.ndim != 2 or payload.shape[0] != ids.size or payload.shape[1] < 8 or lengths.shape != ids.shape:
        raise ValueError(f"expected (n,), (n, 8 or more), (n,), not {ids.shape}, {payload.shape}, {lengths.shape}")
    chosen = database.messages if messages is None else map(database.get_message_by_name, messages)
    # numpy sorts 16-bit integers by radix, several times as fast; only 29-bit identifiers need more.
    order = np.argsort(ids.astype(np.uint16) if ids.size and ids.max() < 2**16 else ids, kind="stable")
    sorted_ids = ids[order]
    decoded = {}
    for message in chosen:
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        first, last = np.searchsorted(sorted_ids, [key, key + 1])
        rows = order[first:last]
        rows = rows[has_length(payload[rows], lengths[rows], message.length)]
        if rows.size:
            decoded[message.name] = MessageColumns(rows, _physical_columns(message, payload[rows]))
    return decoded


def raw_column(signal: DbcSignal, payload: np.ndarray) -> np.ndarray:
    """The bits of one signal in (n, width) payload bytes, right-aligned uint64."""
    first, lead = signal.start // 8, 7 - signal.start % 8 if signal.byte_order == "big_endian" else signal.start % 8
    window = np.zeros((len(payload), 9), np.uint8)
    there = payload[:, first : first + 9]
    window[:, : there.shape[1]] = there
    mask = np.uint64((1 << signal.length) - 1)
    end = lead + signal.length
    if signal.byte_order == "little_endian":
        words = np.ascontiguousarray(window[:, :8]).view("<u8").ravel().astype(np.uint64) >> np.uint64(lead)
        return (words | window[:, 8].astype(np.uint64) << np.uint64(64 - lead) if end > 64 else words) & mask
    words = np.ascontiguousarray(window[:, :8]).view(">u8").ravel().astype(np.uint64)
    if end > 64:
        return (words << np.uint64(end - 64) | window[:, 8].astype(np.uint64) >> np.uint64(72 - end)) & mask
    return words >> np.uint64(64 - end) & mask


def _physical_columns(message: DbcMessage, payload: np.ndarray) -> dict[str, np.ndarray]:
    columns = {}
    for signal in message.signals:
        values = _physical(signal, raw_column(signal, payload))
        for selector, ids in gates(message, signal):
            values = np.where(np.isin(raw_column(selector, payload), list(ids)), values, np.nan)
        columns[signal.name] = values
    return columns


def _physical(signal: DbcSignal, raw: np.ndarray) -> np.ndarray:
    if signal.is_float:
        unsigned, floating = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}[
            signal.length]
        values = raw.astype(unsigned).view(floating).astype(np.float64)
    elif signal.is_signed:
        spare = np.uint64(64 - signal.length)
        values = ((raw << spare).view(np.int64) >> np.int64(64 - signal.length)).astype(np.float64)
    else:
        values = raw.astype(np.float64)
    return values * signal.scale + signal.offset
