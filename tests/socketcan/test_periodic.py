"""Frames sent by the kernel's broadcast manager at a fixed period, as a control unit sends them."""

from contextlib import suppress

import can
import pytest
from canedge_bridge.receiver import BusState
from canedge_bridge.transport import id_filters, open_bus
from ros_processes import wait_for

pytestmark = pytest.mark.socketcan

PERIOD = 0.01


@pytest.fixture
def sender(interface):
    with open_bus("socketcan", interface.name) as bus:
        yield bus


@pytest.fixture
def listening(start_receiver, decoder):
    """A receiver whose frames are decoded; `decoded` in order."""
    decoded = []
    receiver = start_receiver(lambda f, t: decoded.append(decoder.decode(f, t)), id_filters(decoder.keys))
    receiver.decoded = decoded
    wait_for(lambda: receiver.status().opened == 1)
    return receiver


def steering(decoder, counters):
    return [decoder.encode("Leaf_Steering", {"steering_wheel_angle": 0.2}, k) for k in counters]


def test_a_full_turn_of_the_counter_passes_every_check(sender, listening, decoder):
    task = sender.send_periodic(steering(decoder, range(16)), PERIOD)
    wait_for(lambda: len(listening.decoded) >= 200)
    task.stop()
    assert all(d.valid and d.values["steering_wheel_angle"] == pytest.approx(0.2, abs=1e-3) for d in listening.decoded)
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_counter, statistics.wrong_checksum, statistics.lost) == (0, 0, 0)


def test_a_frozen_sender_is_not_valid(sender, listening, decoder):
    """A control unit that hangs while its CAN controller repeats the last frame."""
    task = sender.send_periodic(steering(decoder, [7]), PERIOD)
    wait_for(lambda: len(listening.decoded) >= 50)
    task.stop()
    assert listening.decoded[0].valid
    assert not any(d.valid for d in listening.decoded[1:])
    assert decoder.statistics("Leaf_Steering").wrong_counter >= len(listening.decoded) - 1


def test_a_skipped_counter_costs_one_fault_and_counts_the_loss(sender, listening, decoder):
    task = sender.send_periodic(steering(decoder, [*range(0, 5), *range(8, 16)]), PERIOD)
    wait_for(lambda: len(listening.decoded) >= 13 * 5)
    task.stop()
    faults = [d for d in listening.decoded[:13 * 5] if not d.valid]
    assert len(faults) == 5
    assert decoder.statistics("Leaf_Steering").lost >= 15


def test_a_sender_that_pauses(sender, listening, decoder):
    task = sender.send_periodic(steering(decoder, range(16)), PERIOD)
    for _ in range(2):
        wait_for(lambda: listening.status().state is BusState.OK)
        task.stop()
        wait_for(lambda: listening.status().state is BusState.SILENT)
        task.start()
    wait_for(lambda: listening.status().state is BusState.OK)
    task.stop()
    assert listening.status().opened == 1


def test_several_messages_at_their_own_periods(sender, listening, decoder):
    """The two kinds of the car and one of the INS, each counted by its own statistics."""
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
    assert {d.message for d in listening.decoded} == set(names)


def test_frames_go_on_after_the_interface_was_away(interface, listening, decoder):
    with suppress(can.CanError), open_bus("socketcan", interface.name) as bus:  # its end finds no interface any more
        bus.send_periodic(steering(decoder, range(16)), PERIOD)
        wait_for(lambda: len(listening.decoded) >= 20)
        interface.delete()
        wait_for(lambda: listening.status().state is BusState.GONE)
    interface.create()
    with open_bus("socketcan", interface.name) as bus:
        count = len(listening.decoded)
        task = bus.send_periodic(steering(decoder, range(16)), PERIOD)
        wait_for(lambda: len(listening.decoded) >= count + 20)
        task.stop()
    assert listening.decoded[-1].valid
