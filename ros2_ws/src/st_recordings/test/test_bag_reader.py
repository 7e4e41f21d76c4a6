"""Bags of both storages: vectorised and message-by-message reading agree; unknown topics are ignored; unreadable bags
are rejected with the reason."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from oxts_bridge.channels import encode_channel
from oxts_bridge.ncom import Packet, encode
from ros_messages import STORE, definition, header, odometry, serialise
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from st_recordings.mcap import BagWriter
from st_recordings.runs import bag, find_runs, read
from st_recordings.runs.bag import ODOMETRY, STEERING, has_odometry, read_bag
from st_recordings.runs.bag_storage import McapStorage, SqliteStorage, Storage
from st_recordings.runs.cdr import CAN_FRAMES, INS_ON_CAN, INS_STATUS, NCOM, WHEEL_SPEEDS, CdrLayout
from st_recordings.runs.errors import RunError

START_NS = 1_700_000_000_123_456_789
N = 500


def odometry_message(k: int, frame: str = "map", velocity_y: float | None = None) -> tuple[int, bytes]:
    time_ns = START_NS + k * 10_000_000
    return time_ns, odometry(time_ns, 0.1 * k, -0.2 * k, 0.02 * k, 10.0, 0.01 * k if velocity_y is None else velocity_y,
                             0.3, frame=frame)


def steering_message(k: int, valid: bool = True) -> tuple[int, bytes]:
    time_ns = START_NS + 2_000_000 + k * 10_000_000
    return time_ns, serialise(STEERING, header=header(time_ns), steering_wheel_angle=0.01 * k,
                              road_wheel_angle=0.001 * k, valid=valid)


STRING = "std_msgs/msg/String"
Topics = dict[tuple[str, str], Sequence[tuple[int, bytes]]]
DRIVE: Topics = {("/ins/odometry", ODOMETRY): [odometry_message(k) for k in range(N)],
                 ("/vehicle/steering", STEERING): [steering_message(k) for k in range(N)],
                 ("/notes", STRING): [(START_NS + k * 10**9, serialise(STRING, data="x" * k)) for k in range(3)]}


def write_own(folder: Path, topics: Topics, records: dict[str, dict[str, str]] | None = None) -> Path:
    """A bag of this project's recorder."""
    writer = BagWriter(folder, records)
    for (topic, name), messages in topics.items():
        number = writer.add_topic(topic, name, definition=definition(name), type_hash=STORE.hash_rihs01(name))
        for time_ns, data in messages:
            writer.write(number, data, time_ns)
    writer.close()
    return folder


def write_topics(writer: Writer, topics: Topics, encode: Callable[[bytes], bytes] = bytes) -> None:
    for (topic, name), messages in topics.items():
        connection = writer.add_connection(topic, name, typestore=STORE)
        for time_ns, data in messages:
            writer.write(connection, time_ns, encode(data))


def write_rosbag2(folder: Path, topics: Topics, storage: StoragePlugin) -> Path:
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        write_topics(writer, topics)
    return folder


def write_mcap(file: Path, publishers: int = 1, **options) -> Path:
    """The drive, the messages of each topic by several publishers in turn. options: of the MCAP writer."""
    with file.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile="ros2")
        for (topic, name), messages in DRIVE.items():
            schema = writer.register_schema(name, "ros2msg", definition(name).encode())
            channels = [writer.register_channel(topic, "cdr", schema, {"publisher": str(k)}) for k in range(publishers)]
            for k, (time_ns, data) in enumerate(messages):
                writer.add_message(channels[k % publishers], time_ns, data, time_ns)
        writer.finish()
    return file


def check_drive(path: Path) -> None:
    log = read_bag(path).log
    k = np.arange(N)
    assert np.array_equal(log.ins_time_ns, START_NS + k * 10_000_000)
    assert np.array_equal(log.steering_time_ns, START_NS + 2_000_000 + k * 10_000_000)
    np.testing.assert_array_equal(log.x, 0.1 * k)
    np.testing.assert_array_equal(log.velocity_y, 0.01 * k)
    np.testing.assert_allclose(log.yaw, 0.02 * k, atol=1e-9)
    np.testing.assert_array_equal(log.road_wheel_angle, 0.001 * k)
    np.testing.assert_array_equal(log.steering_wheel_angle, 0.01 * k)


