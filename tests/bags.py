"""Bags of numbered messages, made and read back without ROS; and the messages of recorded runs."""

import struct
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

DEFINITION = "# a number with a text\nint64 number\nstring text\n"
TYPE = "demo_msgs/msg/Numbered"
TYPE_HASH = "RIHS01_" + "ab" * 32


def numbered(number: int, text: str = "") -> bytes:
    """A demo_msgs/Numbered in CDR, little endian."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<qI", number, len(data)) + data


def read_numbers(path: Path) -> dict[str, list[int]]:
    """What rosbags reads from a bag directory or file: the numbers of each topic, in time order."""
    from rosbags.rosbag2 import Reader

    found: dict[str, list[int]] = {}
    with Reader(path) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(struct.unpack_from("<q", raw, 4)[0])
    return found


def read_numbers_with_mcap(path: Path) -> dict[str, list[int]]:
    """The same with the mcap library, checksums checked, every message decoded by its schema."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list[int]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message.number)
    return found


def read_messages(directory: Path, topics: Collection[str] = ()) -> dict[str, list[Any]]:
    """The messages of a bag by topic, in the order of their receipt; of all topics where none are named."""
    from rosbags.highlevel import AnyReader

    messages = defaultdict(list)
    with AnyReader([directory]) as reader:
        wanted = [c for c in reader.connections if not topics or c.topic in topics]
        for connection, _, raw in reader.messages(wanted):
            messages[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    return messages


def from_where_both_heard(*known: Iterable[tuple[str, int]]) -> list[list[tuple[str, int]]]:
    """Of what two nodes know of several publishers, as (publisher, stamp): from the stamp on at which both knew all.

    Nodes find each publisher in their own time, which may be after its first messages.
    """
    both = [list(one) for one in known]
    first = max(min(stamp for name, stamp in one if name == publisher)
                for one in both for publisher in {name for name, _ in one})
    return [sorted(each for each in one if each[1] >= first) for one in both]


def from_where_all_heard(*topics: list[int]) -> list[list[int]]:
    """Stamps of several topics of one node, from the one on at which a recorder had found them all."""
    first = max(stamps[0] for stamps in topics)
    return [[stamp for stamp in stamps if stamp >= first] for stamps in topics]


def ticks_before(first_ns: int, zero_ns: int, rate: float = 10.0) -> int:
    """How many predictions a recorder that found the predictor late may have missed: the ticks of its rate [Hz] since
    the inputs began, up to the first prediction that it has."""
    return round((first_ns - zero_ns) * 1e-9 * rate)


def nanoseconds(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def stamps(messages: list[Any]) -> list[int]:
    """Header stamps [ns]."""
    return [nanoseconds(m.header.stamp) for m in messages]


def health(messages: dict[str, list[Any]]) -> dict[str, list[tuple[int, int, str]]]:
    """What each check of /diagnostics said: (stamp [ns], level, text) in order, by "node: check"."""
    said = defaultdict(list)
    for message in messages["/diagnostics"]:
        for status in message.status:
            said[status.name].append((nanoseconds(message.header.stamp), status.level, status.message))
    return said


def keep_topics(bag: Path, wanted: tuple[str, ...], file: Path) -> None:
    """A copy of a recording with the topics that begin with one of `wanted`, and with what it says about itself."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    (source,) = bag.glob("*.mcap")
    with source.open("rb") as stream, file.open("wb") as copy:
        reader, writer = make_reader(stream), Writer(copy)
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if not channel.topic.startswith(wanted):
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
