"""Raw logs of the virtual Leaf through `st import`: the bag has the same data on one correct clock."""

import json
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bags import nanoseconds
from oxts_bridge import file_decoder
from rosbags.highlevel import AnyReader
from st_cli.cli import app
from st_core.vehicle import VehicleParameters
from st_recordings.bag_metadata import read_type_hash
from st_recordings.runs import LoadedRun, RunError, find_runs, read
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.cdr import load_typestore
from st_recordings.runs.frames import ERROR, EXTENDED, REMOTE
from st_sim.run import main as run_virtual_car
from support import LEAF, read_car
from typer.testing import CliRunner

OFFSET, DRIFT = 1.7, 30e-6  # s, 1: the clock of the logger is ahead of UTC and runs fast


def simulate_drive(folder: Path, *more: str, can_format: str = "mf4", duration: float = 60.0) -> Path:
    status = run_virtual_car([
        "--scenario", "S6", "--vehicle", str(LEAF), "--duration", str(duration), "--seed", "3", "--plant", "realistic",
        "--ncom-rate", "100", "--can-rate", "realistic", "--to-files", str(folder), "--can-format", can_format, *more,
    ])
    assert not status
    return folder


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_drive(tmp_path_factory.mktemp("raw") / "s6", "--effect", f"logger_clock_offset={OFFSET}",
                          "--effect", f"logger_clock_drift={DRIFT}")


