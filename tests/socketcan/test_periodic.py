"""Frames sent by the broadcast manager of the kernel with a fixed period, as by a control unit."""

from contextlib import suppress

import can
import pytest
from canedge_bridge.receiver import BusState
from canedge_bridge.transport import make_id_filters, open_bus
from ros_processes import wait_for

pytestmark = pytest.mark.socketcan

PERIOD = 0.01  # s


@pytest.fixture
def sender(interface):
    with open_bus("socketcan", interface.name) as bus:
        yield bus


@pytest.fixture
def receiver(start_receiver, decoder):
    """A receiver with a list `decoded` of its decoded frames."""
    decoded = []
    started = start_receiver(lambda f, t: decoded.append(decoder.decode(f, t)), make_id_filters(decoder.keys))
    started.decoded = decoded
    wait_for(lambda: started.status().open_count == 1)
    return started


def steering(decoder, counters):
    return [decoder.encode("Leaf_Steering", {"steering_wheel_angle": 0.2}, k) for k in counters]


def test_frames_with_correct_counter_and_checksum_are_valid(sender, receiver, decoder):
    task = sender.send_periodic(steering(decoder, range(16)), PERIOD)
    wait_for(lambda: len(receiver.decoded) >= 200)
    task.stop()
    assert all(d.valid and d.values["steering_wheel_angle"] == pytest.approx(0.2, abs=1e-3) for d in receiver.decoded)
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_counter, statistics.wrong_checksum, statistics.lost) == (0, 0, 0)


def test_repeated_frames_of_a_frozen_sender_are_invalid(sender, receiver, decoder):
    """A control unit hangs while its CAN controller repeats the last frame."""
    task = sender.send_periodic(steering(decoder, [7]), PERIOD)
    wait_for(lambda: len(receiver.decoded) >= 50)
    task.stop()
    assert receiver.decoded[0].valid
    assert not any(d.valid for d in receiver.decoded[1:])
    assert decoder.statistics("Leaf_Steering").wrong_counter >= len(receiver.decoded) - 1


def test_gap_of_the_counter_makes_one_frame_invalid_and_counts_the_lost_ones(sender, receiver, decoder):
    task = sender.send_periodic(steering(decoder, [*range(0, 5), *range(8, 16)]), PERIOD)
    wait_for(lambda: len(receiver.decoded) >= 13 * 5)
    task.stop()
    faults = [d for d in receiver.decoded[:13 * 5] if not d.valid]
    assert len(faults) == 5
    assert decoder.statistics("Leaf_Steering").lost >= 15


def test_pause_of_the_sender_is_reported_as_silence(sender, receiver, decoder):
    task = sender.send_periodic(steering(decoder, range(16)), PERIOD)
    for _ in range(2):
        wait_for(lambda: receiver.status().state is BusState.OK)
        task.stop()
        wait_for(lambda: receiver.status().state is BusState.SILENT)
        task.start()
    wait_for(lambda: receiver.status().state is BusState.OK)
    task.stop()
    assert receiver.status().open_count == 1


def test_messages_with_different_periods_are_counted_separately(sender, receiver, decoder):
    """Two messages of the car and one of the INS, each with its own statistics."""
    speeds = [decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 8.0}, k) for k in range(256)]
    tasks = [
        sender.send_periodic(steering(decoder, range(16)), 0.01),
        sender.send_periodic(speeds, 0.02),
        sender.send_periodic([decoder.encode("RT_RateVehicle", {"ins_yaw_rate": 0.3})], 0.01),
    ]
    names = ("Leaf_Steering", "Leaf_WheelSpeedFront", "RT_RateVehicle")
    wait_for(lambda: all(decoder.statistics(name).good >= 100 for name in names))
    for task in tasks:
        task.stop()
    assert [decoder.statistics(name).lost for name in names] == [0, 0, 0]
    assert {d.message for d in receiver.decoded} == set(names)


def test_frames_are_received_after_the_interface_was_recreated(interface, receiver, decoder):
    # The bus is closed after its interface is deleted.
    with suppress(can.CanError), open_bus("socketcan", interface.name) as bus:
        bus.send_periodic(steering(decoder, range(16)), PERIOD)
        wait_for(lambda: len(receiver.decoded) >= 20)
        interface.delete()
        wait_for(lambda: receiver.status().state is BusState.GONE)
    interface.create()
    with open_bus("socketcan", interface.name) as bus:
        count = len(receiver.decoded)
        task = bus.send_periodic(steering(decoder, range(16)), PERIOD)
        wait_for(lambda: len(receiver.decoded) >= count + 20)
        task.stop()
    assert receiver.decoded[-1].valid
