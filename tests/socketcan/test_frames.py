"""Reception of all kinds of frames from SocketCAN."""

import struct
import threading
import time

import can
import pytest
from canedge_bridge.receiver import BusState, describe_error_frame
from canedge_bridge.transport import make_id_filters, open_bus
from ros_processes import wait_for
from vcan import EXTENDED_FLAG, REMOTE_FLAG

pytestmark = pytest.mark.socketcan

STEERING, FRONT = 0x002, 0x284


def frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)


def test_kernel_filters_pass_only_the_selected_identifiers(interface):
    with open_bus("socketcan", interface.name, make_id_filters([(STEERING, False), (FRONT, False)])) as bus:
        for identifier in (0x001, STEERING, 0x003, EXTENDED_FLAG | STEERING, 0x283, FRONT, 0x7FF):
            interface.send(identifier, b"\1")
        received = [bus.recv(5.0) for _ in range(2)]
        assert [m.arbitration_id for m in received] == [STEERING, FRONT]
        assert bus.recv(0.1) is None


def test_filters_distinguish_11_and_29_bit_identifiers(interface):
    with open_bus("socketcan", interface.name, make_id_filters([(STEERING, True)])) as bus:
        interface.send(STEERING)
        interface.send(EXTENDED_FLAG | STEERING)
        received = bus.recv(5.0)
        assert (received.arbitration_id, received.is_extended_id) == (STEERING, True)
        assert bus.recv(0.1) is None


def test_stamps_are_kernel_times_of_arrival_for_frames_read_later(interface):
    with open_bus("socketcan", interface.name) as bus:
        before = time.time()
        interface.send(STEERING)
        after = time.time()
        time.sleep(0.3)
        # The resolution of a float is a quarter of a microsecond.
        assert before - 1e-6 <= bus.recv(5.0).timestamp <= after + 1e-6


@pytest.mark.parametrize(("error_class", "data", "text"), [
    (0x001, "0000000000000000", "transmit timeout"),
    (0x002, "0500000000000000", "lost arbitration (bit 5)"),
    (0x004, "0001000000000000", "controller (receive buffer overflow)"),
    (0x004, "0030000000000000", "controller (receive error-passive, transmit error-passive)"),
    (0x008, "0000040000000000", "protocol violation (bit stuffing)"),
    (0x010, "0000000000000000", "transceiver"),
    (0x020, "0000000000000000", "no acknowledge"),
    (0x040, "0000000000000000", "bus-off"),
    (0x080, "0000000000000000", "bus error"),
    (0x100, "0000000000000000", "controller restarted"),
    (0x200, "0000000000008070", "error counters (transmit 128, receive 112)"),
    (0x00C, "0004080000000000", "controller (receive warning level), protocol violation (dominant bit not sent)"),
])
def test_error_frames_pass_the_filters_and_are_described(error_class, data, text, interface):
    with open_bus("socketcan", interface.name, make_id_filters([(STEERING, False)])) as bus:
        interface.send_error(error_class, bytes.fromhex(data))
        received = bus.recv(5.0)
        assert received.is_error_frame
        assert describe_error_frame(received)[0] == text


