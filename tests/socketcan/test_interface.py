"""A real SocketCAN with a virtual interface: kernel filters and stamps, link down and up, interface removed and back.

Needs a kernel with AF_CAN and the rights to make an interface (`ip link add type vcan`).
"""

import shutil
import socket
import struct
import subprocess
import time

import pytest
from canedge_bridge.error_frames import BusState
from canedge_bridge.transport import id_filters, open_bus

NAME = "stvcan0"


def ip(*words):
    command = [shutil.which("ip") or "/sbin/ip", "link", *words]
    return subprocess.run(command, check=False, capture_output=True, text=True)


@pytest.fixture
def interface():
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        pytest.skip(f"no CAN in this kernel: {error}")
    made = ip("add", NAME, "type", "vcan")
    if made.returncode:
        pytest.skip(f"no virtual CAN interface can be made here: {made.stderr.strip()}")
    ip("set", NAME, "up")
    yield NAME
    ip("del", NAME)


def raw_error_frame(name, identifier):
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.bind((name,))
        sender.send(struct.pack("=IB3x8s", 0x20000000 | identifier, 8, bytes(8)))


def test_kernel_filters_and_stamps(interface, frame):
    with open_bus("socketcan", interface) as sender, \
            open_bus("socketcan", interface, id_filters([(0x002, False), (0x284, False)])) as bus:
        before = time.time()
        for identifier in (0x001, 0x002, 0x283, 0x284, 0x7FF):
            sender.send(frame(identifier, "01"))
        arrived = [bus.recv(5.0) for _ in range(2)]
        assert [m.arbitration_id for m in arrived] == [0x002, 0x284]
        assert bus.recv(0.1) is None
        assert all(before - 1e-5 <= m.timestamp <= time.time() for m in arrived)


def test_the_life_of_an_interface(interface, frame, start_receiver, until):
    receiver = start_receiver(lambda: open_bus("socketcan", interface, id_filters([(2, False)])),
                              network_interface=interface, silence=0.5)

    def send(identifier):
        with open_bus("socketcan", interface) as sender:
            sender.send(frame(identifier, "01"))

    def state(wanted):
        return until(lambda: receiver.status().state is wanted)

    assert until(lambda: receiver.status().opened == 1)
    send(2)
    assert state(BusState.OK)
    raw_error_frame(interface, 0x040)
    assert state(BusState.BUS_OFF)
    assert receiver.status().last_error == "bus-off"
    send(2)
    assert state(BusState.OK)
    ip("set", interface, "down")
    assert state(BusState.DOWN)
    ip("set", interface, "up")
    assert state(BusState.SILENT)
    send(2)
    assert state(BusState.OK)
    assert receiver.status().opened == 1
    ip("del", interface)
    assert state(BusState.GONE)
    ip("add", interface, "type", "vcan")
    ip("set", interface, "up")
    assert state(BusState.SILENT)
    send(2)
    assert state(BusState.OK)
    assert receiver.status().opened == 2
    assert receiver.status().callback_errors == 0
