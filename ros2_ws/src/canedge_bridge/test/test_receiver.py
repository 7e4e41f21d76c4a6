"""The receive thread on virtual and loopback buses, and with exceptions of drivers.

The exceptions when an interface goes down or vanishes are those of SocketCAN, raised here by a script because most test
machines have no CAN in their kernel; tests/socketcan provokes them on a kernel interface.
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


def make_opener(sender):
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


def test_frames_are_received_in_order_with_their_stamps(bus, frame, start_receiver, wait_until):
    receiver = start_receiver(make_opener(bus))
    assert wait_until(lambda: receiver.status().open_count == 1)
    before = time.time_ns()
    for identifier in range(20):
        bus.send(frame(identifier, ""))
    assert wait_until(lambda: len(receiver.received) == 20)
    assert [f.arbitration_id for f, _ in receiver.received] == list(range(20))
    # A float of seconds has a resolution of a quarter of a microsecond.
    assert all(before - 1000 <= t <= time.time_ns() for _, t in receiver.received)
    status = receiver.status()
    assert (status.state, status.frames, status.error_frames) == (BusState.OK, 20, 0)
    assert 0 <= status.delay <= status.delay_maximum


def test_silent_bus_is_not_reopened(bus, frame, start_receiver, wait_until):
    receiver = start_receiver(make_opener(bus), silence=0.1)
    assert wait_until(lambda: receiver.status().open_count == 1)
    assert receiver.status().state is BusState.SILENT
    for _ in range(2):
        bus.send(frame(1, ""))
        assert wait_until(lambda: receiver.status().state is BusState.OK)
        assert wait_until(lambda: receiver.status().state is BusState.SILENT)
    assert "no frame for more than 0.1 s" in receiver.status().reason
    assert receiver.status().open_count == 1


def test_error_frames_on_the_loopback_bus(frame, start_receiver, wait_until):
    channel = f"239.74.13.21:{20000 + os.getpid() % 20000}"
    with open_bus("udp_multicast", channel) as sender:
        receiver = start_receiver(lambda: open_bus("udp_multicast", channel))
        assert wait_until(lambda: receiver.status().open_count == 1)
        for message, state in ((frame(2, ""), BusState.OK), (error_frame(0x004, 0x10), BusState.ERROR_PASSIVE),
                               (frame(2, ""), BusState.ERROR_PASSIVE), (error_frame(0x040), BusState.BUS_OFF),
                               (error_frame(0x100), BusState.SILENT), (frame(2, ""), BusState.OK)):
            sender.send(message)
            assert wait_until(lambda state=state: receiver.status().state is state), state
        assert wait_until(lambda: len(receiver.received) == 6)
        status = receiver.status()
        assert (status.frames, status.error_frames, status.last_error) == (3, 3, "controller restarted")
        assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.ERROR_PASSIVE,
                                                   BusState.BUS_OFF, BusState.SILENT, BusState.OK]


def test_bus_off_lasts_until_the_next_frame(bus, frame, start_receiver, wait_until):
    receiver = start_receiver(make_opener(bus), silence=0.05)
    assert wait_until(lambda: receiver.status().open_count == 1)
    bus.send(error_frame(0x040))
    assert wait_until(lambda: receiver.status().state is BusState.BUS_OFF)
    assert not wait_until(lambda: receiver.status().state is not BusState.BUS_OFF, limit=0.5)
    bus.send(frame(2, ""))
    assert wait_until(lambda: receiver.status().state is BusState.OK)


@pytest.mark.parametrize("has_frames", [False, True], ids=["from the start", "after data frames"])
def test_bus_with_nothing_but_error_frames_is_silent(has_frames, bus, start_receiver, wait_until):
    """As with a wrong bit rate; the stream of error frames has no pause in which a timeout could detect the silence."""
    receiver = start_receiver(make_opener(bus), silence=0.3)
    assert wait_until(lambda: receiver.status().open_count == 1)
    if has_frames:
        bus.send(data_frame())
        assert wait_until(lambda: receiver.status().state is BusState.OK)
    end = time.monotonic() + 10
    while "only error frames; check the bit rate" not in receiver.status().reason:
        assert time.monotonic() < end, receiver.status()
        bus.send(error_frame(0x008))
        time.sleep(0.02)
    assert receiver.status().state is BusState.SILENT
    bus.send(data_frame())
    assert wait_until(lambda: receiver.status().state is BusState.OK)


def test_interface_that_was_down_is_up_again_when_it_receives_error_frames(start_receiver, wait_until):
    receiver = start_receiver(lambda: ScriptedBus([DOWN, *[error_frame(0x008)] * 3]), silence=0.05)
    assert wait_until(lambda: receiver.status().error_frames == 3)
    assert receiver.states[1][0] is BusState.DOWN
    assert receiver.status().state is BusState.SILENT and "only error frames" in receiver.status().reason


def test_bus_absent_at_the_start_is_reported_once_and_opened_later(start_receiver, wait_until):
    present = threading.Event()

    def open_later():
        if not present.is_set():
            raise OSError(errno.ENODEV, "No such device")
        return ScriptedBus([data_frame()])

    receiver = start_receiver(open_later)
    assert wait_until(lambda: receiver.status().failures >= 3)
    assert receiver.status().state is BusState.GONE
    assert receiver.states == [(BusState.GONE, "[Errno 19] No such device")]
    present.set()
    assert wait_until(lambda: receiver.status().state is BusState.OK)
    assert len(receiver.received) == 1


def test_network_that_is_down_is_not_reopened(start_receiver, wait_until):
    bus = ScriptedBus([data_frame(), DOWN, DOWN, data_frame()])
    receiver = start_receiver(lambda: bus)
    assert wait_until(lambda: len(receiver.received) == 2)
    assert wait_until(lambda: receiver.status().state is BusState.OK)
    assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.DOWN, BusState.OK]
    assert receiver.status().open_count == 1 and not bus.closed


def test_removed_device_is_reopened(start_receiver, wait_until):
    buses = [ScriptedBus([data_frame(), NO_DEVICE]), ScriptedBus([data_frame()])]
    opened = []

    def open_next():
        opened.append(buses[len(opened)])
        return opened[-1]

    receiver = start_receiver(open_next)
    assert wait_until(lambda: len(receiver.received) == 2)
    assert [s for s, _ in receiver.states] == [BusState.SILENT, BusState.OK, BusState.GONE, BusState.SILENT,
                                               BusState.OK]
    assert buses[0].closed and receiver.status().open_count == 2


@pytest.mark.parametrize("error", [RuntimeError("bug"), can.CanOperationError("buffer"), ValueError(), OSError()])
def test_exception_of_a_driver_does_not_end_the_thread(error, start_receiver, wait_until):
    scripts = [[error], [data_frame()]]
    receiver = start_receiver(lambda: ScriptedBus(scripts.pop(0)))
    assert wait_until(lambda: receiver.status().state is BusState.OK)
    assert receiver.status().failures == 1


def test_exception_in_the_frame_callback_is_counted(bus, frame, start_receiver, wait_until):
    errors = []

    def fail(message, time_ns):
        raise LookupError(message.arbitration_id)

    receiver = start_receiver(make_opener(bus), fail, on_error=errors.append)
    assert wait_until(lambda: receiver.status().open_count == 1)
    bus.send(frame(1, ""))
    bus.send(frame(2, ""))
    assert wait_until(lambda: receiver.status().callback_errors == 2)
    assert [t.args for t in errors] == [(1,), (2,)]
    assert receiver.status().state is BusState.OK


def test_exception_in_the_state_callback_does_not_end_the_thread(bus, frame, start_receiver, wait_until):
    errors = []
    receiver = start_receiver(make_opener(bus), on_error=errors.append)
    receiver._on_state = lambda state, reason: 1 / 0
    assert wait_until(lambda: receiver.status().open_count == 1)
    bus.send(frame(1, ""))
    assert wait_until(lambda: receiver.received and receiver.status().state is BusState.OK)
    assert wait_until(lambda: any(isinstance(t, ZeroDivisionError) for t in errors))


def test_stamps_of_another_clock_are_replaced_by_the_time_of_reception(start_receiver, wait_until):
    """Some adapters count from when they were switched on."""
    message = data_frame()
    message.timestamp = 12.5
    before = time.time_ns()
    receiver = start_receiver(lambda: ScriptedBus([message]))
    assert wait_until(lambda: receiver.received)
    assert before <= receiver.received[0][1] <= time.time_ns()


def test_stop_closes_the_bus_or_ends_the_waiting_for_one(start_receiver, wait_until):
    bus = ScriptedBus([])
    receiver = start_receiver(lambda: bus)
    assert wait_until(lambda: receiver.status().open_count == 1)
    receiver.stop()
    receiver.stop()  # has no effect
    assert bus.closed

    def open_absent():
        raise OSError(errno.ENODEV, "No such device")

    waiting = start_receiver(open_absent)
    assert wait_until(lambda: waiting.status().failures >= 1)
    waiting.stop()
    assert not waiting._thread.is_alive()


def test_removed_interface_is_detected_without_a_socket_error(start_receiver, wait_until):
    """The state of the link is read from files of the kernel."""
    receiver = start_receiver(lambda: ScriptedBus([]), network_interface="lo")
    assert wait_until(lambda: receiver.status().open_count == 1)
    assert receiver.status().state is BusState.SILENT
    removed = start_receiver(lambda: ScriptedBus([]), network_interface="no-such-can")
    assert wait_until(lambda: removed.status().state is BusState.GONE)
    assert "no-such-can was removed" in removed.status().reason


def test_interface_that_is_down_is_reported_with_the_command_that_helps(start_receiver, wait_until, monkeypatch):
    monkeypatch.setattr("canedge_bridge.receiver.link_is_up", lambda name: False)
    down = start_receiver(lambda: ScriptedBus([]), network_interface="can7")
    assert wait_until(lambda: down.status().reason == "interface can7 is down; switch it on: ip link set can7 up")
