"""A node from its start to its end by a signal, and polled subscriptions."""

import signal
import sys
import textwrap
import time

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from ros_processes import Processes, run_processes, wait_for

pytestmark = [pytest.mark.ros, pytest.mark.timing("timers of real time")]

TALKER = """
    import sys
    import time
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from std_msgs.msg import Int64, String
    from st_ros import spin
    from st_ros.parameters import ConfigurationError

    class Talker(Node):
        def __init__(self):
            super().__init__("talker")
            if "refuse" in sys.argv:
                raise ConfigurationError("talker.number: 5 is too much")
            self.exit_status = 3 if "fail" in sys.argv else 0
            self.number = 0
            self.publisher = self.create_publisher(Int64, "numbers", QoSProfile(depth=1000))
            self.create_timer(0.002, self.talk)
            print("up", flush=True)

        def talk(self):
            if self.publisher.get_subscription_count() and self.number < 500:
                self.publisher.publish(Int64(data=self.number))
                self.number += 1
                if self.number == 500:
                    print("published", flush=True)

        def close(self):
            if "texts" in sys.argv:
                texts = self.create_publisher(String, "texts", QoSProfile(depth=1000))
                while not texts.get_subscription_count():
                    time.sleep(0.01)
                for _ in range(600):
                    texts.publish(String(data=4000 * "x"))
            self.publisher.publish(Int64(data=-1))
            print("closed", flush=True)

    sys.exit(spin.run(Talker))
"""
LISTENER = """
    import sys
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.serialization import deserialize_message
    from std_msgs.msg import Int64
    from st_ros import spin
    from st_ros.polling import PolledSubscription

    class Listener(Node):
        def __init__(self):
            super().__init__("listener")
            raw = "raw" in sys.argv
            self.subscription = PolledSubscription(self, Int64, "numbers", QoSProfile(depth=1000), raw=raw)
            self.received, self.finished = [], False
            self.create_timer(0.2, self.drain)
            print("up", flush=True)

        def read(self, message):
            return (deserialize_message(message, Int64) if isinstance(message, bytes) else message).data

        def drain(self):
            for message, received_ns, sent_ns in self.subscription.take(7):
                # Both times are UTC [ns]; messages lost by UDP are retransmitted up to 3 s later.
                assert 0 <= received_ns - sent_ns < 60 * 10**9
                self.received.append(self.read(message))
            if len(self.received) >= 20:
                while self.received[-1] != -1:
                    self.received += [self.read(message) for message, _, _ in self.subscription.take()]
                self.finished = True

        def close(self):
            print(self.subscription.topic, self.received == [*range(500), -1], flush=True)

    sys.exit(spin.run(Listener))
"""

COUNTER = """
    import sys
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from std_msgs.msg import String
    from st_ros import spin

    class Counter(Node):
        def __init__(self):
            super().__init__("counter")
            self.count = 0
            self.create_subscription(String, "texts", self.receive, QoSProfile(depth=1000))
            print("up", flush=True)

        def receive(self, message):
            self.count += 1
            if self.count == 600:
                print("all", flush=True)

        def close(self):
            print(self.count, flush=True)

    sys.exit(spin.run(Counter))
"""


def start_script(processes: Processes, text: str, name: str, *arguments: str):
    file = processes.folder / f"{name}.py"
    file.write_text(textwrap.dedent(text))
    return processes.start([sys.executable, str(file), *arguments], name)


processes = pytest.fixture(run_processes)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("argument", "status"), [("succeed", 0), ("fail", 3)])
def test_signal_closes_the_node_and_returns_its_exit_status(
    processes: Processes, number: int, argument: str, status: int
) -> None:
    node = start_script(processes, TALKER, "talker", argument)
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    assert processes.stop(node, number) == status
    assert processes.log("talker").split() == ["up", "closed"]


def test_repeated_signals_do_not_change_the_exit_status(processes: Processes) -> None:
    """On Ctrl-C a node of `ros2 launch` gets the signal of the terminal, and a second one while it terminates."""
    node = start_script(processes, TALKER, "talker", "succeed")
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    while node.poll() is None:
        node.send_signal(signal.SIGINT)
        time.sleep(0.001)
    assert node.returncode == 0
    assert processes.log("talker").split() == ["up", "closed"]


def test_rejected_start_is_one_line_with_exit_status_2(processes: Processes) -> None:
    node = start_script(processes, TALKER, "talker", "refuse")
    assert node.wait(30) == 2
    assert processes.log("talker") == "talker.number: 5 is too much\n"


def test_invalid_parameter_file_is_rejected_with_exit_status_2(processes: Processes) -> None:
    file = processes.folder / "invalid.yaml"
    file.write_text("talker:\n  ros__parameters:\n    a: [1, x\n")
    node = start_script(processes, TALKER, "talker", "--ros-args", "--params-file", str(file))
    assert node.wait(30) == 2
    assert "Traceback" not in processes.log("talker")
    assert "cannot start" in processes.log("talker")
    assert "invalid.yaml" in processes.log("talker")


def test_middleware_that_is_not_installed_is_one_line_with_exit_status_2(processes: Processes) -> None:
    processes.environment["RMW_IMPLEMENTATION"] = "rmw_unknown_cpp"
    node = processes.start([sys.executable, "-c", "import st_ros.spin"], "middleware")
    assert node.wait(30) == 2
    log = processes.log("middleware")
    assert log.startswith("RMW_IMPLEMENTATION: rmw_unknown_cpp is not installed; use rmw_") and log.count("\n") == 1


@pytest.mark.parametrize("kind", ["message", "raw"])
def test_polled_subscription_receives_all_messages_in_order_up_to_the_last(processes: Processes, kind: str) -> None:
    """The last message is published by close(), after the signal."""
    listener = start_script(processes, LISTENER, "listener", kind)
    wait_for(lambda: "up" in processes.log("listener"), what="listener up")
    talker = start_script(processes, TALKER, "talker")
    wait_for(lambda: "published" in processes.log("talker"), what="talker done")
    assert processes.stop(talker) == 0
    assert listener.wait(20) == 0
    assert processes.log("listener").split() == ["up", "/numbers", "True"]


def test_all_messages_published_at_the_end_arrive(processes: Processes) -> None:
    """Ten times the buffer of a socket: some messages are lost and retransmitted."""
    counter = start_script(processes, COUNTER, "counter")
    wait_for(lambda: "up" in processes.log("counter"), what="counter up")
    talker = start_script(processes, TALKER, "talker", "texts")
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    assert processes.stop(talker) == 0
    wait_for(lambda: "all" in processes.log("counter"), what="all texts")
    assert processes.stop(counter) == 0
    assert processes.log("counter").split() == ["up", "all", "600"]
