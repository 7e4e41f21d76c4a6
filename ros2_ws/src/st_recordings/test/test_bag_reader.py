"""Bags: the quick way reads what rosbags reads, of both storages; foreign topics are passed over; bad bags say why."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from oxts_bridge.channels import encode_channel
from oxts_bridge.ncom import Packet, encode
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from st_recordings.mcap import BagWriter
from st_recordings.runs import bag, find_runs, read
from st_recordings.runs.bag import ODOMETRY, STEERING, definitions_folder, read_bag
from st_recordings.runs.bag_storage import McapStorage, SqliteStorage
from st_recordings.runs.cdr import INS_ON_CAN, INS_STATUS, NCOM, WHEEL_SPEEDS, Layout, load_typestore
from st_recordings.runs.errors import RunError

STORE = load_typestore(definitions_folder())
START_NS = 1_700_000_000_123_456_789
N = 500


def make(name: str, **values: Any) -> Any:
    return STORE.types[name](**values)


def header(time_ns: int, frame: str = "map") -> Any:
    sec, nanosec = divmod(time_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def odometry(k: int, frame: str = "map") -> tuple[int, bytes]:
    time_ns = START_NS + k * 10_000_000
    yaw = 0.02 * k
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    pose = make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=0.1 * k, y=-0.2 * k, z=1.0),
                orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2)))
    linear = make("geometry_msgs/msg/Vector3", **{**zero, "x": 10.0, "y": 0.01 * k})
    twist = make("geometry_msgs/msg/Twist", linear=linear,
                 angular=make("geometry_msgs/msg/Vector3", **{**zero, "z": 0.3}))
    message = make(ODOMETRY, header=header(time_ns, frame), child_frame_id="ins_link",
                   pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                   twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)))
    return time_ns, bytes(STORE.serialize_cdr(message, ODOMETRY))


def steering(k: int, valid: bool = True) -> tuple[int, bytes]:
    time_ns = START_NS + 2_000_000 + k * 10_000_000
    message = make(STEERING, header=header(time_ns, ""), steering_wheel_angle=0.01 * k, road_wheel_angle=0.001 * k,
                   valid=valid)
    return time_ns, bytes(STORE.serialize_cdr(message, STEERING))


def text(k: int) -> tuple[int, bytes]:
    name = "std_msgs/msg/String"
    return START_NS + k * 10**9, bytes(STORE.serialize_cdr(make(name, data="x" * k), name))


Topics = dict[tuple[str, str], Sequence[tuple[int, bytes]]]
OURS: Topics = {("/ins/odometry", ODOMETRY): [odometry(k) for k in range(N)],
                ("/vehicle/steering", STEERING): [steering(k) for k in range(N)],
                ("/notes", "std_msgs/msg/String"): [text(k) for k in range(3)]}


def write_ours(folder: Path, topics: Topics) -> Path:
    writer = BagWriter(folder)
    for (topic, name), messages in topics.items():
        number = writer.add_topic(topic, name, definition=STORE.generate_msgdef(name, ros_version=2)[0],
                                  type_hash=STORE.hash_rihs01(name))
        for time_ns, data in messages:
            writer.write(number, data, time_ns)
    writer.close()
    return folder


def write_rosbags(folder: Path, topics: Topics, storage: StoragePlugin) -> Path:
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        for (topic, name), messages in topics.items():
            connection = writer.add_connection(topic, name, typestore=STORE)
            for time_ns, data in messages:
                writer.write(connection, time_ns, data)
    return folder


def check(path: Path) -> None:
    log = read_bag(path).log
    k = np.arange(N)
    assert np.array_equal(log.ins_time_ns, START_NS + k * 10_000_000)
    assert np.array_equal(log.steering_time_ns, START_NS + 2_000_000 + k * 10_000_000)
    np.testing.assert_array_equal(log.x, 0.1 * k)
    np.testing.assert_array_equal(log.velocity_y, 0.01 * k)
    np.testing.assert_allclose(log.yaw, 0.02 * k, atol=1e-9)
    np.testing.assert_array_equal(log.road_wheel_angle, 0.001 * k)
    np.testing.assert_array_equal(log.steering_wheel_angle, 0.01 * k)


@pytest.mark.parametrize("storage", ["ours", "mcap", "sqlite3"])
def test_a_bag_of_any_recorder(tmp_path: Path, storage: str) -> None:
    folder = tmp_path / "drive"
    if storage == "ours":
        write_ours(folder, OURS)
    else:
        write_rosbags(folder, OURS, StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3)
    check(folder)
    (file,) = bag.storage_files(folder)
    check(file)
    alone = tmp_path / f"alone{file.suffix}"  # a storage file without its metadata.yaml
    alone.write_bytes(file.read_bytes())
    check(alone)


@pytest.mark.parametrize("kind", [McapStorage, SqliteStorage])
def test_the_quick_way_is_the_way_taken_and_equal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    folder = tmp_path / "drive"
    if kind is McapStorage:
        write_ours(folder, OURS)
    else:
        write_rosbags(folder, OURS, StoragePlugin.SQLITE3)
    with monkeypatch.context() as patch:
        patch.delattr(bag, "_read_one_by_one")
        quick = read_bag(folder).log
    monkeypatch.setattr(kind, "columns", lambda *_: {})
    slow = read_bag(folder).log
    for name in ("ins_time_ns", "x", "y", "yaw", "velocity_x", "yaw_rate", "steering_time_ns", "road_wheel_angle"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(slow, name))


def test_frame_ids_that_change_fall_back_to_the_slow_way(tmp_path: Path) -> None:
    mixed = [odometry(k, "map" if k % 2 else "earth") for k in range(N)]
    check(write_ours(tmp_path / "drive", {**OURS, ("/ins/odometry", ODOMETRY): mixed}))


def test_unusable_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [steering(k, valid=k % 10 != 0) for k in range(N)]
    messages[55] = messages[54]
    drive = read_bag(write_ours(tmp_path / "drive", {**OURS, ("/vehicle/steering", STEERING): messages}))
    assert len(drive.log.steering_time_ns) == N - 51
    assert any(f"50 of {N} steering messages (10 %) have no usable value" in w for w in drive.warnings)
    assert drive.auxiliary.missing == {"road_wheel_angle": 50} and len(drive.auxiliary.stamps["steering"]) == N
    assert any("steering messages (0.22 %) are not later" in w for w in drive.warnings)


def test_a_bag_whose_odometry_lacks_a_value_is_refused_with_its_name(tmp_path: Path) -> None:
    def without(k: int) -> tuple[int, bytes]:
        time_ns, data = odometry(k)
        message = STORE.deserialize_cdr(data, ODOMETRY)
        message.twist.twist.linear.y = float("nan")
        return time_ns, bytes(STORE.serialize_cdr(message, ODOMETRY))

    folder = write_ours(tmp_path / "drive", {**OURS, ("/ins/odometry", ODOMETRY): [without(k) for k in range(N)]})
    with pytest.raises(RunError, match=rf"fewer than two measurements .*{N} of {N} odometry messages \(100 %\) have no "
                       "usable value of velocity_y"):
        read(find_runs([folder])[0])


def test_compressed_messages_without_metadata_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for (topic, kind), messages in OURS.items():
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for time_ns, data in messages:
                writer.write(connection, time_ns, zstandard.compress(data))
    (folder / "metadata.yaml").unlink()
    check(next(folder.glob("*.db3")))


def test_messages_that_are_sent_several_times_keep_their_stamps(tmp_path: Path) -> None:
    sent = [(time_ns + part * 1_000_000, data) for time_ns, data in OURS["/ins/odometry", ODOMETRY]
            for part in range(6)]
    check(write_ours(tmp_path / "drive", {**OURS, ("/ins/odometry", ODOMETRY): sent}))


def wheels(k: int, front: bool, valid: bool = True) -> tuple[int, bytes]:
    """Each axle has a frame of its own; what is not in a frame is NaN."""
    time_ns = START_NS + k * 20_000_000
    nan = float("nan")
    message = make(WHEEL_SPEEDS, header=header(time_ns, ""), front_left=20.0 if front else nan,
                   front_right=21.0 if front else nan, rear_left=nan if front else 9.0 + 0.01 * k,
                   rear_right=nan if front else 11.0 + 0.01 * k, vehicle_speed=12.0 if front else nan, valid=valid)
    return time_ns, bytes(STORE.serialize_cdr(message, WHEEL_SPEEDS))


def ins_on_can(k: int) -> tuple[int, bytes]:
    time_ns = START_NS + k * 10_000_000
    message = make(INS_ON_CAN, header=header(time_ns, ""), velocity_x=float("nan") if k % 2 else 10.0, velocity_y=0.0,
                   yaw=0.0, yaw_rate=0.0, unix_time=0.0)
    return time_ns, bytes(STORE.serialize_cdr(message, INS_ON_CAN))


def status(k: int) -> tuple[int, bytes]:
    time_ns = START_NS + k * 10**9
    numbers = dict.fromkeys((name for name, _ in STORE.fielddefs[INS_STATUS][1]), 0)
    numbers |= {name: name * (k % 3) for name in numbers if name.endswith("text") or name == "firmware"}
    numbers |= {name: float(0) for name, (_, kind) in STORE.fielddefs[INS_STATUS][1] if kind and kind[0] == "float64"}
    message = make(INS_STATUS, **{**numbers, "header": header(time_ns, ""), "navigation_status": 4, "position_mode": 6,
                                  "position_accuracy_north": 0.03, "position_accuracy_east": 0.04,
                                  "heading_accuracy": 0.001 * k, "antenna_lever_arm": np.zeros(3),
                                  "seen_channels": np.arange(k, dtype=np.uint32)})
    return time_ns, bytes(STORE.serialize_cdr(message, INS_STATUS))


AXLES = [wheels(k, front) for k in range(50) for front in (True, False)]
OTHERS: Topics = {("/vehicle/wheel_speeds", WHEEL_SPEEDS): AXLES,
                  ("/vehicle/ins_on_can", INS_ON_CAN): [ins_on_can(k) for k in range(N)],
                  ("/ins/status", INS_STATUS): [status(k) for k in range(5)]}


@pytest.mark.parametrize("storage", ["ours", "sqlite3"])
def test_what_checks_may_use(tmp_path: Path, storage: str) -> None:
    if storage == "ours":
        write_ours(tmp_path / "drive", {**OURS, **OTHERS})
    else:
        write_rosbags(tmp_path / "drive", {**OURS, **OTHERS}, StoragePlugin.SQLITE3)
    check(tmp_path / "drive")
    extras = read_bag(tmp_path / "drive").auxiliary
    np.testing.assert_allclose(extras.wheel_speed.values, 10.0 + 0.01 * np.arange(50))
    np.testing.assert_array_equal(extras.wheel_speed.time_ns, START_NS + 20_000_000 * np.arange(50))
    assert (extras.ins_speed.values == 10.0).all() and len(extras.ins_speed.values) == N // 2
    quality = extras.quality
    np.testing.assert_array_equal(quality.time_ns, START_NS + 10**9 * np.arange(5))
    np.testing.assert_allclose(quality.heading_accuracy, 0.001 * np.arange(5))
    assert set(quality.navigation_status) == {4} and set(quality.position_mode) == {6}
    np.testing.assert_allclose(quality.position_accuracy, 0.05)
    assert [len(extras.stamps[name]) for name in ("INS", "steering")] == [N, N] and extras.missing == {}


def test_packets_say_what_no_other_topic_does(tmp_path: Path) -> None:
    """Driving east at 8 m/s; the accuracies come with packet 10."""
    messages = []
    for k in range(100):
        channel, batch = (3, encode_channel(3, {"NorthAcc": 0.3, "EastAcc": 0.4, "AltAcc": 1.0})) if k == 10 else (
            0, (23_000_000).to_bytes(4, "little") + bytes((12, 5, 5, 5)))
        packet = encode(Packet(
            milliseconds=10 * k, acceleration=(0.0, 0.0, -9.81), angular_rate=(0.0, 0.0, 0.0), navigation_status=4,
            latitude=0.8, longitude=0.3, altitude=100.0, velocity_ned=(0.0, 8.0, 0.0), heading=np.pi / 2, pitch=0.0,
            roll=0.0, channel=channel, batch_s=batch))
        message = make(NCOM, header=header(START_NS, ""), raw_packet=np.frombuffer(packet, np.uint8))
        messages.append((START_NS + 10_000_000 * k, bytes(STORE.serialize_cdr(message, NCOM))))
    extras = read_bag(write_ours(tmp_path / "drive", {**OURS, ("/ins/ncom", NCOM): messages})).auxiliary
    np.testing.assert_allclose(extras.ins_speed.values, np.full(100, 8.0), atol=1e-4)
    np.testing.assert_array_equal(extras.quality.time_ns, extras.ins_speed.time_ns)
    assert np.diff(extras.ins_speed.time_ns).tolist() == [10_000_000] * 99
    assert np.isnan(extras.quality.position_accuracy[:10]).all() and np.isnan(extras.quality.heading_accuracy).all()
    np.testing.assert_allclose(extras.quality.position_accuracy[10:], 0.5)
    assert set(extras.quality.position_mode) == {5.0}


def test_a_bag_is_no_worse_for_other_topics_that_are_damaged(tmp_path: Path) -> None:
    bad = {key: [(time_ns, data[: len(data) // 3]) for time_ns, data in messages] for key, messages in OTHERS.items()}
    bad["/ins/ncom", NCOM] = [(START_NS, b"\0\1")]
    check(write_ours(tmp_path / "drive", {**OURS, **bad}))
    extras = read_bag(tmp_path / "drive").auxiliary
    assert extras.wheel_speed is None and extras.ins_speed is None and extras.quality is None


def test_missing_topics_and_doubles_are_named(tmp_path: Path) -> None:
    odometry_only = {key: m for key, m in OURS.items() if key[1] != STEERING}
    with pytest.raises(RunError, match=r"it contains no message of type st_msgs/msg/Steering; recorded: /ins/odometry"):
        read_bag(write_ours(tmp_path / "one", odometry_only))
    doubled = {**{key: m for key, m in OURS.items() if key[1] == STEERING},
               ("/a", ODOMETRY): OURS["/ins/odometry", ODOMETRY], ("/b", ODOMETRY): OURS["/ins/odometry", ODOMETRY]}
    with pytest.raises(RunError, match="several topics are of type nav_msgs/msg/Odometry: /a, /b"):
        read_bag(write_ours(tmp_path / "two", doubled))
    named = {**OURS, ("/other/odometry", ODOMETRY): [odometry(k, "elsewhere") for k in range(5)]}
    check(write_ours(tmp_path / "three", named))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_types_nobody_here_knows_are_passed_over(tmp_path: Path, storage: StoragePlugin) -> None:
    with Writer(tmp_path / "drive", version=9, storage_plugin=storage) as writer:
        foreign = writer.add_connection("/radar", "acme_msgs/msg/Blob", msgdef="acme_msgs/Secret[] inside\n",
                                        rihs01="RIHS01_0")
        writer.write(foreign, START_NS, bytes(20))
        for (topic, name), messages in OURS.items():
            connection = writer.add_connection(topic, name, typestore=STORE)
            for time_ns, data in messages:
                writer.write(connection, time_ns, data)
    check(tmp_path / "drive")


def test_files_without_an_index_and_compressed_bags(tmp_path: Path) -> None:
    plain = tmp_path / "plain.mcap"
    with plain.open("wb") as stream:
        writer = McapWriter(stream, use_chunking=False, index_types=IndexType.NONE, use_summary_offsets=False,
                            use_statistics=False, repeat_channels=False, repeat_schemas=False)
        writer.start(profile="ros2")
        for (topic, name), messages in OURS.items():
            schema = writer.register_schema(name, "ros2msg", STORE.generate_msgdef(name, ros_version=2)[0].encode())
            channel = writer.register_channel(topic, "cdr", schema)
            for time_ns, data in messages:
                writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    check(plain)
    for mode in (CompressionMode.MESSAGE, CompressionMode.FILE):
        packed = Writer(tmp_path / mode.name, version=9, storage_plugin=StoragePlugin.SQLITE3)
        packed.set_compression(mode, CompressionFormat.ZSTD)
        with packed:
            for (topic, name), messages in OURS.items():
                connection = packed.add_connection(topic, name, typestore=STORE)
                for time_ns, data in messages:
                    packed.write(connection, time_ns, data)
        check(tmp_path / mode.name)


def test_a_topic_of_two_publishers_is_read_in_the_order_of_the_file(tmp_path: Path) -> None:
    with (tmp_path / "two.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        for (topic, name), messages in OURS.items():
            schema = writer.register_schema(name, "ros2msg", STORE.generate_msgdef(name, ros_version=2)[0].encode())
            channels = [writer.register_channel(topic, "cdr", schema, {"publisher": str(k)}) for k in range(2)]
            for k, (time_ns, data) in enumerate(messages):
                writer.add_message(channels[k % 2], time_ns, data, time_ns)
        writer.finish()
    times = [time_ns for time_ns, _ in bag.open_bag(tmp_path / "two.mcap").timed_messages("/ins/odometry")]
    assert times == [time_ns for time_ns, _ in OURS["/ins/odometry", ODOMETRY]]
    check(tmp_path / "two.mcap")


def test_bags_that_are_none(tmp_path: Path) -> None:
    whole = bag.storage_files(write_ours(tmp_path / "drive", OURS))[0].read_bytes()
    for name, content, message in (
        ("empty.mcap", b"", "the file is empty"),
        ("text.mcap", b"not a bag at all" * 10, "cannot be read as a bag"),
        ("cut.mcap", whole[: len(whole) // 2], "cannot be read as a bag .*repair it with `st recover`"),
        ("text.db3", b"not a bag at all" * 10, "cannot be read as a bag"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RunError, match=f"{name}: {message}"):
            read_bag(tmp_path / name)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("nonsense: 1\n")
    with pytest.raises(RunError, match="folder"):
        read_bag(tmp_path / "folder")


def test_a_layout_serialises_as_rosbags_does() -> None:
    layout = Layout(STORE, ODOMETRY, STORE.deserialize_cdr(odometry(3)[1], ODOMETRY))
    yaw = 0.02 * np.arange(N)
    rows = layout.rows(N, {
        "header.stamp": START_NS + np.arange(N) * 10_000_000, "pose.pose.position.x": 0.1 * np.arange(N),
        "pose.pose.position.y": -0.2 * np.arange(N), "twist.twist.linear.y": 0.01 * np.arange(N),
        "pose.pose.orientation.z": np.sin(yaw / 2), "pose.pose.orientation.w": np.cos(yaw / 2)})
    assert [row.tobytes() for row in rows] == [odometry(k)[1] for k in range(N)]


@pytest.mark.parametrize(("names", "path", "reason"), [
    (("drive.csv",), "drive.csv", "this is not a bag"),
    (("notes.md",), "", "contains no storage file of a bag"),
    (("a.mcap", "b.db3"), "", "storage files of both kinds"),
])
def test_paths_that_are_no_bag_are_refused_with_the_reason(tmp_path: Path, names: tuple[str, ...], path: str,
                                                           reason: str) -> None:
    for name in names:
        (tmp_path / name).write_text("x")
    with pytest.raises(RunError, match=reason):
        read_bag(tmp_path / path)
