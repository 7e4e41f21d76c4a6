"""The node as a process, fed from a loopback bus; its messages are received over DDS."""

import math
import os
import random
import signal
import time

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs.msg", reason="needs the built workspace")

from canedge_bridge.decode import Decoder
from canedge_bridge.transport import open_bus
from node_rig import NodeRig
from st_msgs.msg import CanFrames, InsOnCan, Steering, WheelSpeeds

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing("packets and frames are sent in real time; a node without processor time reads them late"),
]

OK, WARN, ERROR = 0, 1, 2
DEGREE = math.pi / 180  # [rad]
TOPICS = {"vehicle/steering": (Steering, 1000), "vehicle/wheel_speeds": (WheelSpeeds, 1000),
          "vehicle/ins_on_can": (InsOnCan, 1000), "can/frames": (CanFrames, 1000)}


class CanRig(NodeRig):
    """A running node and a sender on its bus."""

    def __init__(self, channel, parameters, decoder, log_folder):
        """channel: of the sender."""
        self.decoder = decoder
        self.count = 0
        self.bus = open_bus("udp_multicast", channel)
        super().__init__("canedge_bridge", TOPICS, parameters, log_folder)

    def encode_steering(self, angle=0.0):
        """The next steering frame. angle: of the steering wheel [rad]."""
        self.count += 1
        return self.decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, self.count)

    def steer(self, angle=0.0):
        self.bus.send(self.encode_steering(angle))

    def next_message(self, topic, feed=None):
        self.received[topic].clear()
        assert self.spin(lambda: self.received[topic], feed=feed), f"no message on {topic}"
        return self.received[topic][-1]

    def close(self):
        self.bus.shutdown()
        super().close()


@pytest.fixture
def rig(node_parameters, tmp_path, request):
    """rig(parameter=value, ...) -> CanRig; its exit status is checked at the end."""
    rigs = []

    def start(**parameters) -> CanRig:
        channel = f"239.74.13.{50 + len(rigs)}:{20000 + (os.getpid() * 7 + hash(request.node.name)) % 20000}"
        decoder = Decoder(node_parameters["dbc_file"], node_parameters["signals_file"])
        rigs.append(CanRig(channel, node_parameters | {"channel": channel} | parameters, decoder, tmp_path))
        return rigs[-1]

    yield start
    for each in rigs:
        each.close()


def test_steering_angles_with_the_ratio_and_offset_of_the_vehicle_file(rig, dbc_file):
    leaf = dbc_file.parents[1] / "vehicle" / "leaf.yaml"
    run = rig(vehicle_file=leaf, steering_ratio=".nan", steering_wheel_offset=".nan", steering_latency=0.02)
    message = run.next_message("vehicle/steering", lambda: run.steer(14.6 * DEGREE))
    assert message.steering_wheel_angle == pytest.approx(14.6 * DEGREE)
    assert message.road_wheel_angle == pytest.approx(1.0 * DEGREE)
    assert message.valid
    run.received["vehicle/steering"].clear()
    before = time.time()
    run.steer(14.6 * DEGREE)
    after = time.time()

    def sent() -> float:
        """Time of the frame [s]: its stamp plus the steering latency."""
        stamp = run.received["vehicle/steering"][-1].header.stamp
        return stamp.sec + stamp.nanosec * 1e-9 + 0.02

    # Earlier frames may still be received.
    assert run.spin(lambda: run.received["vehicle/steering"] and sent() >= before - 1e-4)
    assert sent() <= after + 1e-4
    status, output = run.stop()
    assert status == 0
    assert "road_wheel_angle = (+1 * sensor - (-0.047124 rad)) / 17.3" in output
    assert "requires Leaf_Steering" in output


def test_parameters_replace_the_vehicle_file_and_the_sign_is_applied_before_the_offset(rig, dbc_file):
    leaf = dbc_file.parents[1] / "vehicle" / "leaf.yaml"
    run = rig(vehicle_file=leaf, steering_sign=-1, steering_ratio=10.0, steering_wheel_offset=3.0 * DEGREE)
    message = run.next_message("vehicle/steering", lambda: run.steer(-23.0 * DEGREE))
    assert message.steering_wheel_angle == pytest.approx(23.0 * DEGREE)
    assert message.road_wheel_angle == pytest.approx(2.0 * DEGREE)
    assert run.stop(signal.SIGTERM)[0] == 0


def test_wheel_speeds_ins_and_raw_frames(rig, frame):
    run = rig(publish_frames=True)
    encode = run.decoder.encode

    def feed():
        run.count += 1
        run.bus.send(encode("Leaf_WheelSpeedFront", {"wheel_speed_front_left": 10.0, "vehicle_speed": 9.0}, run.count))

    front = run.next_message("vehicle/wheel_speeds", feed)
    assert (front.front_left, front.front_right, front.vehicle_speed) == pytest.approx((10.0, 0.0, 9.0))
    assert math.isnan(front.rear_left) and math.isnan(front.rear_right) and front.valid
    velocity = encode("RT_VelocityLevel", {"ins_velocity_x": 20.0, "ins_velocity_y": 0.5})
    ins = run.next_message("vehicle/ins_on_can", lambda: run.bus.send(velocity))
    assert (ins.velocity_x, ins.velocity_y) == pytest.approx((20.0, 0.5))
    assert math.isnan(ins.yaw) and math.isnan(ins.yaw_rate) and math.isnan(ins.unix_time)
    milli_time = encode("RT_MilliTime", {"ins_unix_time": 1.7e9 + 0.25})
    run.bus.send(milli_time)
    assert run.spin(lambda: not math.isnan(run.received["vehicle/ins_on_can"][-1].unix_time))
    assert run.received["vehicle/ins_on_can"][-1].unix_time == pytest.approx(1.7e9 + 0.25, abs=1e-6)

    run.bus.send(frame(0x123, "010203"))
    run.bus.send(frame(0x040, bytes(8), is_error_frame=True))

    def frames():
        return [f for message in run.received["can/frames"] for f in message.frames]

    assert run.spin(lambda: any(f.is_error for f in frames()))
    assert [(f.id, bytes(f.data), f.is_error) for f in frames()[-4:]] == [
        (0x604, bytes.fromhex("D007CEFF"), False), (0x630, bytes(milli_time.data), False), (0x123, b"\1\2\3", False),
        (0x040, bytes(8), True)]
    assert run.received["can/frames"][0].header.frame_id.startswith("udp_multicast:239.74.13.")


