"""The receive thread on real buses (virtual, loopback), and its answers to what drivers raise.

What a driver raises when an interface goes down or vanishes is scripted here with the errors SocketCAN gives, because
most test machines have no CAN in their kernel; tests/socketcan provokes the same on a real one.
"""

import errno
import os
import threading
import time

import can
import pytest
from canedge_bridge.receiver import BusState
from canedge_bridge.transport import open_bus

DOWN = can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)
NO_DEVICE = can.CanOperationError("Error receiving: No such device", errno.ENODEV)


@pytest.fixture
def bus(request):
    """The sender's end of a virtual bus of this test."""
    with can.Bus(interface="virtual", channel=request.node.name) as sender:
        sender.name = request.node.name
        yield sender


def opener(sender):
    return lambda: can.Bus(interface="virtual", channel=sender.name)


class ScriptedBus(can.BusABC):
    """Returns or raises one item of a list per recv(), then nothing."""

    def __init__(self, script):
        super().__init__(channel="script")
        self.script = script
        self.closed = False

    def _recv_internal(self, timeout):
        item = self.script.pop(0) if self.script else None
        if isinstance(item, Exception):
            raise item
        if item is None:
            time.sleep(min(timeout, 0.02))
        return item, True

    def send(self, msg, timeout=None):
        raise NotImplementedError

    def shutdown(self):
        super().shutdown()
        self.closed = True


def error_frame(identifier, status=0):
    return can.Message(arbitration_id=identifier, is_extended_id=False, is_error_frame=True,
                       data=bytes([0, status, 0, 0, 0, 0, 0, 0]), timestamp=time.time())


def data_frame(identifier=2):
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=b"\x01", timestamp=time.time())


def test_frames_and_stamps(bus, frame, start_receiver, until):
    receiver = start_receiver(opener(bus))
    assert until(lambda: receiver.status().opened == 1)
    before = time.time_ns()
    for identifier in range(20):
        bus.send(frame(identifier, ""))
    assert until(lambda: len(receiver.seen) == 20)
    assert [f.arbitration_id for f, _ in receiver.seen] == list(range(20))
    # A float of seconds holds a stamp to a quarter of a microsecond.
    assert all(before - 1000 <= t <= time.time_ns() for _, t in receiver.seen)
    status = receiver.status()
    assert (status.state, status.frames, status.error_frames) == (BusState.OK, 20, 0)
    assert 0 <= status.delay <= status.delay_maximum


def test_silent_and_back_without_reopening(bus, frame, start_receiver, until):
    receiver = start_receiver(opener(bus), silence=0.1)
    assert until(lambda: receiver.status().opened == 1)
    assert receiver.status().state is BusState.SILENT
    for _ in range(2):
        bus.send(frame(1, ""))
        assert until(lambda: receiver.status().state is BusState.OK)
        assert until(lambda: receiver.status().state is BusState.SILENT)
    assert "no frame for more than 0.1 s" in receiver.status().reason
    assert receiver.status().opened == 1


def test_error_frames_on_the_loopback_bus(frame, start_receiver, until):
    channel = f"239.74.13.21:{20000 + os.getpid() % 20000}"
    with open_bus("udp_multicast", channel) as sender:
        receiver = start_receiver(lambda: open_bus("udp_multicast", channel))
        assert until(lambda: receiver.status().opened == 1)
        for message, state in ((frame(2, ""), BusState.OK), (error_frame(0x004, 0x10), BusState.ERROR_PASSIVE),
                               (frame(2, ""), BusState.ERROR_PASSIVE), (error_frame(0x040), BusState.BUS_OFF),
                               (error_frame(0x100), BusState.SILENT), (frame(2, ""), BusState.OK)):
            sender.send(message)
            assert until(lambda state=state: receiver.status().state is state), state
        assert until(lambda: len(receiver.seen) == 6)
        status = receiver.status()
        assert (status.frames, status.error_frames, status.last_error) == (3, 3, "controller restarted")
        assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.ERROR_PASSIVE,
                                                   BusState.BUS_OFF, BusState.SILENT, BusState.OK]


def test_bus_off_lasts_until_frames_come_again(bus, frame, start_receiver, until):
    receiver = start_receiver(opener(bus), silence=0.05)
    assert until(lambda: receiver.status().opened == 1)
    bus.send(error_frame(0x040))
    assert until(lambda: receiver.status().state is BusState.BUS_OFF)
    assert not until(lambda: receiver.status().state is not BusState.BUS_OFF, limit=0.5)
    bus.send(frame(2, ""))
    assert until(lambda: receiver.status().state is BusState.OK)