@pytest.fixture(scope="module")
def imported(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("imported") / "s6"
    run = CliRunner().invoke(app, ["import", str(raw), "--output", str(folder)])
    assert run.exit_code == 0, run.output
    assert "times real time" in run.output
    return folder


@pytest.fixture(scope="module")
def leaf() -> VehicleParameters:
    return read_car("leaf")


def read_only_run(path: Path, vehicle: VehicleParameters | None = None) -> LoadedRun:
    (source,) = find_runs([path])
    return read(source, vehicle)


@pytest.fixture(scope="module")
def raw_run(raw: Path, leaf: VehicleParameters) -> LoadedRun:
    return read_only_run(raw, leaf)


@pytest.fixture(scope="module")
def bag_run(imported: Path, leaf: VehicleParameters) -> LoadedRun:
    return read_only_run(imported, leaf)


@pytest.fixture(scope="module")
def messages(imported: Path) -> list[tuple[str, int, Any]]:
    """(topic, log time [ns], message) of all messages of the bag."""
    with AnyReader([imported], default_typestore=load_typestore()) as reader:
        return [(connection.topic, log_ns, reader.deserialize(data, connection.msgtype))
                for connection, log_ns, data in reader.messages()]


@pytest.mark.slow
def test_clock_of_the_logger_is_estimated_from_time_frames(raw_run: LoadedRun) -> None:
    alignment = raw_run.alignment
    assert (alignment.method, alignment.verdict) == ("time frame", "good")
    assert alignment.drift_ppm == pytest.approx(-DRIFT * 1e6, abs=1.0)
    # The latency of the frames is 4 ms plus a queue; the reader assumes 2 +- 2 ms.
    assert alignment.offset_ns * 1e-9 == pytest.approx(-OFFSET, abs=3 * alignment.offset_deviation)


def test_alignment_by_shared_signals_agrees_with_the_time_frames(raw: Path, raw_run: LoadedRun, leaf: VehicleParameters,
                                                                 ) -> None:
    by_time = raw_run.alignment
    assert len(by_time.signals) == 3  # velocity, yaw rate and yaw, each of one message
    by_signals = read_only_run(without(raw, {0x600, 0x630}), leaf).alignment
    assert (by_signals.method, by_signals.verdict, len(by_signals.signals)) == ("shared signals", "good", 5)
    at = by_signals.at_ns
    assert by_signals.offset_at_ns(at) == pytest.approx(by_time.offset_at_ns(at), abs=2_000_000)


def without(raw: Path, identifiers: set[int]) -> Path:
    """The same run as candump text, without the messages of some identifiers."""
    folder = raw.parent / f"without_{'_'.join(map(str, sorted(identifiers)))}"
    folder.mkdir()
    shutil.copy(raw / "run.ncom", folder / "run.ncom")
    frames = read_can_logs([raw / "run.mf4"]).frames
    with (folder / "run.log").open("w") as stream:
        for k in np.nonzero(~np.isin(frames.id, list(identifiers)))[0]:
            seconds, nanoseconds = divmod(int(frames.time_ns[k]), 10**9)
            data = frames.payload[k, : frames.length[k]].tobytes().hex().upper()
            stream.write(f"({seconds}.{nanoseconds // 1000:06d}) can{frames.bus[k] - 1} {frames.id[k]:03X}#{data}\n")
    return folder


def test_log_of_the_bag_equals_that_of_the_raw_run(raw: Path, imported: Path, raw_run: LoadedRun,
                                                   bag_run: LoadedRun) -> None:
    assert [run.kind for run in find_runs([raw, imported])] == ["ncom", "bag"]
    before, after = raw_run.log, bag_run.log
    for name in ("ins_time_ns", "x", "y", "velocity_x", "velocity_y", "yaw_rate", "steering_time_ns",
                 "road_wheel_angle", "steering_wheel_angle"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)
    turns = np.round((after.yaw - before.yaw)[0] / (2 * np.pi))  # unwrapped angles may differ by whole turns
    np.testing.assert_allclose(after.yaw - before.yaw, turns * 2 * np.pi, atol=1e-12)
    # Without a vehicle file the road wheel angle is that of the import.
    np.testing.assert_array_equal(read_only_run(imported).log.road_wheel_angle, before.road_wheel_angle)


def test_auxiliary_signals_for_checks_are_in_raw_files_and_bag(raw_run: LoadedRun, bag_run: LoadedRun) -> None:
    for run in (raw_run, bag_run):
        log, auxiliary = run.log, run.auxiliary
        speed = np.interp(auxiliary.wheel_speed.time_ns, log.ins_time_ns, log.velocity_x)
        assert np.median(np.abs(auxiliary.wheel_speed.values - speed)) < 0.1
        speed = np.interp(auxiliary.ins_speed.time_ns, log.ins_time_ns, log.velocity_x)
        assert np.median(np.abs(auxiliary.ins_speed.values - speed)) < 0.02 and len(speed) > 5000
        assert set(auxiliary.stamps) == {"INS", "steering"} and len(auxiliary.stamps["INS"]) >= len(log.x)
        quality = auxiliary.quality
        assert (quality.navigation_status == 4).all() and len(quality.time_ns) >= len(log.x)
        assert np.nanmax(quality.position_mode) == 6 and 0 < np.nanmedian(quality.position_accuracy) < 0.1
        assert run.log.acceleration_y is None or not auxiliary.missing
    first, second = raw_run.auxiliary, bag_run.auxiliary
    common = np.isin(second.quality.time_ns, first.quality.time_ns)
    np.testing.assert_array_equal(second.quality.position_accuracy[common], first.quality.position_accuracy)
    np.testing.assert_array_equal(first.wheel_speed.values, second.wheel_speed.values)


def test_packets_with_invalid_acceleration_keep_their_other_values(raw: Path, raw_run: LoadedRun, tmp_path: Path,
                                                                   leaf: VehicleParameters) -> None:
    complete = raw_run.log
    folder = tmp_path / "holes"
    shutil.copytree(raw, folder)
    packets = np.frombuffer((raw / "run.ncom").read_bytes(), np.uint8).reshape(-1, 72).copy()
    packets[2000:2050, 6:9] = (0, 0, 0x80)  # code of an invalid acceleration y
    for at in (22, 61, 71):
        packets[:, at] = packets[:, 1:at].sum(axis=1, dtype=np.uint8)
    (folder / "run.ncom").write_bytes(packets.tobytes())
    run = read_only_run(folder, leaf)
    lost = np.isnan(run.log.acceleration_y)
    assert lost.sum() == run.auxiliary.missing["acceleration_y"] == 50
    np.testing.assert_array_equal(run.log.acceleration_y[~lost], complete.acceleration_y[~lost])
    np.testing.assert_array_equal(run.log.acceleration_x, complete.acceleration_x)
    assert any("acceleration_y: 50 of" in warning and "it is unknown there" in warning for warning in run.warnings)


def test_bag_of_a_run_with_corrections_and_labels_has_the_recorded_values_and_the_labels(
        raw: Path, bag_run: LoadedRun, leaf: VehicleParameters, tmp_path: Path) -> None:
    corrections = "correct: {yaw_rate: {earlier: 0.02}, x: {add: 3}}\n"
    for name in ("run.ncom", "run.mf4"):
        shutil.copy(raw / name, tmp_path / name)
    (tmp_path / "raw.run.yaml").write_text(
        "ins: run.ncom\ncan: run.mf4\nlabels: [{name: S6, start: 5, end: 30}]\n" + corrections)
    bag = tmp_path / "bag"
    run = CliRunner().invoke(app, ["import", str(tmp_path / "raw.run.yaml"), "--output", str(bag)])
    assert run.exit_code == 0 and "copy the corrections" in " ".join(run.output.split()), run.output
    of_bag = read_only_run(bag, leaf)
    np.testing.assert_array_equal(of_bag.log.x, bag_run.log.x)
    (label,) = of_bag.labels
    assert (label.name, label.start, label.end) == ("S6", 5, 30)
    (tmp_path / "bag.run.yaml").write_text("bag: bag\n" + corrections)
    corrected = read_only_run(tmp_path / "bag.run.yaml", leaf)
    np.testing.assert_allclose(corrected.log.x, bag_run.log.x[: len(corrected.log.x)] + 3.0)
    assert corrected.auxiliary.corrections == ("yaw_rate, 0.02 s earlier", "x + 3 m")
    np.testing.assert_array_equal(read_only_run(tmp_path / "raw.run.yaml", leaf).log.yaw_rate, corrected.log.yaw_rate)


@pytest.mark.slow
def test_bag_has_all_raw_packets_and_frames_with_the_time_of_the_ins(raw: Path, messages: list) -> None:
    log = read_can_logs([raw / "run.mf4"])
    frames, stream = [], b""
    for topic, log_ns, message in messages:
        if topic == "/ins/ncom":
            stream += message.raw_packet.tobytes()
        elif topic == "/can/frames":
            bus = int(message.header.frame_id[-1])
            frames += [(nanoseconds(f.stamp), bus, f) for f in message.frames]
        else:
            assert log_ns == nanoseconds(message.header.stamp)
    assert stream == (raw / "run.ncom").read_bytes()
    assert len(frames) == len(log.frames)
    frames.sort(key=lambda f: f[0])
    expected = log.frames.select(np.argsort(log.frames.time_ns, kind="stable"))
    found = sorted((bus, f.id, f.data.tobytes(), f.is_extended, f.is_error, f.is_remote) for _, bus, f in frames)
    assert found == sorted(
        (int(expected.bus[k]), int(expected.id[k]) & ~EXTENDED, expected.payload[k, : expected.length[k]].tobytes(),
         bool(expected.id[k] & EXTENDED), bool(expected.flags[k] & ERROR), bool(expected.flags[k] & REMOTE))
        for k in range(len(expected)))
    # Frames have the time of the INS: that of the logger minus its error.
    shift = np.array([t for t, _, _ in frames]) - expected.time_ns
    assert np.abs(shift * 1e-9 + OFFSET).max() < 0.02


def test_raw_packets_decode_to_the_odometry(messages: list) -> None:
    stream = b"".join(m.raw_packet.tobytes() for topic, _, m in messages if topic == "/ins/ncom")
    columns = file_decoder.decode_file(stream)
    odometry = [m for topic, _, m in messages if topic == "/ins/odometry"]
    speed = np.hypot(columns.velocity_ned[0], columns.velocity_ned[1])
    found = [np.hypot(m.twist.twist.linear.x, m.twist.twist.linear.y) for m in odometry]
    np.testing.assert_allclose(found, speed, atol=0.02)  # body axes and level axes differ by the small pitch angle
    assert odometry[0].header.frame_id == "map"
    assert odometry[0].child_frame_id == "ins_link"


def test_provenance_of_the_bag_has_files_vehicle_alignment_and_origin(raw: Path, imported: Path, bag_run: LoadedRun,
                                                                      leaf: VehicleParameters) -> None:
    records = bag_run.provenance["recorded"]
    assert set(records["files_sha256"]) == {str(raw / "run.ncom"), str(raw / "run.mf4")}
    assert records["import"]["vehicle_hash"] == leaf.hash
    assert float(records["alignment"]["offset_s"]) == pytest.approx(-OFFSET, abs=0.02)
    assert json.loads(records["import"]["map_origin"])["latitude_deg"] == pytest.approx(47.0, abs=15)
    assert (imported / "alignment.png").stat().st_size > 20_000


@pytest.mark.slow
def test_steering_with_wrong_sign_is_imported_only_by_force(raw: Path, tmp_path: Path) -> None:
    arguments = ["import", str(raw), "--steering-sign", "-1", "--output"]
    run = CliRunner().invoke(app, [*arguments, str(tmp_path / "a")])
    assert run.exit_code == 2 and "steering_sign" in run.output and "--force" in run.output
    assert not (tmp_path / "a").exists()
    forced = CliRunner().invoke(app, [*arguments, str(tmp_path / "b"), "--force"])
    assert forced.exit_code == 0 and "error: " in forced.output and "steering" in forced.output
    # The forced bag has the wrong sign, which every other verb reports.
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "b"), "--output", str(tmp_path / "c")])
    assert checked.exit_code == 1 and "steering_sign" in checked.output


