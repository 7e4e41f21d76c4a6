"""Several recorders with the same directory: one uses it, the others change nothing."""

import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from bags import DEFINITION, TYPE, TYPE_HASH, numbered, read_numbers
from st_recordings.mcap import BagWriter

RECORDERS = 8


def record(bag: BagWriter, number: int) -> None:
    topic = bag.add_topic("/a", TYPE, definition=DEFINITION, type_hash=TYPE_HASH)
    bag.write(topic, numbered(number), 10**18)
    bag.close()


def test_one_of_many_simultaneous_recorders_gets_the_directory(tmp_path: Path) -> None:
    for attempt in range(20):
        directory, barrier, bags, errors = tmp_path / str(attempt), threading.Barrier(RECORDERS), [], []

        def begin(directory: Path = directory, barrier=barrier, bags=bags, errors=errors) -> None:
            barrier.wait()
            try:
                bags.append(BagWriter(directory))
            except FileExistsError as error:
                errors.append(error)

        threads = [threading.Thread(target=begin) for _ in range(RECORDERS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (len(bags), len(errors)) == (1, RECORDERS - 1)
        record(bags[0], attempt)
        assert read_numbers(directory) == {"/a": [attempt]}


def test_restarted_recorder_writes_a_numbered_directory(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from st_predictor.nodes._bag import open_bag
    from st_ros.parameters import ConfigurationError

    values = SimpleNamespace(output_directory=str(tmp_path / "bag"), number_if_exists=True, message_prefix="recorder.")
    for number in range(3):
        record(open_bag(values, {}), number)
    found = {path.name: read_numbers(path) for path in tmp_path.iterdir()}
    assert found == {"bag": {"/a": [0]}, "bag_2": {"/a": [1]}, "bag_3": {"/a": [2]}}
    values.number_if_exists = False
    with pytest.raises(ConfigurationError, match="contains files"):
        open_bag(values, {})
    values.number_if_exists, values.output_directory = True, str(tmp_path / "bag" / "metadata.yaml")
    with pytest.raises(ConfigurationError, match=r"metadata\.yaml"):
        open_bag(values, {})
