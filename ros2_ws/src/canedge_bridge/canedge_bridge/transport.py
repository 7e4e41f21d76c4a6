"""Opening a CAN bus: live SocketCAN, the loopback bus of the simulation, or any other python-can interface."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can

from .loopback_bus import LoopbackMulticastBus, parse_channel

_IFF_UP = 1


def check_channel(interface: str, channel: str) -> None:
    """Raises ValueError, one line, for an interface python-can does not know or a channel that cannot be one."""
    if interface not in can.VALID_INTERFACES:
        raise ValueError(f"interface {interface!r} is not one of {', '.join(sorted(can.VALID_INTERFACES))}")
    if not channel:
        raise ValueError(f"channel: empty; {interface} needs one")
    if interface == "udp_multicast":
        parse_channel(channel)


def id_filters(keys: Iterable[tuple[int, bool]]) -> list[dict[str, Any]]:
    """python-can filters, handed to the kernel by SocketCAN, that pass exactly these (arbitration id, 29-bit?)."""
    return [{"can_id": i, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended} for i, extended in keys]


def open_bus(interface: str, channel: str, filters: list[dict[str, Any]] | None = None, bitrate: int = 0) -> can.BusABC:
    """A python-can bus.

    interface: `socketcan`, `virtual`, ... as in python-can; `udp_multicast` is confined to the loopback interface and
    takes "group" or "group:port". filters: see `id_filters`; on socketcan and udp_multicast error frames pass them.
    bitrate: bit/s for interfaces that set it themselves; 0 leaves it alone (SocketCAN's is set with `ip link`).
    Raises ValueError for an impossible channel, OSError or can.CanError if the bus cannot be opened now.
    """
    check_channel(interface, channel)
    if interface == "udp_multicast":
        return LoopbackMulticastBus(channel, can_filters=filters)
    options: dict[str, Any] = {"bitrate": bitrate} if bitrate else {}
    return can.Bus(interface=interface, channel=channel, can_filters=filters, **options)


def link_is_up(name: str) -> bool | None:
    """Whether a network interface of this machine is switched on; None if there is no such interface."""
    try:
        return bool(int(Path("/sys/class/net", name, "flags").read_text(), 16) & _IFF_UP) if name else None
    except (OSError, ValueError):
        return None