def test_invalid_runs_do_not_prevent_the_import_of_others(raw: Path, tmp_path: Path) -> None:
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


@pytest.mark.slow
def test_ins_and_can_log_of_different_drives_are_rejected(raw: Path, tmp_path: Path, leaf: VehicleParameters) -> None:
    other = simulate_drive(tmp_path / "other", "--scenario", "S2", can_format="log", duration=30.0)
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    shutil.copy(raw / "run.ncom", mixed / "run.ncom")
    lines = (other / "run.log").read_text().splitlines(keepends=True)
    (mixed / "run.log").write_text("".join(line for line in lines if " 600#" not in line and " 630#" not in line))
    with pytest.raises(RunError, match=r"cannot be aligned .* not of the same drive.*; inspect the alignment"):
        read_only_run(mixed, leaf)
    run = CliRunner().invoke(app, ["import", str(mixed), "--output", str(tmp_path / "bag")])
    assert run.exit_code == 2
    assert not (tmp_path / "bag").exists()


def test_existing_bag_is_not_overwritten(imported: Path, raw: Path) -> None:
    run = CliRunner().invoke(app, ["import", str(raw), "--output", str(imported)])
    assert run.exit_code == 2
    assert "existing files are not overwritten" in run.output


@pytest.mark.ros
def test_installed_ros_types_deserialise_every_topic(imported: Path) -> None:
    """As in `ros2 bag play`; the type hashes equal those of the installed types."""
    serialization = pytest.importorskip("rclpy.serialization")
    information = yaml.safe_load((imported / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {t["topic_metadata"]["name"]: t["topic_metadata"] for t in information["topics_with_message_count"]}
    assert set(topics) == {"/ins/odometry", "/ins/ncom", "/vehicle/steering", "/vehicle/wheel_speeds", "/can/frames"}
    checked = set()
    with AnyReader([imported], default_typestore=load_typestore()) as reader:
        for connection, _, data in reader.messages():
            if connection.topic in checked:
                continue
            checked.add(connection.topic)
            assert topics[connection.topic]["type_description_hash"] == read_type_hash(connection.msgtype)
            package, _, name = connection.msgtype.split("/")
            message = serialization.deserialize_message(bytes(data), getattr(import_module(f"{package}.msg"), name))
            serialised = serialization.serialize_message(message)  # may differ in padding bytes
            assert repr(reader.deserialize(serialised, connection.msgtype)) == repr(
                reader.deserialize(data, connection.msgtype))
    assert checked == set(topics)
