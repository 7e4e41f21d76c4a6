"""The real node process over DDS, fed from a real loopback bus."""

import math
import os
import random
import signal
import subprocess
import time
from collections import defaultdict
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="no ROS here")
pytest.importorskip("st_msgs.msg", reason="the workspace is not built")

from canedge_bridge.decode import Decoder  # noqa: E402
from canedge_bridge.transport import open_bus  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from st_msgs.msg import CanFrames, InsOnCan, Steering, WheelSpeeds  # noqa: E402

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing("packets and frames are sent in real time; a node that waits for its turn reads them late"),
]

DOMAIN = 60 + os.getpid() % 40
OK, WARN, ERROR = 0, 1, 2
DEGREE = math.pi / 180


def executable() -> str:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "lib", "canedge_bridge", "canedge_bridge")
        if path.exists():
            return str(path)
    pytest.skip("canedge_bridge is not installed in the workspace")


def launch(parameters, log_folder) -> subprocess.Popen:
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"} | os.environ | {
        "ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": str(log_folder)}
    return subprocess.Popen([executable(), "--ros-args", *words], env=environment, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


class Rig:
    """A running node, a sender on its bus, and everything it has published so far."""

    def __init__(self, channel, parameters, decoder, log_folder):
        self.decoder = decoder
        self.count = 0
        self.bus = open_bus("udp_multicast", channel)
        self.process = launch(parameters, log_folder)
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node("rig", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.seen = defaultdict(list)
        for topic, kind in (("vehicle/steering", Steering), ("vehicle/wheel_speeds", WheelSpeeds),
                            ("vehicle/ins_on_can", InsOnCan), ("can/frames", CanFrames),
                            ("/diagnostics", DiagnosticArray)):
            self.node.create_subscription(kind, topic, self.seen[topic].append, 1000)

    def spin(self, condition, limit=20.0, feed=None) -> bool:
        """Spin until the condition is true; feed() is called every 10 ms."""
        end, due = time.monotonic() + limit, 0.0
        while not condition():
            if time.monotonic() > end:
                return False
            if feed is not None and time.monotonic() >= due:
                due = time.monotonic() + 0.01
                feed()
            self.executor.spin_once(timeout_sec=0.005)
        return True

    def steer(self, angle=0.0):
        self.count += 1
        self.bus.send(self.decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, self.count))

    def received(self, topic, feed=None):
        """The next message of a topic."""
        self.seen[topic].clear()
        assert self.spin(lambda: self.seen[topic], feed=feed), f"nothing on {topic}"
        return self.seen[topic][-1]

    def check(self, name):
        """The newest check of that name on /diagnostics: (level, message); (None, "") before the first."""
        for array in reversed(self.seen["/diagnostics"]):
            for status in array.status:
                if status.name == f"canedge_bridge: {name}":
                    return status.level[0], status.message
        return None, ""

    def values(self, name):
        statuses = [s for array in self.seen["/diagnostics"][-1:] for s in array.status]
        return {v.key: v.value for s in statuses if s.name == f"canedge_bridge: {name}" for v in s.values}

    def stop(self, number=signal.SIGINT):
        """(exit status, stdout and stderr)"""
        self.process.send_signal(number)
        output = "".join(self.process.communicate(timeout=20))
        return self.process.returncode, output

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        self.bus.shutdown()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def rig(dbc_file, signals_file, tmp_path, request):
    """rig(parameter=value, ...) -> Rig with the node running."""
    rigs = []

    def start(**parameters) -> Rig:
        channel = f"239.74.13.{50 + len(rigs)}:{20000 + (os.getpid() * 7 + hash(request.node.name)) % 20000}"
        defaults = {"interface": "udp_multicast", "channel": channel, "dbc_file": dbc_file,
                    "signals_file": signals_file, "steering_ratio": 17.3, "steering_wheel_offset": -2.7 * DEGREE}
        rigs.append(Rig(channel, defaults | parameters, Decoder(dbc_file, signals_file), tmp_path))
        return rigs[-1]

    yield start
    for each in rigs:
        each.close()


def test_steering_by_numbers_from_the_vehicle_file(rig, dbc_file):
    leaf = dbc_file.parents[1] / "vehicle" / "leaf.yaml"
    run = rig(vehicle_file=leaf, steering_ratio=".nan", steering_wheel_offset=".nan", steering_latency=0.02)
    message = run.received("vehicle/steering", lambda: run.steer(14.6 * DEGREE))
    assert message.steering_wheel_angle == pytest.approx(14.6 * DEGREE)
    assert message.road_wheel_angle == pytest.approx(1.0 * DEGREE)
    assert message.valid
    run.seen["vehicle/steering"].clear()
    before = time.time()
    run.steer(14.6 * DEGREE)
    after = time.time()

    def turned() -> float:  # when the wheel was turned [s]
        stamp = run.seen["vehicle/steering"][-1].header.stamp
        return stamp.sec + stamp.nanosec * 1e-9 + 0.02

    # What was sent before may still come.
    assert run.spin(lambda: run.seen["vehicle/steering"] and turned() >= before - 1e-4)
    assert turned() <= after + 1e-4
    status, output = run.stop()
    assert status == 0
    assert "road_wheel_angle = (+1 * sensor - (-0.047124 rad)) / 17.3" in output
    assert "requires Leaf_Steering" in output


def test_explicit_parameters_win_and_the_sign_comes_first(rig, dbc_file):
    leaf = dbc_file.parents[1] / "vehicle" / "leaf.yaml"
    run = rig(vehicle_file=leaf, steering_sign=-1, steering_ratio=10.0, steering_wheel_offset=3.0 * DEGREE)
    message = run.received("vehicle/steering", lambda: run.steer(-23.0 * DEGREE))
    assert message.steering_wheel_angle == pytest.approx(23.0 * DEGREE)
    assert message.road_wheel_angle == pytest.approx(2.0 * DEGREE)
    assert run.stop(signal.SIGTERM)[0] == 0


def test_wheel_speeds_the_ins_and_raw_frames(rig, frame):
    run = rig(publish_frames=True)
    encode = run.decoder.encode

    def feed():
        run.count += 1
        run.bus.send(encode("Leaf_WheelSpeedFront", {"wheel_speed_front_left": 10.0, "vehicle_speed": 9.0}, run.count))

    front = run.received("vehicle/wheel_speeds", feed)
    assert (front.front_left, front.front_right, front.vehicle_speed) == pytest.approx((10.0, 0.0, 9.0))
    assert math.isnan(front.rear_left) and math.isnan(front.rear_right) and front.valid
    velocity = encode("RT_VelocityLevel", {"ins_velocity_x": 20.0, "ins_velocity_y": 0.5})
    ins = run.received("vehicle/ins_on_can", lambda: run.bus.send(velocity))
    assert (ins.velocity_x, ins.velocity_y) == pytest.approx((20.0, 0.5))
    assert math.isnan(ins.yaw) and math.isnan(ins.yaw_rate) and math.isnan(ins.unix_time)
    milli_time = encode("RT_MilliTime", {"ins_unix_time": 1.7e9 + 0.25})
    run.bus.send(milli_time)
    assert run.spin(lambda: not math.isnan(run.seen["vehicle/ins_on_can"][-1].unix_time))
    assert run.seen["vehicle/ins_on_can"][-1].unix_time == pytest.approx(1.7e9 + 0.25, abs=1e-6)

    run.bus.send(frame(0x123, "010203"))
    run.bus.send(frame(0x040, bytes(8), is_error_frame=True))

    def frames():
        return [f for message in run.seen["can/frames"] for f in message.frames]

    assert run.spin(lambda: any(f.is_error for f in frames()))
    assert [(f.id, bytes(f.data), f.is_error) for f in frames()[-4:]] == [
        (0x604, bytes.fromhex("D007CEFF"), False), (0x630, bytes(milli_time.data), False), (0x123, b"\1\2\3", False),
        (0x040, bytes(8), True)]
    assert run.seen["can/frames"][0].header.frame_id.startswith("udp_multicast:239.74.13.")
    assert run.stop()[0] == 0


def test_silence_and_return(rig):
    run = rig(silence_after=0.3)

    def rate():
        return run.values("frames").get("Leaf_Steering rate, expected [frames/s]", "0, 0").split(", ")

    assert run.spin(lambda: run.check("signals") == (ERROR, "steering_wheel_angle (Leaf_Steering): no frame yet"))
    assert run.check("bus")[0] == WARN and "silent: no frame yet" in run.check("bus")[1]
    run.received("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("bus")[0] == OK and run.check("signals")[0] == OK, feed=run.steer)
    assert run.spin(lambda: float(rate()[0]) > 0, feed=run.steer)
    assert rate()[1] == "100"
    assert float(run.values("signals")["steering_wheel_angle (Leaf_Steering) age [s]"]) < 0.2
    assert run.spin(lambda: run.check("bus")[0] == WARN)
    assert run.spin(lambda: run.check("signals")[0] == ERROR)
    assert "steering_wheel_angle (Leaf_Steering): no good frame for" in run.check("signals")[1]
    run.received("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("bus")[0] == OK and run.check("signals")[0] == OK, feed=run.steer)
    assert run.stop()[0] == 0


def spoil(run, angle):
    run.count += 1
    good = run.decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, run.count)
    good.data[4] ^= 0x10
    run.bus.send(good)


@pytest.mark.parametrize("mode", ["warn", "drop"])
def test_wrong_checksum(mode, rig):
    run = rig(checks=f"['Leaf_Steering=drop', 'Leaf_Steering.checksum={mode}']")
    assert run.received("vehicle/steering", run.steer).valid
    spoil(run, 0.1)
    run.steer(0.2)

    def after():  # frames of angle 0 that were sent before may still come
        return [(round(m.steering_wheel_angle, 1), m.valid) for m in run.seen["vehicle/steering"]
                if m.steering_wheel_angle > 0.05]

    assert run.spin(lambda: (0.2, True) in after())
    assert after() == ([(0.1, False), (0.2, True)] if mode == "warn" else [(0.2, True)])
    assert run.spin(lambda: run.values("frames").get("Leaf_Steering wrong checksum") == "1", feed=run.steer)
    assert run.values("frames").get("Leaf_Steering dropped") == (None if mode == "warn" else "1")
    assert run.stop()[0] == 0


def test_random_frames_on_the_bus_have_no_effect(rig, frame):
    run = rig()
    run.received("vehicle/steering", run.steer)
    rng = random.Random(1)
    for _ in range(2000):
        identifier = rng.choice([0x002, 0x284, 0x285, 0x600, 0x604, 0x630, rng.randrange(0x800)])
        run.bus.send(frame(identifier, rng.randbytes(rng.randrange(9)), is_error_frame=rng.random() < 0.1))
    good = run.decoder.encode("RT_RateVehicle", {"ins_yaw_rate": 0.25})
    # The nonsense has condemned the steering signal; a second of good frames brings it back.
    assert run.spin(lambda: run.check("plausibility")[0] == ERROR)
    assert "SteeringWheelAngle decodes to implausible values" in run.check("plausibility")[1]
    run.seen["vehicle/ins_on_can"].clear()
    # Again and again, as on a bus: the node publishes only what it has found a listener of, topic after topic.
    assert run.spin(lambda: any(abs(m.yaw_rate - 0.25) < 1e-3 for m in run.seen["vehicle/ins_on_can"]),
                    feed=lambda: run.bus.send(good))
    run.received("vehicle/steering", run.steer)
    assert run.spin(lambda: run.check("plausibility")[0] == OK, feed=run.steer)
    assert run.values("bus")["frames not processed"] == "0"
    status, output = run.stop()
    assert status == 0 and "Traceback" not in output


def test_an_absent_bus_is_reported_once_and_does_not_end_the_node(rig, tmp_path):
    run = rig(interface="socketcan", channel="no-such-can")
    assert run.spin(lambda: run.check("bus")[0] == ERROR)
    assert "socketcan:no-such-can gone" in run.check("bus")[1]
    assert run.spin(lambda: int(run.values("bus")["failures"]) >= 3)
    status, output = run.stop()
    assert status == 0
    assert sum("no-such-can gone" in line for line in output.splitlines()) == 1


@pytest.mark.parametrize(("parameters", "message"), [
    ({"steering_rato": 17.3}, "unknown parameter steering_rato"),
    ({"steering_sign": 0}, "steering_sign: 0 is not one of 1, -1"),
    ({"steering_ratio": 0.5}, "steering_ratio: 0.5 is outside 1 to 60"),
    ({"steering_ratio": ".nan"}, "steering_ratio: not set; set it or vehicle_file"),
    ({"vehicle_file": "/none.yaml"}, "vehicle_file: /none.yaml: cannot be read: No such file"),
    ({"dbc_file": "/none.dbc"}, "/none.dbc: cannot be read: No such file"),
    ({"interface": "sockcan"}, "interface 'sockcan' is not one of"),
    ({"channel": "can0"}, "'can0' is not an IPv4 multicast group"),
    ({"checks": "['Leaf_Steering']"}, "checks: 'Leaf_Steering' is not MESSAGE=off|warn|drop"),
    ({"needed_messages": "['Leaf_Brakes']"}, "needed message Leaf_Brakes is not in the table"),
])
def test_a_wrong_configuration_is_one_line_and_exit_2(parameters, message, dbc_file, signals_file, tmp_path):
    defaults = {"interface": "udp_multicast", "channel": "239.74.13.90", "dbc_file": dbc_file,
                "signals_file": signals_file, "steering_ratio": 17.3, "steering_wheel_offset": 0.0}
    process = launch(defaults | parameters, tmp_path)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert message in err and len(err.strip().splitlines()) == 1 and out == ""


def test_a_dbc_that_swaps_the_bytes_is_refused_at_start(changed_dbc, signals_file, tmp_path):
    path = changed_dbc("SteeringWheelAngle : 0|16@1-", "SteeringWheelAngle : 7|16@0-")
    process = launch({"interface": "udp_multicast", "channel": "239.74.13.90", "dbc_file": path,
                      "signals_file": signals_file, "steering_ratio": 17.3, "steering_wheel_offset": 0.0}, tmp_path)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "SteeringWheelAngle decodes the recorded frame 1D 00 00 07 B0" in err
    assert len(err.strip().splitlines()) == 1
