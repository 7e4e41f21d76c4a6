"""Raw logs of the virtual Leaf through `st import`: what comes out is what went in, on one clock that is right."""

import json
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml
from oxts_bridge import file_decoder
from rosbags.highlevel import AnyReader
from st_cli.cli import app
from st_core.vehicle import VehicleParameters
from st_recordings.bag_metadata import read_type_hash
from st_recordings.runs import RunError, find_runs, read
from st_recordings.runs.bag import definitions_folder
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.cdr import load_typestore
from st_recordings.runs.frames import ERROR, EXTENDED, REMOTE
from st_sim.run import main as virtual_leaf
from support import ROOT
from typer.testing import CliRunner

OFFSET, DRIFT = 1.7, 30e-6  # the logger's clock is ahead of UTC and runs fast
LEAF = ROOT / "config/vehicle/leaf.yaml"


def drive(folder: Path, *more: str, can_format: str = "mf4", duration: float = 60.0) -> Path:
    status = virtual_leaf([
        "--scenario", "S6", "--vehicle", str(LEAF), "--duration", str(duration), "--seed", "3", "--plant", "realistic",
        "--ncom-rate", "100", "--can-rate", "realistic", "--to-files", str(folder), "--can-format", can_format, *more,
    ])
    assert not status
    return folder


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("raw") / "s6", "--effect", f"logger_clock_offset={OFFSET}", "--effect",
                 f"logger_clock_drift={DRIFT}")


