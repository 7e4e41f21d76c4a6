"""The data links of the car, NCOM over UDP and CAN frames over multicast, on which datagrams can be altered or lost."""

import socket
import time
from array import array
from collections.abc import Callable, Sequence

import can
import msgpack
from can.interfaces.udp_multicast.utils import pack_message
from canedge_bridge.transport import parse_channel

LOOPBACK = "127.0.0.1"
OTHER_UNIT = "127.0.0.2"  # an address of its own for a second INS

# Datagram -> datagrams that are sent in its place; () loses it.
Change = Callable[[bytes], Sequence[bytes]]


def unchanged(data: bytes) -> Sequence[bytes]:
    return (data,)


class Wire:
    """Sends datagrams to one address. Any thread may set `change` at any time."""

    def __init__(self, to: tuple[str, int]):
        self.to = to
        self.change: Change = unchanged
        self.sent_ns = array("q")  # eight bytes each, for hours
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)

    def send(self, data: bytes) -> None:
        for datagram in self.change(data):
            self._socket.sendto(datagram, self.to)
            self.sent_ns.append(time.time_ns())

    def close(self) -> None:
        self._socket.close()


def can_wire(channel: str) -> Wire:
    """CAN frames as datagrams of a multicast group on the loopback interface."""
    return Wire(parse_channel(channel))


def identifier(datagram: bytes) -> int:
    return msgpack.unpackb(datagram, raw=False)["arbitration_id"]


def frame_data(datagram: bytes) -> bytes:
    return msgpack.unpackb(datagram, raw=False)["data"]


pack = pack_message


def datagram(arbitration_id: int, data: bytes, error: bool = False) -> bytes:
    return pack(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False,
                            is_error_frame=error))
