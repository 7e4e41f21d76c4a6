"""Writes and reads bags of numbered messages without ROS, and reads the messages of recorded runs."""

import struct
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from st_recordings.mcap import BagWriter

DEFINITION = "# a number with a text\nint64 number\nstring text\n"
TYPE = "demo_msgs/msg/Numbered"
TYPE_HASH = "RIHS01_" + "ab" * 32


def numbered(number: int, text: str = "") -> bytes:
    """Serialises a demo_msgs/Numbered in little-endian CDR."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<qI", number, len(data)) + data


def add_numbered_topic(bag: BagWriter, topic: str = "/a") -> int:
    return bag.add_topic(topic, TYPE, definition=DEFINITION, type_hash=TYPE_HASH)


def read_numbers(path: Path) -> dict[str, list[int]]:
    """Reads a bag directory or file with rosbags: the numbers of each topic, in order of time."""
    from rosbags.rosbag2 import Reader

    found: dict[str, list[int]] = {}
    with Reader(path) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(struct.unpack_from("<q", raw, 4)[0])
    return found


def read_numbers_with_mcap(path: Path) -> dict[str, list[int]]:
    """Reads the numbers with the mcap library, which verifies checksums and decodes each message by its schema."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list[int]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message.number)
    return found


def read_messages(directory: Path, topics: Collection[str] = ()) -> dict[str, list[Any]]:
    """Reads the messages of a bag by topic, in order of reception. topics: by default all."""
    from rosbags.highlevel import AnyReader

    messages = defaultdict(list)
    with AnyReader([directory]) as reader:
        chosen = [c for c in reader.connections if not topics or c.topic in topics]
        for connection, _, raw in reader.messages(chosen):
            messages[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    return messages


def select_common_period(*known: Iterable[tuple[str, int]]) -> list[list[tuple[str, int]]]:
    """Messages (publisher, stamp) that two nodes received, from the stamp on at which both had found all publishers.

    A node may discover a publisher only after its first messages.
    """
    received = [list(messages) for messages in known]
    first = max(min(stamp for name, stamp in messages if name == publisher)
                for messages in received for publisher in {name for name, _ in messages})
    return [sorted(message for message in messages if message[1] >= first) for messages in received]


def trim_to_common_start(*topics: list[int]) -> list[list[int]]:
    """Stamps of several topics of one node, from the stamp on at which a recorder had found all of them."""
    first = max(stamps[0] for stamps in topics)
    return [[stamp for stamp in stamps if stamp >= first] for stamps in topics]


def count_ticks_before(first_ns: int, zero_ns: int, rate: float = 10.0) -> int:
    """Number of predictions that a recorder may have missed because it discovered the predictor late: ticks at `rate`
    [Hz] from the first input (zero_ns) to the first recorded prediction (first_ns)."""
    return round((first_ns - zero_ns) * 1e-9 * rate)


def nanoseconds(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def stamps(messages: list[Any]) -> list[int]:
    """Header stamps [ns]."""
    return [nanoseconds(m.header.stamp) for m in messages]


def health(messages: dict[str, list[Any]]) -> dict[str, list[tuple[int, int, str]]]:
    """Messages of each check on /diagnostics by "node: check": (stamp [ns], level, text) in order."""
    checks = defaultdict(list)
    for message in messages["/diagnostics"]:
        for status in message.status:
            checks[status.name].append((nanoseconds(message.header.stamp), status.level, status.message))
    return checks


def copy_topics(bag: Path, prefixes: tuple[str, ...], file: Path) -> None:
    """Copies the topics that begin with one of `prefixes`, and the metadata, from a recording to a file."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    (source,) = bag.glob("*.mcap")
    with source.open("rb") as stream, file.open("wb") as copy:
        reader, writer = make_reader(stream), Writer(copy)
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if not channel.topic.startswith(prefixes):
                continue
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding,
                                                               schemas[schema.id], channel.metadata)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
