"""A node's life from start to signal, and subscriptions that are emptied by hand."""

import signal
import sys
import textwrap
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from ros_processes import Processes, wait_for

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
                    print("said all", flush=True)

        def close(self):
            if "much" in sys.argv:
                words = self.create_publisher(String, "words", QoSProfile(depth=1000))
                while not words.get_subscription_count():
                    time.sleep(0.01)
                for _ in range(600):
                    words.publish(String(data=4000 * "x"))
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
            self.heard, self.finished = [], False
            self.create_timer(0.2, self.drain)
            print("up", flush=True)

        def drain(self):
            for message, received_ns, sent_ns in self.subscription.take(7):
                # Both are UTC in ns; what UDP lost is sent again up to 3 s later.
                assert 0 <= received_ns - sent_ns < 60 * 10**9
                self.heard.append((deserialize_message(message, Int64) if isinstance(message, bytes) else message).data)
            if len(self.heard) >= 20:
                while self.heard[-1] != -1:
                    self.heard += [(deserialize_message(m, Int64) if isinstance(m, bytes) else m).data
                                   for m, _, _ in self.subscription.take()]
                self.finished = True

        def close(self):
            print(self.subscription.topic, self.heard == [*range(500), -1], flush=True)

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
            self.create_subscription(String, "words", self.hear, QoSProfile(depth=1000))
            print("up", flush=True)

        def hear(self, message):
            self.count += 1
            if self.count == 600:
                print("all", flush=True)

        def close(self):
            print(self.count, flush=True)

    sys.exit(spin.run(Counter))
"""


def script(processes: Processes, text: str, name: str, *arguments: str):
    file = processes.folder / f"{name}.py"
    file.write_text(textwrap.dedent(text))
    return processes.start([sys.executable, str(file), *arguments], name)


@pytest.fixture
def processes(tmp_path: Path):
    running = Processes(tmp_path)
    yield running
    running.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("argument", "status"), [("well", 0), ("fail", 3)])
def test_signal_closes_the_node_and_gives_its_status(
    processes: Processes, number: int, argument: str, status: int
) -> None:
    node = script(processes, TALKER, "talker", argument)
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    assert processes.stop(node, number) == status
    assert processes.log("talker").split() == ["up", "closed"]


def test_signals_to_the_very_end_do_not_spoil_the_status(processes: Processes) -> None:
    """As `ros2 launch` does on Ctrl-C: the terminal's signal, then its own, while the node is on its way out."""
    node = script(processes, TALKER, "talker", "well")
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    while node.poll() is None:
        node.send_signal(signal.SIGINT)
        time.sleep(0.001)
    assert node.returncode == 0
    assert processes.log("talker").split() == ["up", "closed"]


def test_refused_start_is_one_line_and_status_two(processes: Processes) -> None:
    node = script(processes, TALKER, "talker", "refuse")
    assert node.wait(30) == 2
    assert processes.log("talker") == "talker.number: 5 is too much\n"


def test_parameter_file_that_does_not_parse_is_status_two(processes: Processes) -> None:
    (processes.folder / "broken.yaml").write_text("talker:\n  ros__parameters:\n    a: [1, x\n")
    node = script(processes, TALKER, "talker", "--ros-args", "--params-file", str(processes.folder / "broken.yaml"))
    assert node.wait(30) == 2
    assert "Traceback" not in processes.log("talker")
    assert "cannot start" in processes.log("talker")
    assert "broken.yaml" in processes.log("talker")


@pytest.mark.parametrize("kind", ["message", "raw"])
def test_polled_subscription_hears_all_in_order_up_to_the_last_word(processes: Processes, kind: str) -> None:
    """The last message is published by close(), after the signal."""
    listener = script(processes, LISTENER, "listener", kind)
    wait_for(lambda: "up" in processes.log("listener"), what="listener up")
    talker = script(processes, TALKER, "talker")
    wait_for(lambda: "said all" in processes.log("talker"), what="talker done")
    assert processes.stop(talker) == 0
    assert listener.wait(20) == 0
    assert processes.log("listener").split() == ["up", "/numbers", "True"]


def test_what_a_node_says_at_its_end_arrives_however_much_it_is(processes: Processes) -> None:
    """Ten times what a socket holds: some of it is lost on the way and sent again."""
    counter = script(processes, COUNTER, "counter")
    wait_for(lambda: "up" in processes.log("counter"), what="counter up")
    talker = script(processes, TALKER, "talker", "much")
    wait_for(lambda: "up" in processes.log("talker"), what="talker up")
    assert processes.stop(talker) == 0
    wait_for(lambda: "all" in processes.log("counter"), what="all words")
    assert processes.stop(counter) == 0
    assert processes.log("counter").split() == ["up", "all", "600"]