def test_state_of_the_bus_follows_error_frames(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
    for send, expected in (
        (lambda: interface.send(STEERING), BusState.OK),
        (lambda: interface.send_error(0x004, bytes.fromhex("0020000000000000")), BusState.ERROR_PASSIVE),
        (lambda: interface.send(STEERING), BusState.ERROR_PASSIVE),
        (lambda: interface.send_error(0x040), BusState.BUS_OFF),
        (lambda: interface.send_error(0x100), BusState.SILENT),
        (lambda: interface.send(STEERING), BusState.OK),
    ):
        count = receiver.status().frames + receiver.status().error_frames
        send()
        wait_for(lambda count=count: receiver.status().frames + receiver.status().error_frames == count + 1)
        wait_for(lambda expected=expected: receiver.status().state is expected, what=expected)
    status = receiver.status()
    assert (status.frames, status.error_frames, status.last_error) == (3, 3, "controller restarted")


def test_fd_frames_are_ignored(interface, start_receiver, decoder):
    """Also those with the identifier and length of a message of the table: a classical controller ignores them."""
    receiver = start_receiver(filters=make_id_filters(decoder.keys))
    wait_for(lambda: receiver.status().open_count == 1)
    good = decoder.encode("Leaf_Steering", {"steering_wheel_angle": 0.1}, 1)
    for size in (0, 5, 8, 12, 64):
        interface.send_fd(STEERING, bytes(size))
    interface.send(STEERING, bytes(good.data))
    interface.send_fd(STEERING, bytes(5))
    interface.send(FRONT)
    wait_for(lambda: len(receiver.seen) >= 2)
    assert [(f.arbitration_id, f.is_fd) for f, _ in receiver.seen] == [(STEERING, False), (FRONT, False)]
    assert decoder.decode(*receiver.seen[0]).values["steering_wheel_angle"] == pytest.approx(0.1, abs=1e-3)


def test_remote_frames_and_frames_of_wrong_length_are_not_decoded(interface, start_receiver, decoder):
    decoded = []
    receiver = start_receiver(lambda f, t: decoded.append(decoder.decode(f, t)), make_id_filters(decoder.keys))
    wait_for(lambda: receiver.status().open_count == 1)
    interface.send(REMOTE_FLAG | STEERING)
    for size in range(9):
        interface.send(STEERING, bytes.fromhex("1D000007B0123456")[:size])
    wait_for(lambda: len(decoded) == 10)
    assert [d is not None for d in decoded] == [size == 5 for size in range(-1, 9)]
    assert decoder.skipped["remote"] == 1
    assert decoder.statistics("Leaf_Steering").wrong_length == 8
    assert decoder.statistics("Leaf_Steering").good == 1


def test_frames_in_bursts_are_received_in_order(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
    with open_bus("socketcan", interface.name) as bus:
        for burst in range(80):
            for k in range(50):
                bus.send(frame(0x100, struct.pack("<I", burst * 50 + k)))
            wait_for(lambda burst=burst: len(receiver.seen) == (burst + 1) * 50)
    assert [struct.unpack("<I", bytes(f.data))[0] for f, _ in receiver.seen] == list(range(4000))
    times = [t for _, t in receiver.seen]
    assert times == sorted(times)


def test_frames_lost_to_a_full_receive_buffer_are_counted(interface, start_receiver, decoder):
    """While the process is blocked, the kernel drops frames; the counter in the frames gives their number."""
    gate = threading.Event()

    def on_frame(message, time_ns):
        gate.wait(30.0)
        decoder.decode(message, 0)  # equal times: a gap in time would count as a pause, not as a loss

    receiver = start_receiver(on_frame=on_frame)
    wait_for(lambda: receiver.status().open_count == 1)
    sent = 3000
    with open_bus("socketcan", interface.name) as bus:
        for k in range(sent):
            bus.send(decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 10.0}, k))
        gate.set()
        statistics = decoder.statistics("Leaf_WheelSpeedFront")
        wait_for(lambda: (count := statistics.good) and not time.sleep(0.3) and statistics.good == count)
        decoded = statistics.good
        assert 10 < decoded < sent
        # The next frame reveals the gap; an 8-bit counter gives its length modulo 256.
        bus.send(decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 10.0}, sent))
        wait_for(lambda: statistics.good == decoded + 1)
    assert (statistics.good + statistics.lost) % 256 == (sent + 1) % 256
    assert receiver.status().state is BusState.OK


def test_frames_of_an_unused_identifier_are_filtered_by_the_kernel(interface, start_receiver, decoder):
    receiver = start_receiver(filters=make_id_filters(decoder.keys))
    wait_for(lambda: receiver.status().open_count == 1)
    with open_bus("socketcan", interface.name) as bus:
        for k in range(3000):
            bus.send(frame(0x7DF, bytes(8)))
            if k % 100 == 0:
                bus.send(decoder.encode("Leaf_Steering", {"steering_wheel_angle": 0.1}, k // 100))
    wait_for(lambda: len(receiver.seen) >= 30)
    assert {f.arbitration_id for f, _ in receiver.seen} == {STEERING}
    assert receiver.status().frames == 30


def test_two_receivers_receive_identical_frames(interface, start_receiver):
    first, second = start_receiver(), start_receiver()
    wait_for(lambda: first.status().open_count == second.status().open_count == 1)
    for k in range(100):
        interface.send(0x100 + k, bytes([k]))
    wait_for(lambda: len(first.seen) == len(second.seen) == 100)
    frames = [[(f.arbitration_id, f.data, t) for f, t in receiver.seen] for receiver in (first, second)]
    assert frames[0] == frames[1]
