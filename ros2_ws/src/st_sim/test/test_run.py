"""The program virtual_leaf: files, sockets, signals, wrong arguments."""

import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from canedge_bridge.decode import Decoder
from canedge_bridge.transport import open_bus
from mcap.reader import make_reader
from oxts_bridge.stream import NcomParser
from st_sim import run
from support import LEAF, ROOT

DBC, SIGNALS = ROOT / "config/can/leaf_ze0.dbc", ROOT / "config/can/leaf_ze0.yaml"


def write_files(folder, *arguments):
    assert run.main(["--vehicle", str(LEAF), "--to-files", str(folder), "--duration", "3", *arguments]) == 0
    return {f.name: f.read_bytes() for f in folder.iterdir()}


def read_truth(folder):
    with (folder / "truth.mcap").open("rb") as stream:
        reader = make_reader(stream)
        messages = [(m.log_time, json.loads(m.data)) for _, _, m in reader.iter_messages(topics=["/truth"])]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        return messages, metadata


@pytest.mark.slow
@pytest.mark.parametrize("can_format", ["log", "mf4"])
def test_files_are_identical_for_equal_seeds(tmp_path, can_format):
    name = f"run.{can_format}"
    first = write_files(tmp_path / "a", "--can-format", can_format, "--seed", "5")
    assert set(first) == {"run.ncom", "truth.mcap", name}
    # A later run in another process: files depend neither on the clock nor on the process.
    command = [sys.executable, "-m", "st_sim.run", "--vehicle", str(LEAF), "--to-files", str(tmp_path / "b"),
               "--duration", "3", "--can-format", can_format, "--seed", "5"]
    subprocess.run(command, check=True, capture_output=True)
    assert first == {f.name: f.read_bytes() for f in (tmp_path / "b").iterdir()}
    other = write_files(tmp_path / "c", "--can-format", can_format, "--seed", "6")
    assert all(first[f] != other[f] for f in first)