def test_absent_at_start_one_report_and_comes_by_itself(start_receiver, until):
    present = threading.Event()

    def open_later():
        if not present.is_set():
            raise OSError(errno.ENODEV, "No such device")
        return ScriptedBus([data_frame()])

    receiver = start_receiver(open_later)
    assert until(lambda: receiver.status().failures >= 3)
    assert receiver.status().state is BusState.GONE
    assert receiver.states == [(BusState.GONE, "[Errno 19] No such device")]
    present.set()
    assert until(lambda: receiver.status().state is BusState.OK)
    assert len(receiver.seen) == 1


def test_a_network_that_is_down_keeps_the_socket(start_receiver, until):
    bus = ScriptedBus([data_frame(), DOWN, DOWN, data_frame()])
    receiver = start_receiver(lambda: bus)
    assert until(lambda: len(receiver.seen) == 2)
    assert until(lambda: receiver.status().state is BusState.OK)
    assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.DOWN, BusState.OK]
    assert receiver.status().opened == 1 and not bus.closed


def test_a_removed_device_is_reopened(start_receiver, until):
    buses = [ScriptedBus([data_frame(), NO_DEVICE]), ScriptedBus([data_frame()])]
    opened = []

    def open_next():
        opened.append(buses[len(opened)])
        return opened[-1]

    receiver = start_receiver(open_next)
    assert until(lambda: len(receiver.seen) == 2)
    assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.GONE, BusState.SILENT,
                                               BusState.OK]
    assert buses[0].closed and receiver.status().opened == 2


@pytest.mark.parametrize("error", [RuntimeError("bug"), can.CanOperationError("buffer"), ValueError(), OSError()])
def test_no_exception_of_a_driver_ends_the_thread(error, start_receiver, until):
    scripts = [[error], [data_frame()]]
    receiver = start_receiver(lambda: ScriptedBus(scripts.pop(0)))
    assert until(lambda: receiver.status().state is BusState.OK)
    assert receiver.status().failures == 1


def test_an_exception_in_the_callback_is_counted(bus, frame, start_receiver, until):
    troubles = []

    def refuse(message, time_ns):
        raise LookupError(message.arbitration_id)

    receiver = start_receiver(opener(bus), refuse, on_error=troubles.append)
    assert until(lambda: receiver.status().opened == 1)
    bus.send(frame(1, ""))
    bus.send(frame(2, ""))
    assert until(lambda: receiver.status().callback_errors == 2)
    assert [t.args for t in troubles] == [(1,), (2,)]
    assert receiver.status().state is BusState.OK


def test_an_exception_in_the_report_of_a_state_does_not_end_the_thread(bus, frame, start_receiver, until):
    troubles = []
    receiver = start_receiver(opener(bus), on_error=troubles.append)
    receiver._on_state = lambda state, reason: 1 / 0
    assert until(lambda: receiver.status().opened == 1)
    bus.send(frame(1, ""))
    assert until(lambda: receiver.seen and receiver.status().state is BusState.OK)
    assert until(lambda: any(isinstance(t, ZeroDivisionError) for t in troubles))


def test_stamps_of_a_foreign_clock_are_replaced(start_receiver, until):
    """Some adapters count from power-on."""
    message = data_frame()
    message.timestamp = 12.5
    before = time.time_ns()
    receiver = start_receiver(lambda: ScriptedBus([message]))
    assert until(lambda: receiver.seen)
    assert before <= receiver.seen[0][1] <= time.time_ns()


def test_stop_closes_the_bus_and_may_come_twice_or_early(start_receiver, until):
    bus = ScriptedBus([])
    receiver = start_receiver(lambda: bus)
    assert until(lambda: receiver.status().opened == 1)
    receiver.stop()
    receiver.stop()
    assert bus.closed

    def never():
        raise OSError(errno.ENODEV, "No such device")

    waiting = start_receiver(never)
    assert until(lambda: waiting.status().failures >= 1)
    waiting.stop()
    assert not waiting._thread.is_alive()


def test_a_removed_interface_is_detected_without_an_error_of_the_socket(start_receiver, until):
    """The state of the link is read from the kernel's files."""
    receiver = start_receiver(lambda: ScriptedBus([]), network_interface="lo")
    assert until(lambda: receiver.status().opened == 1)
    assert receiver.status().state is BusState.SILENT
    gone = start_receiver(lambda: ScriptedBus([]), network_interface="no-such-can")
    assert until(lambda: gone.status().state is BusState.GONE)
    assert "no-such-can has vanished" in gone.status().reason
