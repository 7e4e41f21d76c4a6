"""A whole log at once: identifier and payload arrays to one array per signal, equal to cantools value for value.

Each payload of up to 8 bytes is one 64-bit word, and a signal is a shift and a mask of it: about 20 ns per signal.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal

EXTENDED = 0x8000_0000
"""Added to the identifier of a 29-bit frame in the `ids` of `decode_log`."""


@dataclass(frozen=True)
class MessageColumns:
    """All frames of one message. rows: their places in the arrays given. signals: DBC name -> physical values."""

    rows: np.ndarray
    signals: Mapping[str, np.ndarray]


def decode_log(database: Any, ids: np.ndarray, payload: np.ndarray, lengths: np.ndarray,
               messages: Iterable[str] | None = None) -> dict[str, MessageColumns]:
    """Every frame of the messages of a DBC, in the order given; a message without a frame is left out.

    database: from `signals.load_dbc`. ids: (n,) integer, plus EXTENDED for 29-bit frames. payload: (n, 8) uint8, bytes
    after the frame's end are ignored. lengths: (n,) bytes in the frame; a frame whose length is not the DBC's is left
    out, as in the live decoder. messages: only these.
    Raises KeyError for an unknown message name, ValueError for a wrong shape or a message this way cannot decode:
    multiplexed, a container, or longer than 8 bytes.
    """
    payload = np.ascontiguousarray(payload, dtype=np.uint8)
    ids, lengths = np.asarray(ids, dtype=np.uint32), np.asarray(lengths)
    if payload.shape != (ids.size, 8) or lengths.shape != ids.shape:
        raise ValueError(f"(n,), (n, 8), (n,) wanted, not {ids.shape}, {payload.shape}, {lengths.shape}")
    chosen = database.messages if messages is None else map(database.get_message_by_name, messages)
    # numpy sorts 16-bit integers by radix, several times as fast; only 29-bit identifiers need more.
    order = np.argsort(ids.astype(np.uint16) if ids.size and ids.max() < 2**16 else ids, kind="stable")
    sorted_ids = ids[order]
    decoded = {}
    for message in chosen:
        _check_decodable(message)
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        first, last = np.searchsorted(sorted_ids, [key, key + 1])
        rows = order[first:last]
        rows = rows[lengths[rows] == message.length]
        if rows.size:
            decoded[message.name] = MessageColumns(rows, _decode_columns(message, payload[rows]))
    return decoded


def _check_decodable(message: DbcMessage) -> None:
    if message.is_multiplexed() or message.is_container or message.length > 8:
        raise ValueError(f"{message.name}: multiplexed, a container or longer than 8 bytes; decode it with cantools")


def _decode_columns(message: DbcMessage, payload: np.ndarray) -> dict[str, np.ndarray]:
    words = {"little_endian": payload.view("<u8").ravel().astype(np.uint64),
             "big_endian": payload.view(">u8").ravel().astype(np.uint64)}
    return {s.name: _physical(s, _raw(s, words[s.byte_order])) for s in message.signals}


def _raw(signal: DbcSignal, words: np.ndarray) -> np.ndarray:
    """The bits of one signal, right-aligned uint64."""
    if signal.byte_order == "little_endian":
        shift = signal.start
    else:
        # The DBC counts bits of a byte from its low end, bytes from the front; the word's top bit is byte 0, bit 7.
        first_bit = 8 * (signal.start // 8) + 7 - signal.start % 8
        shift = 64 - first_bit - signal.length
    return (words >> np.uint64(shift)) & np.uint64((1 << signal.length) - 1)


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