def test_mf4_contains_the_frames_of_the_log(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    write_files(tmp_path, "--can-format", "log")
    write_files(tmp_path, "--can-format", "mf4")
    lines = (tmp_path / "run.log").read_text().splitlines()
    logged = {channel: [] for channel in ("can0", "can1")}
    for line in lines:
        stamp, channel, frame, _ = line.split()
        identifier, _, data = frame.partition("#")
        logged[channel].append((float(stamp.strip("()")), int(identifier, 16), data))
    log = asammdf.MDF(tmp_path / "run.mf4")
    start = log.header.start_time.timestamp()
    assert [g.channel_group.acq_name for g in log.groups] == ["CAN1", "CAN2"]
    for group, channel in enumerate(logged):
        signal_ = log.get("CAN_DataFrame", group=group)
        assert len(signal_) == len(logged[channel]) > 500
        times = [t for t, _, _ in logged[channel]]
        assert start + signal_.timestamps == pytest.approx(times, abs=3e-5)
        rows = signal_.samples
        assert list(rows["CAN_DataFrame.ID"]) == [i for _, i, _ in logged[channel]]
        payload = [
            bytes(d)[:n].hex().upper()
            for d, n in zip(rows["CAN_DataFrame.DataBytes"], rows["CAN_DataFrame.DataLength"], strict=True)
        ]
        assert payload == [d for _, _, d in logged[channel]]
        assert set(rows["CAN_DataFrame.BusChannel"]) == {group + 1}
    decoded = log.extract_bus_logging({"CAN": [(str(DBC), 0)]})
    truth, _ = read_truth(tmp_path)
    wheel = decoded.get("SteeringWheelAngle")
    true = np.interp(
        wheel.timestamps - 0.004, [t["time"] for _, t in truth], [t["steering_wheel_angle"] for _, t in truth]
    )
    assert wheel.samples == pytest.approx(np.degrees(true) - 2.7, abs=0.25)


def test_truth_contains_states_forces_and_settings(tmp_path):
    write_files(tmp_path, "--scenario", "S4", "--effect", "bank_angle=0.02", "wind_speed=4")
    messages, metadata = read_truth(tmp_path)
    assert len(messages) == 300
    stamps = np.array([stamp for stamp, _ in messages])
    assert set(np.diff(stamps)) == {10_000_000} and stamps[0] == run.FILE_EPOCH_NS
    last = messages[-1][1]
    assert last["lateral_force_front"] > 4000 and last["load_front"] + last["load_rear"] == pytest.approx(
        1590 * 9.81 * math.cos(0.02)
    )
    assert last["bank_angle"] == 0.02 and last["wind_y"] == 4.0 and last["slip_angle_front"] < -0.05
    settings = metadata["settings"]
    assert float(settings["bank_angle"]) == 0.02 and float(settings["relaxation_length"]) == 0.4
    assert metadata["run"]["scenario"] == "S4" and metadata["run"]["seed"] == "0"


def test_logger_clock_has_offset_and_drift(tmp_path):
    def times(name, *effects):
        write_files(tmp_path / name, *effects)
        return [float(line[1:18]) for line in (tmp_path / name / "run.log").read_text().splitlines()]

    ideal = np.array(times("a"))
    drifting = np.array(times("b", "--effect", "logger_clock_offset=1.5", "--effect", "logger_clock_drift=1e-4"))
    elapsed = ideal - run.FILE_EPOCH_NS / 1e9
    assert drifting - ideal == pytest.approx(1.5 + 1e-4 * elapsed, abs=2e-6)


class LiveRun:
    """A virtual_leaf process and receivers of its packets and frames."""

    def __init__(self, folder, *arguments):
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.udp.bind(("127.0.0.1", 0))
        port = self.udp.getsockname()[1]
        channel = f"239.74.{100 + port % 50}.{1 + port % 250}:{port}"
        self.bus = open_bus("udp_multicast", channel)
        with socket.socket(fileno=os.dup(self.bus.fileno())) as receiver:  # buffers all frames while this process waits
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        command = [sys.executable, "-m", "st_sim.run", "--vehicle", str(LEAF), "--output", str(folder), "--ncom-port",
                   str(port), "--can-interface", "udp_multicast", "--can-channel", channel, *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.packets, self.frames = [], []

    def listen(self, until):
        """Collect until the predicate is true, or the process has ended and nothing more is received."""
        deadline = time.monotonic() + 60
        while not until() and time.monotonic() < deadline:
            ready, _, _ = select.select([self.udp, self.bus.fileno()], [], [], 0.3)
            if self.udp in ready:
                self.packets.append((time.time_ns(), self.udp.recv(4096)))
            if self.bus.fileno() in ready and (frame := self.bus.recv(0)):
                self.frames.append(frame)
            if not ready and self.process.poll() is not None:
                break

    def finish(self):
        out, err = self.process.communicate(timeout=30)
        self.udp.close()
        self.bus.shutdown()
        return [json.loads(line) for line in out.splitlines()], err


@pytest.mark.slow
def test_live_outputs_arrive_on_real_sockets(tmp_path):
    live = LiveRun(tmp_path, "--duration", "2", "--ncom-rate", "250", "--can-rate", "full")
    live.listen(lambda: False)
    output, err = live.finish()
    assert live.process.returncode == 0 and err == ""
    assert [s["state"] for s in output] == ["sending", "done"] and output[0]["duration"] == 2.0
    parser = NcomParser()
    received = [r for at, data in live.packets for r in parser.feed(data, at)]
    assert len(received) == 500 == output[1]["ncom_packets"] and parser.counters.skipped_bytes == 0
    stamps = np.array([r.utc_ns for r in received])
    assert set(np.diff(stamps)) == {4_000_000} and stamps[0] == output[0]["start_ns"]
    # Stamps are of the clock of this host; nothing is sent before its measurement.
    age = np.array([r.received_ns for r in received]) - stamps
    assert (age > 0).all()
    decoder = Decoder(DBC, SIGNALS)
    decoded = [d for f in live.frames if (d := decoder.decode(f, round(f.timestamp * 1e9)))]
    assert len(live.frames) == output[1]["can_frames"] == pytest.approx(2 * (1750 + 2000), rel=0.02)
    assert all(d.valid for d in decoded)
    assert len([d for d in decoded if d.message == "Leaf_Steering"]) == 200
    messages, _ = read_truth(tmp_path)
    assert [m[0] for m in messages] == list(range(stamps[0], stamps[0] + 2_000_000_000, 10_000_000))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_closes_the_files(tmp_path, number):
    live = LiveRun(tmp_path, "--duration", "1000")
    live.listen(lambda: len(live.packets) > 60)
    live.process.send_signal(number)
    live.listen(lambda: False)
    output, err = live.finish()
    assert live.process.returncode == 0 and err == ""
    assert output[-1]["state"] == "done"
    messages, metadata = read_truth(tmp_path)
    assert len(messages) >= 60 and "settings" in metadata


@pytest.mark.slow
def test_repeated_signals_do_not_change_the_exit_status(tmp_path):
    options = ["--vehicle", str(LEAF), "--to-files", str(tmp_path), "--duration", "1"]
    command = [sys.executable, "-m", "st_sim.run", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert '"done"' in process.stdout.readline()
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
    assert process.returncode == 0 and process.communicate()[1] == ""


@pytest.mark.slow
def test_signal_closes_the_files_in_file_mode(tmp_path):
    command = [sys.executable, "-m", "st_sim.run", "--vehicle", str(LEAF), "--to-files", str(tmp_path), "--duration",
               "9e5"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "run.log").exists() or (tmp_path / "run.log").stat().st_size < 100_000:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 0 and err == ""
    messages, _ = read_truth(tmp_path)
    packets = NcomParser().feed((tmp_path / "run.ncom").read_bytes())
    assert len(packets) == pytest.approx(len(messages), abs=2) and len(packets) > 100
    assert (tmp_path / "run.log").read_text().endswith("\n")


@pytest.mark.parametrize("config", [["--config", str(ROOT / "config")], ["--config", "../config"], []])
def test_other_car_uses_the_bus_of_the_leaf(tmp_path, monkeypatch, config):
    """The folder of another car has its own DBC, which the virtual car cannot send."""
    monkeypatch.delenv("ST_ENVIRONMENT", raising=False)
    monkeypatch.chdir(ROOT / "tests")
    (tmp_path / "vehicle.yaml").write_text(LEAF.read_text())
    (tmp_path / "can.dbc").write_text(DBC.read_text().replace("Leaf_Steering", "Mine"))
    (tmp_path / "signals.yaml").write_text(SIGNALS.read_text().replace("Leaf_Steering", "Mine"))
    arguments = ["--vehicle", str(tmp_path / "vehicle.yaml"), "--to-files", str(tmp_path / "run"), "--duration", "1"]
    assert run.main([*arguments, *config]) == 0
    assert (tmp_path / "run" / "run.log").stat().st_size > 10_000


def test_tables_without_the_messages_of_the_leaf_are_not_used(tmp_path, capsys):
    (tmp_path / "can").mkdir()
    (tmp_path / "can" / "leaf_ze0.dbc").write_text(DBC.read_text())
    (tmp_path / "can" / "leaf_ze0.yaml").write_text("messages: {}\n")
    arguments = ["--vehicle", str(LEAF), "--config", str(tmp_path), "--to-files", str(tmp_path / "run")]
    assert run.main(arguments) == 2 and "the CAN tables of the virtual car, were not found" in capsys.readouterr().err


def test_missing_tables_of_the_leaf_are_located_in_the_message(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("ST_ENVIRONMENT", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vehicle.yaml").write_text(LEAF.read_text())
    assert run.main(["--vehicle", "vehicle.yaml", "--to-files", "run", "--duration", "1"]) == 2
    assert capsys.readouterr().err == (
        "virtual_leaf: --config is missing: can/leaf_ze0.dbc and can/leaf_ze0.yaml, the CAN tables of the virtual car, "
        "were not found; give the folder config/ of the project\n")
    monkeypatch.setenv("ST_ENVIRONMENT", str(ROOT))
    assert run.main(["--vehicle", "vehicle.yaml", "--to-files", "run", "--duration", "1"]) == 0


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        ([], "--vehicle is missing"),
        (["--vehicle", "none.yaml"], "none.yaml: cannot be read"),
        (["--scenario", "S9"], "--scenario S9"),
        (["--drive", "none.csv"], "--drive none.csv"),
        (["--drive", "a.csv", "--scenario", "S1"], "not allowed with"),
        (["--drive", "a.csv", "--plant", "ideal"], "--plant cannot be combined with --drive"),
        (["--drive", "a.csv", "--effect", "bank_angle=0.1"], "--effect bank_angle cannot be combined with --drive"),
        (["--plant", "none.yaml"], "--plant none.yaml"),
        (["--effect", "bank_angle=7"], "bank_angle: 7.0 is not within -0.3 to 0.3 rad"),
        (["--duration", "0"], "--duration 0"),
        (["--duration", "nan"], "--duration nan"),
        (["--seed", "-1"], "--seed"),
        (["--seed", "x"], "--seed"),
        (["--origin", "91,0,0"], "--origin 91,0,0"),
        (["--origin", "here"], "--origin here"),
        (["--ncom-port", "70000"], "--ncom-port"),
        (["--ncom-rate", "60"], "--ncom-rate"),
        (["--config", "/nonexistent"], "--config /nonexistent"),
        (["--can-channel", "10.0.0.1"], "--can-channel 10.0.0.1"),
        (["--can-interface", "nosuch"], "--can-interface nosuch"),
        (["--output", "/dev/null/x"], "--output /dev/null/x"),
        (["--to-files", "/dev/null/x"], "--to-files /dev/null/x"),
        (["--wheels", "5"], "--wheels"),
    ],
)
def test_wrong_argument_is_rejected_in_one_line(arguments, output, capsys):
    if arguments and "--vehicle" not in arguments:
        arguments = ["--vehicle", str(LEAF), *arguments]
    try:
        status = run.main(arguments)
    except SystemExit as error:
        status = error.code
    assert status == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("virtual_leaf: ") and err.count("\n") == 1
    assert output in err


@pytest.mark.slow
def test_live_drive_keeps_the_true_motion_of_earlier_drives_in_its_folder(tmp_path):
    """The recorder also keeps the earlier bags."""
    for name in ("truth.mcap", "truth_2.mcap", "truth_3.mcap"):
        live = LiveRun(tmp_path, "--duration", "0.2")
        live.listen(lambda: False)
        live.finish()
        assert live.process.returncode == 0
        if name == "truth.mcap":
            first = (tmp_path / name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["truth.mcap", "truth_2.mcap", "truth_3.mcap"]
    assert (tmp_path / "truth.mcap").read_bytes() == first


@pytest.mark.slow
def test_full_disk_ends_the_truth_file_but_not_the_drive(tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("this system has no /dev/full")
    (tmp_path / "truth.mcap").symlink_to("/dev/full")
    live = LiveRun(tmp_path, "--duration", "3")
    live.listen(lambda: False)
    output, _ = live.finish()
    assert live.process.returncode == 0 and output[-1]["ncom_packets"] == 300
    assert "truth.mcap: No space left" in output[-1]["fault"]


def test_list_shows_scenarios_and_effects(capsys):
    assert run.main(["--list"]) == 0
    out = capsys.readouterr().out
    assert "S7" in out and "steering_lag" in out
