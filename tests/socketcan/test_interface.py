"""The receive side while its interface goes down, comes up, vanishes and returns. On a real SocketCAN."""

import logging
import os
import threading
import time
from pathlib import Path

import can
import pytest
from canedge_bridge.receiver import BusState
from canedge_bridge.transport import id_filters, link_is_up, open_bus
from ros_processes import wait_for

pytestmark = pytest.mark.socketcan


def wait_for_state(receiver, wanted):
    wait_for(lambda: receiver.status().state is wanted, what=f"{wanted}, it is {receiver.status()}")


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_the_life_of_an_interface(interface, start_receiver):
    receiver = start_receiver(filters=id_filters([(2, False)]))
    wait_for(lambda: receiver.status().opened == 1)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    interface.send_error(0x040)
    wait_for_state(receiver, BusState.BUS_OFF)
    assert receiver.status().last_error == "bus-off"
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    interface.down()
    wait_for_state(receiver, BusState.DOWN)
    interface.up()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    assert receiver.status().opened == 1
    interface.delete()
    wait_for_state(receiver, BusState.GONE)
    interface.create()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    assert receiver.status().opened == 2
    assert receiver.status().callback_errors == 0


def test_absent_at_start(interface, start_receiver):
    interface.delete()
    receiver = start_receiver()
    wait_for(lambda: receiver.status().failures >= 2)
    assert [state for state, _ in receiver.states] == [BusState.GONE]
    interface.create()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2, b"\1")
    wait_for(lambda: receiver.seen)
    assert receiver.status().opened == 1


def test_down_at_start(interface, start_receiver):
    interface.down()
    assert link_is_up(interface.name) is False
    receiver = start_receiver()
    wait_for_state(receiver, BusState.DOWN)
    interface.up()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2, b"\1")
    wait_for(lambda: receiver.seen)
    assert receiver.status().state is BusState.OK


def test_down_and_up_ten_times_on_one_socket(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().opened == 1)
    for k in range(10):
        interface.down()
        interface.up()
        interface.send(k + 1)
        wait_for(lambda k=k: len(receiver.seen) == k + 1)
    assert [frame.arbitration_id for frame, _ in receiver.seen] == list(range(1, 11))
    assert receiver.status().opened == 1


def test_deleted_and_made_anew_leaves_no_socket_behind(interface, start_receiver, caplog):
    # A record of a failed attempt that pytest keeps holds the error, and that holds its socket.
    caplog.set_level(logging.CRITICAL, "can.interfaces.socketcan")
    receiver = start_receiver()
    wait_for(lambda: receiver.status().opened == 1)
    before = open_files()
    for k in range(4):
        interface.delete()
        wait_for_state(receiver, BusState.GONE)
        interface.create()
        wait_for(lambda k=k: receiver.status().opened == k + 2)
        interface.send(2)
        wait_for_state(receiver, BusState.OK)
    wait_for(lambda: open_files() == before, what=f"{open_files()} files are open, {before} were")


def test_renamed_away_and_back(interface, start_receiver):
    """As udev may do with an adapter: the open socket would follow it, but it was asked for by its name."""
    receiver = start_receiver()
    wait_for(lambda: receiver.status().opened == 1)
    name = interface.name
    interface.down()
    interface.rename("stother0")
    interface.up()
    wait_for_state(receiver, BusState.GONE)
    interface.down()
    interface.rename(name)
    interface.up()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)


def test_pulled_out_and_put_back_under_full_load(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().opened == 1)
    done = threading.Event()

    def load():
        while not done.is_set():
            try:
                with open_bus("socketcan", interface.name) as bus:
                    while not done.is_set():
                        bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(8)))
                        time.sleep(0.0005)
            except (OSError, can.CanError):
                time.sleep(0.01)

    sender = threading.Thread(target=load)
    sender.start()
    try:
        for k in range(3):
            wait_for_state(receiver, BusState.OK)
            interface.delete()
            wait_for(lambda k=k: BusState.GONE in [state for state, _ in receiver.states[k:]])
            interface.create()
            count = receiver.status().frames
            wait_for(lambda count=count: receiver.status().frames > count + 50)
    finally:
        done.set()
        sender.join()
    assert receiver.status().callback_errors == 0


@pytest.mark.parametrize("trouble", ["down", "delete"])
def test_stop_does_not_wait_for_the_interface(trouble, interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().opened == 1)
    getattr(interface, trouble)()
    wait_for(lambda: receiver.status().state in (BusState.DOWN, BusState.GONE))
    receiver.stop()
    assert not any(thread.name == "can receiver" for thread in threading.enumerate())


def test_no_such_interface_is_an_error_of_one_line(interface):
    with pytest.raises(OSError, match="No such device") as trouble:
        open_bus("socketcan", "no-such-can")
    assert os.strerror(trouble.value.errno) == "No such device"
