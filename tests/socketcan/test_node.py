"""The process canedge_bridge on SocketCAN: topics and diagnostics over DDS."""

import os
import signal
import time
from contextlib import suppress

import can
import pytest

pytest.importorskip("rclpy", reason="no ROS here")
pytest.importorskip("st_msgs.msg", reason="the workspace is not built")

from canedge_bridge.transport import open_bus
from node_rig import NodeRig
from st_msgs.msg import CanFrames, Steering, WheelSpeeds
from support import LEAF
from vcan import REMOTE_FLAG

pytestmark = [pytest.mark.socketcan, pytest.mark.ros]

OK, WARN, ERROR = 0, 1, 2
TOPICS = {"vehicle/steering": (Steering, 1000), "vehicle/wheel_speeds": (WheelSpeeds, 1000),
          "can/frames": (CanFrames, 1000)}


def stamp(message):
    """Time of a message [s since 1970]."""
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


class Rig(NodeRig):
    """The node on a SocketCAN interface, with the vehicle file of the Leaf."""

    def __init__(self, interface, can_files, log_folder, **parameters):
        dbc, signals = can_files
        super().__init__("canedge_bridge", TOPICS, {
            "interface": "socketcan", "channel": interface.name, "dbc_file": dbc, "signals_file": signals,
            "vehicle_file": LEAF, "silence_after": 0.5, **parameters}, log_folder)

    def wait_for(self, condition, seconds=150.0):
        if not self.spin(condition, seconds):
            pytest.fail(f"{self.check('bus')}; {self.stop()}")

    def more(self, topic, count=5):
        """Waits for that many further messages and returns them."""
        received = self.received[topic]
        start = len(received)
        self.wait_for(lambda: len(received) >= start + count)
        return received[start:]

    def wait_for_newer(self, topic, since, count):
        """The messages stamped later than `since` [s since 1970], at least `count`."""
        received = self.received[topic]
        self.wait_for(lambda: len(received) >= count and stamp(received[-count]) > since)
        return [m for m in received if stamp(m) > since]

    def wait_for_check(self, name, level, text=""):
        self.wait_for(lambda: self.check(name)[0] == level and text in self.check(name)[1])


@pytest.fixture
def start(interface, can_files, tmp_path):
    """start(parameter=value, ...) -> Rig"""
    rigs = []

    def begin(**parameters) -> Rig:
        rigs.append(Rig(interface, can_files, tmp_path, **parameters))
        return rigs[-1]

    yield begin
    for rig in rigs:
        rig.close()


@pytest.fixture
def steer(interface, decoder):
    """steer() -> a task; the kernel sends steering at 100 Hz and front wheel speeds at 50 Hz."""
    buses = []

    def begin(angle=0.2):
        bus = open_bus("socketcan", interface.name)
        buses.append(bus)
        steering = [decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, k) for k in range(16)]
        speeds = [decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 8.0}, k) for k in range(256)]
        bus.send_periodic(speeds, 0.02)
        return bus.send_periodic(steering, 0.01)

    yield begin
    for bus in buses:
        with suppress(can.CanError):  # the interface may be deleted
            bus.shutdown()


def test_steering_is_published_with_current_stamps_after_the_process_was_stopped(start, steer):
    """SIGSTOP for longer than the receive buffer covers."""
    rig = start()
    steer(0.2)
    messages = rig.more("vehicle/steering", 100)
    assert all(m.valid and m.steering_wheel_angle == pytest.approx(0.2, abs=1e-3) for m in messages)
    stamps = [stamp(m) for m in messages]
    assert stamps == sorted(set(stamps))
    assert rig.more("vehicle/wheel_speeds")[-1].vehicle_speed == pytest.approx(8.0)
    rig.wait_for_check("bus", OK)
    rig.wait_for_check("signals", OK)
    os.kill(rig.process.pid, signal.SIGSTOP)
    stopped = time.time()
    time.sleep(4.0)
    os.kill(rig.process.pid, signal.SIGCONT)
    assert rig.wait_for_newer("vehicle/steering", stopped + 5, 20)[-1].valid
    assert rig.stop(signal.SIGTERM)[0] == 0


def test_check_of_the_bus_reports_error_frames_and_an_interface_that_is_down_or_deleted(start, steer, interface):
    """A virtual interface has no controller, so the error frames are sent by the test."""
    rig = start()
    rig.wait_for_check("bus", WARN, "no frame yet")
    interface.send_error(0x004, bytes.fromhex("0020000000000000"))
    rig.wait_for_check("bus", WARN, "error-passive: controller (transmit error-passive)")
    interface.send_error(0x040)
    rig.wait_for_check("bus", ERROR, "bus-off")
    steer()
    rig.more("vehicle/steering")
    rig.wait_for_check("bus", OK)
    interface.down()
    rig.wait_for_check("bus", ERROR, "down")
    interface.up()
    rig.more("vehicle/steering")  # sent periodically by the kernel
    rig.wait_for_check("bus", OK)
    interface.delete()
    rig.wait_for_check("bus", ERROR, "gone")
    created = time.time()
    interface.create()
    steer()
    # Messages from before may still be in the queue of the subscription. The first one after the gap may be invalid.
    recent = rig.wait_for_newer("vehicle/steering", created, 20)
    assert all(m.valid for m in recent[1:]), [(stamp(m) - created, m.valid) for m in recent]
    rig.wait_for_check("bus", OK)
    assert rig.process.poll() is None


def test_frames_are_published_unchanged_by_a_node_started_before_the_interface(start, steer, interface):
    interface.delete()
    rig = start(publish_frames=True)
    rig.wait_for_check("bus", ERROR, "gone")
    interface.create()
    rig.wait_for_check("bus", WARN, "no frame yet")
    interface.send(0x123, b"\1\2\3")
    interface.send_fd(0x123, bytes(64))
    interface.send(REMOTE_FLAG | 0x124)
    interface.send_error(0x040)
    interface.send(0x80000000 | 0x18FEF100, bytes(8))
    rig.wait_for(lambda: sum(len(m.frames) for m in rig.received["can/frames"]) >= 4)
    frames = [f for m in rig.received["can/frames"] for f in m.frames]
    assert [(f.id, f.is_extended, f.is_remote, f.is_error, bytes(f.data)) for f in frames] == [
        (0x123, False, False, False, b"\1\2\3"), (0x124, False, True, False, b""),
        (0x040, False, False, True, bytes(8)), (0x18FEF100, True, False, False, bytes(8))]
    steer()
    rig.more("vehicle/steering")
    rig.wait_for_check("bus", OK)