@pytest.fixture(scope="module")
def imported(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("imported") / "s6"
    run = CliRunner().invoke(app, ["import", str(raw), "--output", str(folder)])
    assert run.exit_code == 0, run.output
    assert "times real time" in run.output
    return folder


@pytest.fixture(scope="module")
def leaf() -> VehicleParameters:
    return VehicleParameters.from_yaml(LEAF.read_text(), str(LEAF))


def test_the_clock_is_found(raw: Path, leaf: VehicleParameters) -> None:
    (source,) = find_runs([raw])
    alignment = read(source, leaf).alignment
    assert (alignment.method, alignment.verdict) == ("time frame", "good")
    assert alignment.drift_ppm == pytest.approx(-DRIFT * 1e6, abs=1.0)
    # The unit's frames come 4 ms and a queue late, of which the reader assumes 2 +- 2 ms.
    assert alignment.offset_ns * 1e-9 == pytest.approx(-OFFSET, abs=3 * alignment.offset_deviation)


def test_shared_signals_agree_with_the_time_frames(raw: Path, leaf: VehicleParameters) -> None:
    """The log without the INS's time frames is aligned by its signals, to the same."""
    (source,) = find_runs([raw])
    by_time = read(source, leaf).alignment
    assert len(by_time.signals) == 3  # velocity, yaw rate and yaw, each of one message
    (cut,) = find_runs([without(raw, {0x600, 0x630})])
    by_signals = read(cut, leaf).alignment
    assert (by_signals.method, by_signals.verdict, len(by_signals.signals)) == ("shared signals", "good", 5)
    at = by_signals.at_ns
    assert by_signals.offset_at_ns(at) == pytest.approx(by_time.offset_at_ns(at), abs=2_000_000)


def without(raw: Path, identifiers: set[int]) -> Path:
    """The same run as candump text, without some messages."""
    folder = raw.parent / f"without_{'_'.join(map(str, sorted(identifiers)))}"
    folder.mkdir()
    shutil.copy(raw / "run.ncom", folder / "run.ncom")
    frames = read_can_logs([raw / "run.mf4"]).frames
    with (folder / "run.log").open("w") as stream:
        for k in np.nonzero(~np.isin(frames.id, list(identifiers)))[0]:
            seconds, rest = divmod(int(frames.time_ns[k]), 10**9)
            data = frames.payload[k, : frames.length[k]].tobytes().hex().upper()
            stream.write(f"({seconds}.{rest // 1000:06d}) can{frames.bus[k] - 1} {frames.id[k]:03X}#{data}\n")
    return folder


def test_the_bag_reads_as_the_raw_run(raw: Path, imported: Path, leaf: VehicleParameters) -> None:
    (source,), (bag,) = find_runs([raw]), find_runs([imported])
    assert (source.kind, bag.kind) == ("ncom", "bag")
    before, after = read(source, leaf).log, read(bag, leaf).log
    for name in ("ins_time_ns", "x", "y", "velocity_x", "velocity_y", "yaw_rate", "steering_time_ns",
                 "road_wheel_angle", "steering_wheel_angle"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    turns = np.round((after.yaw - before.yaw)[0] / (2 * np.pi))  # an unwrapped angle may start a whole turn away
    np.testing.assert_allclose(after.yaw - before.yaw, turns * 2 * np.pi, atol=1e-12)
    # Without a vehicle the road wheel angle is the one written down at import.
    np.testing.assert_array_equal(read(bag).log.road_wheel_angle, before.road_wheel_angle)


def test_what_checks_may_use_is_in_raw_files_and_bag_alike(raw: Path, imported: Path, leaf: VehicleParameters) -> None:
    (source,), (bag,) = find_runs([raw]), find_runs([imported])
    runs = read(source, leaf), read(bag, leaf)
    for run in runs:
        log, extras = run.log, run.auxiliary
        speed = np.interp(extras.wheel_speed.time_ns, log.ins_time_ns, log.velocity_x)
        assert np.median(np.abs(extras.wheel_speed.values - speed)) < 0.1
        speed = np.interp(extras.ins_speed.time_ns, log.ins_time_ns, log.velocity_x)
        assert np.median(np.abs(extras.ins_speed.values - speed)) < 0.02 and len(speed) > 5000
        assert set(extras.stamps) == {"INS", "steering"} and len(extras.stamps["INS"]) >= len(log.x)
        quality = extras.quality
        assert (quality.navigation_status == 4).all() and len(quality.time_ns) >= len(log.x)
        assert np.nanmax(quality.position_mode) == 6 and 0 < np.nanmedian(quality.position_accuracy) < 0.1
        assert 0 < np.nanmedian(quality.heading_accuracy) < 0.01
        assert run.log.acceleration_y is None or not extras.missing
    first, second = (run.auxiliary.quality for run in runs)
    there = np.isin(second.time_ns, first.time_ns)
    np.testing.assert_array_equal(second.position_accuracy[there], first.position_accuracy)
    np.testing.assert_array_equal(runs[0].auxiliary.wheel_speed.values, runs[1].auxiliary.wheel_speed.values)


def test_packets_without_an_acceleration_cost_that_only(raw: Path, tmp_path: Path, leaf: VehicleParameters) -> None:
    whole = read(find_runs([raw])[0], leaf).log
    folder = tmp_path / "holes"
    shutil.copytree(raw, folder)
    packets = np.frombuffer((raw / "run.ncom").read_bytes(), np.uint8).reshape(-1, 72).copy()
    packets[2000:2050, 6:9] = (0, 0, 0x80)  # the mark for "invalid" in acceleration y
    for at in (22, 61, 71):
        packets[:, at] = packets[:, 1:at].sum(axis=1, dtype=np.uint8)
    (folder / "run.ncom").write_bytes(packets.tobytes())
    (source,) = find_runs([folder])
    run = read(source, leaf)
    lost = np.isnan(run.log.acceleration_y)
    assert lost.sum() == run.auxiliary.missing["acceleration_y"] == 50
    np.testing.assert_array_equal(run.log.acceleration_y[~lost], whole.acceleration_y[~lost])
    np.testing.assert_array_equal(run.log.acceleration_x, whole.acceleration_x)
    assert any("acceleration_y: 50 of" in warning and "it is unknown there" in warning for warning in run.warnings)


def test_the_bag_of_a_corrected_run_holds_what_was_recorded(raw: Path, imported: Path, leaf: VehicleParameters,
                                                            tmp_path: Path) -> None:
    said = "correct: {yaw_rate: {earlier: 0.02}, x: {add: 3}}\n"
    for name in ("run.ncom", "run.mf4"):
        shutil.copy(raw / name, tmp_path / name)
    (tmp_path / "raw.run.yaml").write_text("ins: run.ncom\ncan: run.mf4\n" + said)
    bag = tmp_path / "bag"
    run = CliRunner().invoke(app, ["import", str(tmp_path / "raw.run.yaml"), "--output", str(bag)])
    assert run.exit_code == 0 and "copy the corrections" in " ".join(run.output.split()), run.output
    recorded = read(find_runs([imported])[0], leaf).log
    np.testing.assert_array_equal(read(find_runs([bag])[0], leaf).log.x, recorded.x)
    (tmp_path / "bag.run.yaml").write_text("bag: bag\n" + said)
    (source,) = find_runs([tmp_path / "bag.run.yaml"])
    corrected = read(source, leaf)
    np.testing.assert_allclose(corrected.log.x, recorded.x[: len(corrected.log.x)] + 3.0)
    assert corrected.auxiliary.corrected == ("yaw_rate, 0.02 s earlier", "x + 3 m")
    (source,) = find_runs([tmp_path / "raw.run.yaml"])
    np.testing.assert_array_equal(read(source, leaf).log.yaw_rate, corrected.log.yaw_rate)


def test_raw_packets_and_frames_are_kept(raw: Path, imported: Path) -> None:
    packets = (raw / "run.ncom").read_bytes()
    log = read_can_logs([raw / "run.mf4"])
    frames, stream, stamps = [], b"", []
    with AnyReader([imported], default_typestore=load_typestore(definitions_folder())) as reader:
        for connection, log_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/ins/ncom":
                stream += message.raw_packet.tobytes()
            elif connection.topic == "/can/frames":
                bus = int(message.header.frame_id[-1])
                frames += [(f.stamp.sec * 10**9 + f.stamp.nanosec, bus, f) for f in message.frames]
            else:
                stamps.append((log_ns, message.header.stamp.sec * 10**9 + message.header.stamp.nanosec))
    assert stream == packets
    assert all(log_ns == stamp for log_ns, stamp in stamps)
    assert len(frames) == len(log.frames)
    frames.sort(key=lambda f: f[0])
    wanted = log.frames.select(np.argsort(log.frames.time_ns, kind="stable"))
    found = sorted((bus, f.id, f.data.tobytes(), f.is_extended, f.is_error, f.is_remote) for _, bus, f in frames)
    assert found == sorted(
        (int(wanted.bus[k]), int(wanted.id[k]) & ~EXTENDED, wanted.payload[k, : wanted.length[k]].tobytes(),
         bool(wanted.id[k] & EXTENDED), bool(wanted.flags[k] & ERROR), bool(wanted.flags[k] & REMOTE))
        for k in range(len(wanted)))
    # One time base: frames carry the INS's time, which is the logger's minus its error.
    shift = np.array([t for t, _, _ in frames]) - wanted.time_ns
    assert np.abs(shift * 1e-9 + OFFSET).max() < 0.02


def test_raw_packets_decode_to_the_odometry(imported: Path) -> None:
    stream, odometry = b"", []
    with AnyReader([imported], default_typestore=load_typestore(definitions_folder())) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype) if connection.topic.startswith("/ins") else None
            if connection.topic == "/ins/ncom":
                stream += message.raw_packet.tobytes()
            elif connection.topic == "/ins/odometry":
                odometry.append(message)
    columns = file_decoder.decode_file(stream)
    speed = np.hypot(columns.velocity_ned[0], columns.velocity_ned[1])
    found = [np.hypot(m.twist.twist.linear.x, m.twist.twist.linear.y) for m in odometry]
    np.testing.assert_allclose(found, speed, atol=0.02)  # body axes against level: the car pitches a little
    assert odometry[0].header.frame_id == "map"
    assert odometry[0].child_frame_id == "ins_link"


def test_where_it_came_from_is_written_down(raw: Path, imported: Path, leaf: VehicleParameters) -> None:
    (bag,) = find_runs([imported])
    about = read(bag, leaf).provenance
    records = about["recorded"]
    assert set(records["files_sha256"]) == {str(raw / "run.ncom"), str(raw / "run.mf4")}
    assert records["import"]["vehicle_hash"] == leaf.hash
    assert float(records["alignment"]["offset_s"]) == pytest.approx(-OFFSET, abs=0.02)
    assert json.loads(records["import"]["map_origin"])["latitude_deg"] == pytest.approx(47.0, abs=15)
    assert (imported / "alignment.png").stat().st_size > 20_000


def test_a_steering_that_counts_the_other_way_is_not_imported(raw: Path, tmp_path: Path) -> None:
    arguments = ["import", str(raw), "--steering-sign", "-1", "--output"]
    run = CliRunner().invoke(app, [*arguments, str(tmp_path / "a")])
    assert run.exit_code == 2 and "steering_sign" in run.output and "--force" in run.output
    assert not (tmp_path / "a").exists()
    forced = CliRunner().invoke(app, [*arguments, str(tmp_path / "b"), "--force"])
    assert forced.exit_code == 0 and "error: " in forced.output and "steering" in forced.output
    # What was written is what was asked for, and every other verb sees what is wrong with it.
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "b"), "--output", str(tmp_path / "c")])
    assert checked.exit_code == 1 and "steering_sign" in checked.output


