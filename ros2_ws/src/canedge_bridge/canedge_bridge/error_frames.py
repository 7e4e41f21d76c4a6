"""SocketCAN error frames: which error class, and what they say about the state of the bus.

Bits as in linux/can/error.h. python-can passes the identifier without flags in `arbitration_id`, and `is_error_frame`.
"""

from dataclasses import dataclass
from enum import StrEnum

import can


class BusState(StrEnum):
    """What the receive side knows of the bus."""

    OK = "ok"                        # frames come
    SILENT = "silent"                # open, no error, but no frame for a while
    ERROR_PASSIVE = "error-passive"  # the controller counts so many errors that it no longer objects to frames
    BUS_OFF = "bus-off"              # the controller has cut itself off
    DOWN = "down"                    # the interface is there but switched off
    GONE = "gone"                    # no such interface, or it cannot be opened


_BUS_OFF, _RESTARTED, _CONTROLLER = 0x040, 0x100, 0x004
_ACTIVE = 0x40  # controller status: back to error-active

_CLASSES = {
    0x001: "transmit timeout", 0x002: "lost arbitration", 0x004: "controller", 0x008: "protocol violation",
    0x010: "transceiver", 0x020: "no acknowledge", 0x040: "bus-off", 0x080: "bus error", 0x100: "controller restarted",
    0x200: "error counters",
}
_CONTROLLER_STATUS = {
    0x01: "receive buffer overflow", 0x02: "transmit buffer overflow", 0x04: "receive warning level",
    0x08: "transmit warning level", 0x10: "receive error-passive", 0x20: "transmit error-passive", 0x40: "error-active",
}
_PROTOCOL = {
    0x01: "single bit", 0x02: "frame format", 0x04: "bit stuffing", 0x08: "dominant bit not sent",
    0x10: "recessive bit not sent", 0x20: "bus overload", 0x40: "active error announcement", 0x80: "on transmission",
}
_PASSIVE = 0x30


@dataclass(frozen=True)
class ErrorFrame:
    """text: the classes in words. state: what the frame says the bus is in now; None if it says nothing about that."""

    text: str
    state: BusState | None


def describe(frame: can.Message) -> ErrorFrame:
    """Never raises; a frame with no known bit is "unknown error class" with its identifier."""
    bits = frame.arbitration_id
    data = bytes(frame.data).ljust(8, b"\0")
    words = []
    for bit, name in _CLASSES.items():
        if bits & bit:
            details = _details(bit, data)
            words.append(f"{name} ({details})" if details else name)
    state = None
    if bits & _RESTARTED or (bits & _CONTROLLER and data[1] & _ACTIVE):
        state = BusState.OK
    if bits & _CONTROLLER and data[1] & _PASSIVE:
        state = BusState.ERROR_PASSIVE
    if bits & _BUS_OFF:
        state = BusState.BUS_OFF
    return ErrorFrame(", ".join(words) or f"unknown error class {bits:#x}", state)


def _details(error_class: int, data: bytes) -> str:
    if error_class == 0x002:
        return f"bit {data[0]}" if data[0] else ""
    if error_class == 0x200:
        return f"transmit {data[6]}, receive {data[7]}"
    names, byte = {0x004: (_CONTROLLER_STATUS, data[1]), 0x008: (_PROTOCOL, data[2])}.get(error_class, ({}, 0))
    return ", ".join(name for bit, name in names.items() if byte & bit)
