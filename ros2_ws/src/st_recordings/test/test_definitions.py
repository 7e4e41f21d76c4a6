"""Message definitions and hashes of the installed packages against an independent implementation (rosbags)."""

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from st_recordings.bag_metadata import TYPE_SEPARATOR, UnknownTypeError, read_definition, read_type_hash

pytestmark = pytest.mark.ros
STANDARD = [
    "nav_msgs/msg/Odometry", "nav_msgs/msg/Path", "diagnostic_msgs/msg/DiagnosticArray", "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/Imu", "rcl_interfaces/msg/Log",
]
ST_MSGS = ["Prediction", "PredictionError", "ErrorSummary", "Steering", "Ncom", "CanFrames", "InsStatus", "Trigger"]


@pytest.mark.parametrize("name", STANDARD)
def test_hash_equals_that_of_the_distribution(name: str) -> None:
    assert read_type_hash(name) == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)


@pytest.mark.parametrize("name", STANDARD + [f"st_msgs/msg/{n}" for n in ST_MSGS])
def test_hash_follows_from_the_definition(name: str) -> None:
    """The text with all types that it contains gives the hash of the installed package."""
    store = get_typestore(Stores.EMPTY)
    parts = read_definition(name).split(f"{TYPE_SEPARATOR}\n")
    texts = {name: parts[0]}
    for part in parts[1:]:
        head, _, text = part.partition("\n")
        package, _, short = head.removeprefix("MSG: ").partition("/")
        texts[f"{package}/msg/{short}"] = text
    assert len(texts) == len(parts)
    for type_name, text in texts.items():
        store.register(get_types_from_msg(text, type_name))
    assert store.hash_rihs01(name) == read_type_hash(name)


def test_type_that_is_not_installed_is_rejected() -> None:
    with pytest.raises(UnknownTypeError, match="no_such_msgs/msg/Thing is not installed"):
        read_definition("no_such_msgs/msg/Thing")
    with pytest.raises(UnknownTypeError, match="nav_msgs/msg/Thing"):
        read_type_hash("nav_msgs/msg/Thing")