def test_labels_travel_with_the_bag(raw: Path, tmp_path: Path, leaf: VehicleParameters) -> None:
    text = "ins: run.ncom\ncan: run.mf4\nlabels: [{name: S6, start: 5, end: 30}]\n"
    for name in ("run.ncom", "run.mf4"):
        shutil.copy(raw / name, tmp_path / name)
    (tmp_path / "run.yaml").write_text(text)
    run = CliRunner().invoke(app, ["import", str(tmp_path / "run.yaml"), "--output", str(tmp_path / "bag")])
    assert run.exit_code == 0, run.output
    (label,) = read(find_runs([tmp_path / "bag"])[0], leaf).labels
    assert (label.name, label.start, label.end) == ("S6", 5, 30)


def test_one_bad_run_does_not_stop_the_others(raw: Path, tmp_path: Path) -> None:
    folder = tmp_path / "week"
    for name, ncom in (("good", (raw / "run.ncom").read_bytes()), ("empty", b""), ("wrong", b"hello\n")):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}.ncom").write_bytes(ncom)
        shutil.copy(raw / "run.mf4", folder / name / f"{name}.mf4")
    run = CliRunner().invoke(app, ["import", str(folder), "--output", str(tmp_path / "bags")])
    assert run.exit_code == 1
    assert "empty.ncom: the file is empty" in run.output
    assert "wrong.ncom: no NCOM packet" in run.output
    assert [f.name for f in (tmp_path / "bags").iterdir()] == ["good"]


