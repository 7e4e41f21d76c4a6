"""Opening buses; frames, filters and malformed datagrams on the loopback bus, which stays on the machine."""

import os
import socket
import time
from pathlib import Path

import can
import msgpack
import pytest
from canedge_bridge.transport import check_channel, link_is_up, make_id_filters, open_bus, parse_channel

GROUP = "239.74.13.11"


@pytest.fixture
def channel():
    """A group and a port of this process, because these tests may run several times simultaneously."""
    return f"{GROUP}:{20000 + os.getpid() % 20000}"


@pytest.fixture
def pair(channel):
    with open_bus("udp_multicast", channel) as one, open_bus("udp_multicast", channel) as other:
        yield one, other


def receive(bus, count):
    return [bus.recv(5.0) for _ in range(count)]


def test_frames_are_received_in_order_with_all_attributes(pair, frame):
    one, other = pair
    sent = [frame(0x123, "0102"), frame(0x7FF, b""), frame(0x40, bytes(8), is_error_frame=True),
            can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True, data=bytes(8)),
            frame(0x10, b"", is_remote_frame=True), frame(0x11, bytes(64), is_fd=True)]
    for message in sent:
        one.send(message)
    for message, received in zip(sent, receive(other, len(sent)), strict=True):
        assert received.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)


def test_stamp_is_the_time_of_reception_in_the_kernel(pair, frame):
    one, other = pair
    before = time.time()
    one.send(frame(1, b""))
    after = time.time()
    time.sleep(0.05)
    assert before - 1e-5 <= other.recv(5.0).timestamp <= after + 1e-5


def test_sender_does_not_receive_its_own_frames(pair, frame):
    one, other = pair
    one.send(frame(1, "01"))
    other.send(frame(2, "02"))
    assert one.recv(5.0).arbitration_id == 2
    assert other.recv(5.0).arbitration_id == 1
    assert one.recv(0.05) is None and other.recv(0.05) is None


def test_filters_pass_their_identifiers_and_error_frames(channel, frame):
    with open_bus("udp_multicast", channel) as sender, \
            open_bus("udp_multicast", channel, make_id_filters([(0x002, False), (0x1000, True)])) as bus:
        for message in (frame(0x001, ""), frame(0x002, ""), can.Message(arbitration_id=0x002, is_extended_id=True),
                        can.Message(arbitration_id=0x1000, is_extended_id=True), frame(0x040, "", is_error_frame=True)):
            sender.send(message)
        assert [m.arbitration_id for m in receive(bus, 3)] == [0x002, 0x1000, 0x040]
        assert bus.recv(0.05) is None


def test_masks_are_those_of_python_can(channel, frame):
    with open_bus("udp_multicast", channel) as sender, \
            open_bus("udp_multicast", channel, [{"can_id": 0x600, "can_mask": 0x700}]) as bus:
        for identifier in (0x284, 0x604, 0x7FF, 0x634):
            sender.send(frame(identifier, ""))
        assert [m.arbitration_id for m in receive(bus, 2)] == [0x604, 0x634]


@pytest.mark.parametrize("datagram", [b"", b"\x00", b"\xff" * 100, bytes(range(256)) * 8, msgpack.packb([1, 2]),
                                      msgpack.packb({"arbitration_id": 2}),
                                      msgpack.packb({"is_error_frame": 0, "arbitration_id": []})])
def test_malformed_datagram_is_counted(datagram, channel, frame):
    group, port = parse_channel(channel)
    with open_bus("udp_multicast", channel) as sender, \
            open_bus("udp_multicast", channel, make_id_filters([(2, False)])) as bus, \
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        other.sendto(datagram, (group, port))
        sender.send(frame(2, "05"))
        assert bus.recv(5.0).data == b"\x05"
        assert bus.malformed_count == 1


def test_groups_that_share_a_port_are_separate_buses(channel, frame):
    _, port = parse_channel(channel)
    with open_bus("udp_multicast", channel) as bus, open_bus("udp_multicast", f"239.74.13.12:{port}") as neighbour, \
            open_bus("udp_multicast", channel) as sender:
        neighbour.send(frame(1, ""))
        sender.send(frame(2, ""))
        assert bus.recv(5.0).arbitration_id == 2
        assert neighbour.recv(0.05) is None


def test_group_and_sender_use_only_the_loopback_interface(channel):
    with open_bus("udp_multicast", channel) as bus:
        expected = socket.inet_aton(GROUP)[::-1].hex().upper()
        device, members = "", set()
        for line in Path("/proc/net/igmp").read_text().splitlines()[1:]:
            if not line.startswith("\t"):
                device = line.split()[1]
            elif line.split()[0] == expected:
                members.add(device)
        assert members == {"lo"}
        sender = bus._sender
        assert sender.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4) == socket.inet_aton("127.0.0.1")
        assert sender.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
        assert sender.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize("channel", ["", "can0", "10.0.0.1", "240.0.0.1", "239.74.13", "ff15::1", "239.74.13.1:0",
                                     "239.74.13.1:65536", "239.74.13.1:port"])
def test_invalid_channel_is_rejected(channel):
    with pytest.raises(ValueError, match=r"multicast group|port is outside|empty"):
        open_bus("udp_multicast", channel)


def test_parse_channel_with_and_without_port():
    assert parse_channel("239.74.163.2") == ("239.74.163.2", 43113)
    assert parse_channel("224.0.0.9:5") == ("224.0.0.9", 5)


def test_unknown_interface_is_rejected():
    with pytest.raises(ValueError, match=r"interface 'socketcann' is not one of .*socketcan"):
        check_channel("socketcann", "can0")


def test_other_interfaces_are_opened_by_python_can(frame):
    with open_bus("virtual", "test transport") as one, \
            open_bus("virtual", "test transport", make_id_filters([(5, False)])) as other:
        one.send(frame(4, ""))
        one.send(frame(5, ""))
        assert other.recv(5.0).arbitration_id == 5


def test_link_is_up():
    assert link_is_up("lo") is True
    assert link_is_up("no such interface") is None
    assert link_is_up("") is None
