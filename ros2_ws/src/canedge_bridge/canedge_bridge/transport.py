"""Opens a CAN bus: live SocketCAN, the loopback bus of the simulation, or any other python-can interface."""

import ipaddress
import select
import socket
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can
import msgpack
from can.interfaces.udp_multicast.utils import pack_message

_IFF_UP = 1
DEFAULT_PORT = 43113  # as in python-can
_LOOPBACK = socket.inet_aton("127.0.0.1")
_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)
_IP_MULTICAST_ALL = 49  # linux/in.h; not in the socket module
_TIMESPEC = struct.Struct("@ll")
_LARGEST_DATAGRAM = 4096  # bytes
_RECEIVE_BUFFER = 1 << 20  # bytes
# Types of the fields of a datagram; checked because can.Message would accept a string as a number and a list as a flag.
_FIELD_TYPES = {"arbitration_id": int, "dlc": int, "data": bytes, **dict.fromkeys(
    ("is_extended_id", "is_remote_frame", "is_error_frame", "is_fd", "bitrate_switch", "error_state_indicator"), bool)}


def check_channel(interface: str, channel: str) -> None:
    """Raises ValueError for an interface unknown to python-can or an invalid channel."""
    if interface not in can.VALID_INTERFACES:
        raise ValueError(f"interface {interface!r} is not one of {', '.join(sorted(can.VALID_INTERFACES))}")
    if not channel:
        raise ValueError(f"channel is empty; interface {interface} requires one")
    if interface == "udp_multicast":
        parse_channel(channel)


def make_id_filters(keys: Iterable[tuple[int, bool]]) -> list[dict[str, Any]]:
    """python-can filters that pass exactly these messages: (arbitration id, whether it has 29 bits)."""
    return [{"can_id": i, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended} for i, extended in keys]


def open_bus(interface: str, channel: str, filters: list[dict[str, Any]] | None = None, bitrate: int = 0) -> can.BusABC:
    """Opens a python-can bus.

    interface: `socketcan`, `virtual`, ... as in python-can; `udp_multicast` is confined to the loopback interface and
    takes "group" or "group:port". filters: `make_id_filters`; error frames pass them on socketcan and udp_multicast.
    bitrate: [bit/s], for interfaces that python-can configures (not SocketCAN, see `ip link`); 0: their default.
    Raises ValueError for an invalid channel, OSError or can.CanError if the bus cannot be opened.
    """
    check_channel(interface, channel)
    if interface == "udp_multicast":
        return LoopbackMulticastBus(channel, can_filters=filters)
    options: dict[str, Any] = {"bitrate": bitrate} if bitrate else {}
    return can.Bus(interface=interface, channel=channel, can_filters=filters, **options)


def link_is_up(name: str) -> bool | None:
    """Whether a network interface of this machine is up; None for an unknown interface."""
    try:
        return bool(int(Path("/sys/class/net", name, "flags").read_text(), 16) & _IFF_UP) if name else None
    except (OSError, ValueError):
        return None


class LoopbackMulticastBus(can.BusABC):
    """Bus between processes of this machine on one multicast group; no datagram leaves the machine.

    The datagrams have the format of python-can. The class of python-can is not used, because it joins the group on the
    interface given by the routing table, receives all groups of the port, returns frames to their sender, and is slow.
    """

    def __init__(self, channel: str, can_filters: Any = None, **kwargs: Any):
        """channel: IPv4 "group" or "group:port". Raises ValueError for any other text, OSError if opening fails."""
        group, port = parse_channel(channel)
        self.channel_info = f"udp_multicast {group}:{port} on loopback"
        self._destination = (group, port)
        self._accepted_ids: frozenset[tuple[int, bool]] | None = None
        self.malformed_count = 0
        self._receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # Own frames are recognised by the port of this separate socket.
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._set_up(group, port)
        except OSError:
            self._receiver.close()
            self._sender.close()
            raise
        self._own_port = self._sender.getsockname()[1]
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def _set_up(self, group: str, port: int) -> None:
        receiver, sender = self._receiver, self._sender
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        receiver.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        # Bound to the group, not to all addresses, so that unicast from other machines cannot reach the socket.
        receiver.bind((group, port))
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + _LOOPBACK)
        receiver.setblocking(False)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _LOOPBACK)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        sender.bind(("127.0.0.1", 0))

    def _apply_filters(self, filters: Any) -> None:
        """Stores exact identifiers in a set for `_unpack`; python-can itself applies filters with other masks."""
        self._accepted_ids = None
        if filters and all("extended" in f and f["can_mask"] in (0x7FF, 0x1FFFFFFF) for f in filters):
            self._accepted_ids = frozenset((f["can_id"], bool(f["extended"])) for f in filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        datagram = self._read()  # before waiting, which avoids a select() for every frame of a burst
        if datagram is None:
            ready, _, _ = select.select([self._receiver], [], [], timeout)
            datagram = self._read() if ready else None
        if datagram is None:
            return None, False
        data, timestamp = datagram
        if data is None:
            return None, True
        return self._unpack(data, timestamp), self._accepted_ids is not None

    def _read(self) -> tuple[bytes | None, float] | None:
        """(datagram, kernel receive time [s since 1970]); (None, 0) if this object sent it; None if none is waiting."""
        try:
            data, ancillary, _, address = self._receiver.recvmsg(_LARGEST_DATAGRAM, socket.CMSG_SPACE(_TIMESPEC.size))
        except BlockingIOError:
            return None
        except OSError as error:
            raise can.CanOperationError(f"receive: {error.strerror}", error.errno) from error
        if address[1] == self._own_port:
            return None, 0.0
        seconds, nanoseconds = _TIMESPEC.unpack(ancillary[0][2])
        return data, seconds + nanoseconds * 1e-9

    def _unpack(self, data: bytes, timestamp: float) -> can.Message | None:
        """The frame in a datagram; None if rejected by the filter or malformed (any process can send to the group)."""
        try:
            fields = msgpack.unpackb(data, raw=False)
            if any(type(fields.get(name, type_())) is not type_ for name, type_ in _FIELD_TYPES.items()):
                raise TypeError("a field differs in type from those of python-can")
            if (self._accepted_ids is not None and not fields["is_error_frame"]
                    and (fields["arbitration_id"], fields["is_extended_id"]) not in self._accepted_ids):
                return None
            fields["timestamp"] = timestamp
            fields["channel"] = self._destination[0]
            return can.Message(check=True, **fields)
        except Exception:  # msgpack and Message raise many types for malformed input
            self.malformed_count += 1
            return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        try:
            self._sender.sendto(pack_message(msg), self._destination)
        except OSError as error:
            raise can.CanOperationError(f"send: {error.strerror}", error.errno) from error

    def fileno(self) -> int:
        return self._receiver.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._receiver.close()
        self._sender.close()


def parse_channel(channel: str) -> tuple[str, int]:
    """(group, port) of a channel such as "239.74.163.2" or "239.74.163.2:43113". Raises ValueError for any other."""
    group, _, port_text = channel.partition(":")
    try:
        is_multicast = ipaddress.IPv4Address(group).is_multicast
    except ValueError:
        is_multicast = False
    if not is_multicast:
        raise ValueError(f"{channel!r} is not an IPv4 multicast group (224.0.0.0 to 239.255.255.255) or GROUP:PORT")
    port = DEFAULT_PORT if not port_text else int(port_text) if port_text.isdigit() else 0
    if not 1 <= port <= 65535:
        raise ValueError(f"{channel!r}: the port is outside 1 to 65535")
    return group, port