def test_logs_of_different_drives_are_refused(raw: Path, tmp_path: Path, leaf: VehicleParameters) -> None:
    other = drive(tmp_path / "other", "--scenario", "S2", can_format="log")
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    shutil.copy(raw / "run.ncom", mixed / "run.ncom")
    lines = (other / "run.log").read_text().splitlines(keepends=True)
    (mixed / "run.log").write_text("".join(line for line in lines if " 600#" not in line and " 630#" not in line))
    (source,) = find_runs([mixed])
    with pytest.raises(RunError, match=r"cannot be aligned .* not of the same drive.*; inspect the alignment"):
        read(source, leaf)
    run = CliRunner().invoke(app, ["import", str(mixed), "--output", str(tmp_path / "bag")])
    assert run.exit_code == 2
    assert not (tmp_path / "bag").exists()


def test_nothing_is_overwritten(imported: Path, raw: Path) -> None:
    run = CliRunner().invoke(app, ["import", str(raw), "--output", str(imported)])
    assert run.exit_code == 2
    assert "existing files are not overwritten" in run.output


@pytest.mark.ros
def test_ros_takes_every_message_and_knows_the_types(imported: Path) -> None:
    """What `ros2 bag play` does with the bag: hand the bytes to publishers of the installed types, by hash the same."""
    serialization = pytest.importorskip("rclpy.serialization")
    about = yaml.safe_load((imported / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {t["topic_metadata"]["name"]: t["topic_metadata"] for t in about["topics_with_message_count"]}
    assert set(topics) == {"/ins/odometry", "/ins/ncom", "/vehicle/steering", "/vehicle/wheel_speeds", "/can/frames"}
    seen = set()
    with AnyReader([imported], default_typestore=load_typestore(definitions_folder())) as reader:
        for connection, _, data in reader.messages():
            if connection.topic in seen:
                continue
            seen.add(connection.topic)
            assert topics[connection.topic]["type_description_hash"] == read_type_hash(connection.msgtype)
            package, _, name = connection.msgtype.split("/")
            message = serialization.deserialize_message(bytes(data), getattr(import_module(f"{package}.msg"), name))
            again = serialization.serialize_message(message)  # bytes between the fields are whatever lay there
            assert repr(reader.deserialize(again, connection.msgtype)) == repr(
                reader.deserialize(data, connection.msgtype))
    assert seen == set(topics)