@pytest.mark.parametrize("storage", ["own", "mcap", "sqlite3"])
def test_bag_of_any_recorder_gives_the_drive(tmp_path: Path, storage: str) -> None:
    folder = tmp_path / "drive"
    if storage == "own":
        write_own(folder, DRIVE)
    else:
        write_rosbag2(folder, DRIVE, StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3)
    check_drive(folder)
    (file,) = bag.list_bag_files(folder)
    check_drive(file)
    without_metadata = tmp_path / f"drive #1 %41?{file.suffix}"
    without_metadata.write_bytes(file.read_bytes())
    check_drive(without_metadata)


@pytest.mark.parametrize("kind", [McapStorage, SqliteStorage])
def test_vectorised_reading_is_used_and_equals_message_by_message_reading(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    folder = tmp_path / "drive"
    if kind is McapStorage:
        write_own(folder, DRIVE)
    else:
        write_rosbag2(folder, DRIVE, StoragePlugin.SQLITE3)
    with monkeypatch.context() as patch:
        patch.delattr(Storage, "read_one_by_one")
        vectorised = read_bag(folder).log
    monkeypatch.setattr(kind, "columns", lambda *_: {})
    one_by_one = read_bag(folder).log
    for name in ("ins_time_ns", "x", "y", "yaw", "velocity_x", "yaw_rate", "steering_time_ns", "road_wheel_angle"):
        np.testing.assert_array_equal(getattr(vectorised, name), getattr(one_by_one, name))


def test_invalid_recorded_signal_table_is_an_error_only_without_steering(tmp_path: Path) -> None:
    bridge = {"ros__parameters": {"dbc_file": "can.dbc", "signals_file": "signals.yaml"}}
    records = {"configuration": {"parameters.yaml": yaml.dump({"canedge_bridge": bridge}), "can.dbc": 'VERSION ""\n',
                                 "signals.yaml": "messages: ["}}
    frames = {("/can/frames", CAN_FRAMES): [(START_NS, serialise(CAN_FRAMES, header=header(START_NS), frames=[]))]}
    check_drive(write_own(tmp_path / "with", DRIVE | frames, records))
    without = {key: messages for key, messages in DRIVE.items() if key[1] != STEERING}
    with pytest.raises(RunError, match=r"without: its recorded signals\.yaml: "):
        read_bag(write_own(tmp_path / "without", without | frames, records))


def test_odometry_with_changing_frame_ids_is_read(tmp_path: Path) -> None:
    """Messages of different lengths cannot be read as one array."""
    mixed = [odometry_message(k, "map" if k % 2 else "earth") for k in range(N)]
    check_drive(write_own(tmp_path / "drive", {**DRIVE, ("/ins/odometry", ODOMETRY): mixed}))


def test_unusable_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [steering_message(k, valid=k % 10 != 0) for k in range(N)]
    messages[55] = messages[54]
    drive = read_bag(write_own(tmp_path / "drive", {**DRIVE, ("/vehicle/steering", STEERING): messages}))
    assert len(drive.log.steering_time_ns) == N - 51
    assert any(f"50 of {N} steering messages (10 %) have no usable value" in w for w in drive.warnings)
    assert drive.auxiliary.missing == {"road_wheel_angle": 50} and len(drive.auxiliary.stamps["steering"]) == N
    assert any("steering messages (0.22 %) are not later" in w for w in drive.warnings)


def test_bag_with_raw_packets_is_a_drive_if_it_has_steering(tmp_path: Path) -> None:
    raw = {("/ins/ncom", NCOM): [(START_NS, b"\0\1")]}
    assert not has_odometry(write_own(tmp_path / "ins", raw))
    assert has_odometry(write_own(tmp_path / "drive", {**raw, **{k: m for k, m in DRIVE.items() if k[1] == STEERING}}))


@pytest.mark.parametrize(("record", "is_reported"), [({"recording": {"recorder": "st_predictor"}}, True), ({}, False)])
def test_bag_of_a_killed_recorder_is_not_ignored_in_a_folder(tmp_path: Path, record, is_reported: bool) -> None:
    """`st live` continues in bag_2; the evaluator's bag, also unclosed, contains no drive."""
    write_own(tmp_path / "bag_2", DRIVE)
    BagWriter(tmp_path / "bag", record)  # not closed
    assert [source.path.name for source in find_runs([tmp_path])] == ["bag"] * is_reported + ["bag_2"]


def test_bag_without_a_lateral_velocity_is_rejected(tmp_path: Path) -> None:
    messages = [odometry_message(k, velocity_y=math.nan) for k in range(N)]
    folder = write_own(tmp_path / "drive", {**DRIVE, ("/ins/odometry", ODOMETRY): messages})
    with pytest.raises(RunError, match=rf"fewer than two measurements .*{N} of {N} odometry messages \(100 %\) have no "
                       "usable value of velocity_y"):
        read(find_runs([folder])[0])


def test_compressed_messages_without_metadata_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        write_topics(writer, DRIVE, zstandard.compress)
    (folder / "metadata.yaml").unlink()
    check_drive(next(folder.glob("*.db3")))


def test_repeated_messages_are_read_once(tmp_path: Path) -> None:
    repeated = [(time_ns + repeat * 1_000_000, data) for time_ns, data in DRIVE["/ins/odometry", ODOMETRY]
                for repeat in range(6)]
    check_drive(write_own(tmp_path / "drive", {**DRIVE, ("/ins/odometry", ODOMETRY): repeated}))


def wheel_speed_message(k: int, front: bool) -> tuple[int, bytes]:
    """Each axle has a CAN frame of its own; signals of the other one are NaN."""
    time_ns = START_NS + k * 20_000_000
    nan = math.nan
    return time_ns, serialise(
        WHEEL_SPEEDS, header=header(time_ns), front_left=20.0 if front else nan, front_right=21.0 if front else nan,
        rear_left=nan if front else 9.0 + 0.01 * k, rear_right=nan if front else 11.0 + 0.01 * k,
        vehicle_speed=12.0 if front else nan, valid=True)


def ins_on_can_message(k: int) -> tuple[int, bytes]:
    time_ns = START_NS + k * 10_000_000
    return time_ns, serialise(INS_ON_CAN, header=header(time_ns), velocity_x=math.nan if k % 2 else 10.0,
                              velocity_y=0.0, yaw=0.0, yaw_rate=0.0, unix_time=0.0)


def status_message(k: int) -> tuple[int, bytes]:
    time_ns = START_NS + k * 10**9
    numbers = dict.fromkeys((name for name, _ in STORE.fielddefs[INS_STATUS][1]), 0)
    numbers |= {name: name * (k % 3) for name in numbers if name.endswith("text") or name == "firmware"}
    numbers |= {name: float(0) for name, (_, kind) in STORE.fielddefs[INS_STATUS][1] if kind and kind[0] == "float64"}
    return time_ns, serialise(INS_STATUS, **{
        **numbers, "header": header(time_ns), "navigation_status": 4, "position_mode": 6,
        "position_accuracy_north": 0.03, "position_accuracy_east": 0.04, "heading_accuracy": 0.001 * k,
        "antenna_lever_arm": np.zeros(3), "seen_channels": np.arange(k, dtype=np.uint32)})


AUXILIARY: Topics = {
    ("/vehicle/wheel_speeds", WHEEL_SPEEDS): [wheel_speed_message(k, front) for k in range(50)
                                              for front in (True, False)],
    ("/vehicle/ins_on_can", INS_ON_CAN): [ins_on_can_message(k) for k in range(N)],
    ("/ins/status", INS_STATUS): [status_message(k) for k in range(5)]}


@pytest.mark.parametrize("storage", ["own", "sqlite3"])
def test_auxiliary_signals_for_the_checks(tmp_path: Path, storage: str) -> None:
    if storage == "own":
        write_own(tmp_path / "drive", {**DRIVE, **AUXILIARY})
    else:
        write_rosbag2(tmp_path / "drive", {**DRIVE, **AUXILIARY}, StoragePlugin.SQLITE3)
    check_drive(tmp_path / "drive")
    auxiliary = read_bag(tmp_path / "drive").auxiliary
    np.testing.assert_allclose(auxiliary.wheel_speed.values, 10.0 + 0.01 * np.arange(50))
    np.testing.assert_array_equal(auxiliary.wheel_speed.time_ns, START_NS + 20_000_000 * np.arange(50))
    assert (auxiliary.ins_speed.values == 10.0).all() and len(auxiliary.ins_speed.values) == N // 2
    quality = auxiliary.quality
    np.testing.assert_array_equal(quality.time_ns, START_NS + 10**9 * np.arange(5))
    assert set(quality.navigation_status) == {4} and set(quality.position_mode) == {6}
    np.testing.assert_allclose(quality.position_accuracy, 0.05)
    assert [len(auxiliary.stamps[name]) for name in ("INS", "steering")] == [N, N] and auxiliary.missing == {}


def test_raw_packets_give_speed_and_quality_without_other_topics(tmp_path: Path) -> None:
    """Driving east at 8 m/s; the accuracies come with packet 10."""
    messages = []
    for k in range(100):
        channel, batch = (3, encode_channel(3, {"NorthAcc": 0.3, "EastAcc": 0.4, "AltAcc": 1.0})) if k == 10 else (
            0, (23_000_000).to_bytes(4, "little") + bytes((12, 5, 5, 5)))
        packet = encode(Packet(
            milliseconds=10 * k, acceleration=(0.0, 0.0, -9.81), angular_rate=(0.0, 0.0, 0.0), navigation_status=4,
            latitude=0.8, longitude=0.3, altitude=100.0, velocity_ned=(0.0, 8.0, 0.0), heading=np.pi / 2, pitch=0.0,
            roll=0.0, channel=channel, batch_s=batch))
        messages.append((START_NS + 10_000_000 * k, serialise(
            NCOM, header=header(START_NS), raw_packet=np.frombuffer(packet, np.uint8))))
    auxiliary = read_bag(write_own(tmp_path / "drive", {**DRIVE, ("/ins/ncom", NCOM): messages})).auxiliary
    np.testing.assert_allclose(auxiliary.ins_speed.values, np.full(100, 8.0), atol=1e-4)
    np.testing.assert_array_equal(auxiliary.quality.time_ns, auxiliary.ins_speed.time_ns)
    assert np.diff(auxiliary.ins_speed.time_ns).tolist() == [10_000_000] * 99
    assert np.isnan(auxiliary.quality.position_accuracy[:10]).all()
    np.testing.assert_allclose(auxiliary.quality.position_accuracy[10:], 0.5)
    assert set(auxiliary.quality.position_mode) == {5.0}


def test_damaged_auxiliary_topics_do_not_affect_the_drive(tmp_path: Path) -> None:
    damaged = {key: [(time_ns, data[: len(data) // 3]) for time_ns, data in messages]
               for key, messages in AUXILIARY.items()}
    damaged["/ins/ncom", NCOM] = [(START_NS, b"\0\1")]
    check_drive(write_own(tmp_path / "drive", {**DRIVE, **damaged}))
    auxiliary = read_bag(tmp_path / "drive").auxiliary
    assert auxiliary.wheel_speed is None and auxiliary.ins_speed is None and auxiliary.quality is None


def test_missing_or_ambiguous_topics_are_rejected(tmp_path: Path) -> None:
    odometry_only = {key: m for key, m in DRIVE.items() if key[1] != STEERING}
    with pytest.raises(RunError, match=r"it contains no message of type st_msgs/msg/Steering; recorded: /ins/odometry"):
        read_bag(write_own(tmp_path / "one", odometry_only))
    two_odometries = {**{key: m for key, m in DRIVE.items() if key[1] == STEERING},
                      ("/a", ODOMETRY): DRIVE["/ins/odometry", ODOMETRY],
                      ("/b", ODOMETRY): DRIVE["/ins/odometry", ODOMETRY]}
    with pytest.raises(RunError, match="several topics are of type nav_msgs/msg/Odometry: /a, /b"):
        read_bag(write_own(tmp_path / "two", two_odometries))
    usual_name = {**DRIVE, ("/other/odometry", ODOMETRY): [odometry_message(k, "elsewhere") for k in range(5)]}
    check_drive(write_own(tmp_path / "three", usual_name))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_topics_of_unknown_types_are_ignored(tmp_path: Path, storage: StoragePlugin) -> None:
    with Writer(tmp_path / "drive", version=9, storage_plugin=storage) as writer:
        unknown = writer.add_connection("/radar", "acme_msgs/msg/Blob", msgdef="acme_msgs/Secret[] inside\n",
                                        rihs01="RIHS01_0")
        writer.write(unknown, START_NS, bytes(20))
        write_topics(writer, DRIVE)
    check_drive(tmp_path / "drive")


def test_mcap_file_without_chunks_index_and_summary_is_read(tmp_path: Path) -> None:
    check_drive(write_mcap(tmp_path / "plain.mcap", use_chunking=False, index_types=IndexType.NONE,
                           use_summary_offsets=False, use_statistics=False, repeat_channels=False,
                           repeat_schemas=False))


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
def test_compressed_bag_is_read(tmp_path: Path, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "drive", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        write_topics(writer, DRIVE)
    check_drive(tmp_path / "drive")
    (file,) = (tmp_path / "drive").glob("*.db3*")
    file.write_bytes(file.read_bytes()[:20_000])
    with pytest.raises(RunError, match=r"drive: cannot be read as a bag .*; copy it again"):
        read_bag(tmp_path / "drive")


def test_topic_of_two_publishers_is_read_in_the_order_of_the_file(tmp_path: Path) -> None:
    file = write_mcap(tmp_path / "two.mcap", publishers=2)
    times = [time_ns for time_ns, _ in bag.open_bag(file).timed_messages("/ins/odometry")]
    assert times == [time_ns for time_ns, _ in DRIVE["/ins/odometry", ODOMETRY]]
    check_drive(file)


def test_unreadable_bags_are_rejected_with_the_reason(tmp_path: Path) -> None:
    complete = bag.list_bag_files(write_own(tmp_path / "drive", DRIVE))[0].read_bytes()
    for name, content, message in (
        ("empty.mcap", b"", "the file is empty"),
        ("text.mcap", b"not a bag at all" * 10, "cannot be read as a bag"),
        ("cut.mcap", complete[: len(complete) // 2], "cannot be read as a bag .*repair it with `st recover`"),
        ("text.db3", b"not a bag at all" * 10, "cannot be read as a bag"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RunError, match=f"{name}: {message}"):
            read_bag(tmp_path / name)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("unknown: 1\n")
    with pytest.raises(RunError, match="folder"):
        read_bag(tmp_path / "folder")


def test_layout_serialises_like_rosbags() -> None:
    layout = CdrLayout(STORE, ODOMETRY, STORE.deserialize_cdr(odometry_message(3)[1], ODOMETRY))
    yaw = 0.02 * np.arange(N)
    rows = layout.serialise(N, {
        "header.stamp": START_NS + np.arange(N) * 10_000_000, "pose.pose.position.x": 0.1 * np.arange(N),
        "pose.pose.position.y": -0.2 * np.arange(N), "twist.twist.linear.y": 0.01 * np.arange(N),
        "pose.pose.orientation.z": np.sin(yaw / 2), "pose.pose.orientation.w": np.cos(yaw / 2)})
    assert [row.tobytes() for row in rows] == [odometry_message(k)[1] for k in range(N)]


@pytest.mark.parametrize(("names", "path", "reason"), [
    (("drive.csv",), "drive.csv", "this is not a bag"),
    (("notes.md",), "", "contains no storage file of a bag"),
    (("a.mcap", "b.db3"), "", "storage files in two formats"),
])
def test_paths_without_a_bag_are_rejected_with_the_reason(tmp_path: Path, names: tuple[str, ...], path: str,
                                                         reason: str) -> None:
    for name in names:
        (tmp_path / name).write_text("x")
    with pytest.raises(RunError, match=reason):
        read_bag(tmp_path / path)