def test_missing_frames_are_reported_until_they_return(rig):
    run = rig(silence_after=0.3)

    def rate():
        return run.check("frames")[2].get("Leaf_Steering rate, expected [frames/s]", "0, 0").split(", ")

    missing = ERROR, "steering_wheel_angle (Leaf_Steering): no good frame yet"
    assert run.spin(lambda: run.check("signals")[:2] == missing)
    assert run.check("bus")[0] == WARN and "silent: no frame yet" in run.check("bus")[1]
    run.next_message("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("bus")[0] == OK and run.check("signals")[0] == OK, feed=run.steer)
    assert run.spin(lambda: float(rate()[0]) > 0, feed=run.steer)
    assert rate()[1] == "100"
    assert float(run.check("signals")[2]["steering_wheel_angle (Leaf_Steering) age [s]"]) < 0.2
    assert run.spin(lambda: run.check("bus")[0] == WARN)
    assert run.spin(lambda: run.check("signals")[0] == ERROR)
    assert "steering_wheel_angle (Leaf_Steering): newest good frame is" in run.check("signals")[1]
    run.next_message("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("bus")[0] == OK and run.check("signals")[0] == OK, feed=run.steer)


def test_node_without_processor_time_reports_the_delay_of_its_frames(rig):
    run = rig()
    run.next_message("vehicle/steering", run.steer)
    assert run.check("bus")[0] in (None, OK, WARN) and "are processed" not in run.check("bus")[1]
    run.process.send_signal(signal.SIGSTOP)
    for _ in range(300):
        run.steer()
    time.sleep(0.5)
    run.process.send_signal(signal.SIGCONT)
    run.messages("vehicle/steering", 300)
    text = "optional messages are omitted; the computer is busy"
    assert run.spin(lambda: text in run.check("bus")[1], feed=run.steer)
    assert run.check("bus")[0] == WARN


@pytest.mark.parametrize("mode", ["warn", "drop"])
def test_steering_with_a_wrong_checksum_is_published_as_invalid_or_dropped(mode, rig):
    run = rig(checks=f"['Leaf_Steering=drop', 'Leaf_Steering.checksum={mode}']")
    assert run.next_message("vehicle/steering", run.steer).valid
    wrong = run.encode_steering(0.1)
    wrong.data[4] ^= 0x10
    run.bus.send(wrong)
    run.steer(0.2)

    def published():
        """(angle, valid) without earlier frames of angle 0, which may still be received."""
        return [(round(m.steering_wheel_angle, 1), m.valid) for m in run.received["vehicle/steering"]
                if m.steering_wheel_angle > 0.05]

    assert run.spin(lambda: (0.2, True) in published())
    assert published() == ([(0.1, False), (0.2, True)] if mode == "warn" else [(0.2, True)])
    assert run.spin(lambda: run.check("frames")[2].get("Leaf_Steering wrong checksum") == "1", feed=run.steer)
    assert run.check("frames")[2].get("Leaf_Steering dropped") == (None if mode == "warn" else "1")


def test_signals_are_published_again_after_random_frames(rig, frame):
    run = rig()
    run.next_message("vehicle/steering", run.steer)
    rng = random.Random(1)
    for _ in range(2000):
        identifier = rng.choice([0x002, 0x284, 0x285, 0x600, 0x604, 0x630, rng.randrange(0x800)])
        run.bus.send(frame(identifier, rng.randbytes(rng.randrange(9)), is_error_frame=rng.random() < 0.1))
    yaw_rate = run.decoder.encode("RT_RateVehicle", {"ins_yaw_rate": 0.25})
    # The random frames make the steering implausible; it is published again after a second of valid frames.
    assert run.spin(lambda: run.check("plausibility")[0] == ERROR)
    assert "SteeringWheelAngle decodes to implausible values" in run.check("plausibility")[1]
    run.received["vehicle/ins_on_can"].clear()
    # Sent repeatedly, because the node publishes a topic only after it has discovered its subscriber.
    assert run.spin(lambda: any(abs(m.yaw_rate - 0.25) < 1e-3 for m in run.received["vehicle/ins_on_can"]),
                    feed=lambda: run.bus.send(yaw_rate))
    run.next_message("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("plausibility")[0] == OK, feed=run.steer)
    assert run.check("bus")[2]["frames not processed"] == "0"


def test_absent_bus_is_reported_once_and_opening_is_retried(rig):
    run = rig(interface="socketcan", channel="no-such-can")
    assert run.spin(lambda: run.check("bus")[0] == ERROR)
    assert "socketcan:no-such-can gone" in run.check("bus")[1]
    assert run.spin(lambda: int(run.check("bus")[2]["failures"]) >= 3)
    status, output = run.stop()
    assert status == 0
    assert sum("no-such-can gone" in line for line in output.splitlines()) == 1
