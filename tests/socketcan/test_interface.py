"""The receiver while its SocketCAN interface goes down, comes up, is deleted, renamed and created again."""

import logging
import os
import threading
import time
from pathlib import Path

import can
import pytest
from canedge_bridge.receiver import BusState
from canedge_bridge.transport import link_is_up, make_id_filters, open_bus
from ros_processes import wait_for

pytestmark = pytest.mark.socketcan


def wait_for_state(receiver, expected):
    wait_for(lambda: receiver.status().state is expected, what=f"{expected}, it is {receiver.status()}")


def count_open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_state_follows_the_interface_and_the_receiver_reopens_a_recreated_one(interface, start_receiver):
    receiver = start_receiver(filters=make_id_filters([(2, False)]))
    wait_for(lambda: receiver.status().open_count == 1)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    interface.down()
    wait_for_state(receiver, BusState.DOWN)
    interface.up()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    assert receiver.status().open_count == 1
    interface.delete()
    wait_for_state(receiver, BusState.GONE)
    interface.create()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2)
    wait_for_state(receiver, BusState.OK)
    assert receiver.status().open_count == 2
    assert receiver.status().callback_errors == 0


def test_interface_may_be_created_after_the_start(interface, start_receiver):
    interface.delete()
    receiver = start_receiver()
    wait_for(lambda: receiver.status().failures >= 2)
    assert [state for state, _ in receiver.states] == [BusState.GONE]
    interface.create()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2, b"\1")
    wait_for(lambda: receiver.seen)
    assert receiver.status().open_count == 1


def test_interface_may_come_up_after_the_start(interface, start_receiver):
    interface.down()
    assert link_is_up(interface.name) is False
    receiver = start_receiver()
    wait_for_state(receiver, BusState.DOWN)
    interface.up()
    wait_for_state(receiver, BusState.SILENT)
    interface.send(2, b"\1")
    wait_for(lambda: receiver.seen)
    assert receiver.status().state is BusState.OK


def test_socket_survives_ten_times_down_and_up(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
    for k in range(10):
        interface.down()
        interface.up()
        interface.send(k + 1)
        wait_for(lambda k=k: len(receiver.seen) == k + 1)
    assert [frame.arbitration_id for frame, _ in receiver.seen] == list(range(1, 11))
    assert receiver.status().open_count == 1


def test_recreated_interface_leaves_no_open_socket(interface, start_receiver, caplog):
    # pytest keeps log records of failed attempts, whose errors refer to their sockets.
    caplog.set_level(logging.CRITICAL, "can.interfaces.socketcan")
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
    before = count_open_files()
    for k in range(4):
        interface.delete()
        wait_for_state(receiver, BusState.GONE)
        interface.create()
        wait_for(lambda k=k: receiver.status().open_count == k + 2)
        interface.send(2)
        wait_for_state(receiver, BusState.OK)
    wait_for(lambda: count_open_files() == before, what=f"{count_open_files()} open files instead of {before}")


def test_renamed_interface_counts_as_gone_until_it_has_its_name_again(interface, start_receiver):
    """As udev may do with an adapter: the open socket follows it, but the interface is configured by name."""
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
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


def test_interface_deleted_under_load_is_received_again(interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
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


@pytest.mark.parametrize("fault", ["down", "delete"])
def test_stop_does_not_wait_for_the_interface(fault, interface, start_receiver):
    receiver = start_receiver()
    wait_for(lambda: receiver.status().open_count == 1)
    getattr(interface, fault)()
    wait_for(lambda: receiver.status().state in (BusState.DOWN, BusState.GONE))
    receiver.stop()
    assert not any(thread.name == "can receiver" for thread in threading.enumerate())


def test_unknown_interface_raises_an_os_error(interface):
    with pytest.raises(OSError, match="No such device") as error:
        open_bus("socketcan", "no-such-can")
    assert os.strerror(error.value.errno) == "No such device"
