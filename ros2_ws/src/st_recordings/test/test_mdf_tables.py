"""MDF files of measured signals, as INCA, CANape and asammdf write them, are read as tables."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from asammdf import MDF, Signal
from drive_kinds import CAR, assert_same, to_degrees
from mdf_files import LogFrame, write_layout_2
from raw_drives import write_drives
from st_core.log import DriveLog
from st_recordings.runs import ReadSettings, find_runs, read
from st_recordings.runs.binary_table import is_signal_table, read_signals
from st_recordings.runs.can_formats import is_can_log
from st_recordings.runs.columns import Layout
from st_recordings.runs.errors import RunError


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveLog:
    folder = write_drives(tmp_path_factory.mktemp("raw"), {}, 4, (("sweep", 12.0),))
    (source,) = find_runs([folder])
    return read(source, CAR, ReadSettings(offset=0.0, accept_doubtful=True)).log


def write_signals(file: Path, log: DriveLog, version: str = "4.10", steering: bool = True, device: str = "",
                  yaw: str = "INS_Yaw", invalid: int = 0) -> Path:
    """INS and steering in groups of their own, with their own times. invalid: number of yaw rates marked as invalid."""
    start_ns = int(log.ins_time_ns[0])
    time, steering_time = (log.ins_time_ns - start_ns) * 1e-9, (log.steering_time_ns - start_ns) * 1e-9
    latitude, longitude = to_degrees(log)
    values = {"INS_Latitude": (latitude, "deg"), "INS_Longitude": (longitude, "deg"), yaw: (log.yaw, "rad"),
              "INS_VelForward": (3.6 * log.velocity_x, "km/h"), "INS_VelLateral": (log.velocity_y, "m/s")}
    signals = [Signal(samples, time, name=name + device, unit=unit) for name, (samples, unit) in values.items()]
    mask = (np.arange(len(time)) >= 500) & (np.arange(len(time)) < 500 + invalid)
    rate = Signal(np.where(mask, 9.0, log.yaw_rate), time, name=f"INS_YawRate{device}", unit="rad/s",
                  invalidation_bits=mask if invalid else None)
    with MDF(version=version) as mdf:
        mdf.start_time = mdf.start_time.fromtimestamp(start_ns * 1e-9, mdf.start_time.tzinfo)
        mdf.append([*signals, rate])
        if steering:
            wheel = np.degrees(log.steering_wheel_angle)
            mdf.append([Signal(wheel, steering_time, name=f"SteeringWheelAngle{device}", unit="deg")])
        mdf.append([Signal(np.arange(50.0), np.arange(50.0) * 0.1, name="EngineSpeed", unit="1/min")])
        return Path(mdf.save(file, overwrite=True))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [
    ("drive.mf4", {}), ("inca.mf4", {"device": "\\CAN-Monitoring:1"}), ("old.mdf", {"version": "3.30"}),
    ("inca.dat", {"version": "3.30"}), ("invalid.mf4", {"invalid": 20})])
def test_signals_are_read_with_their_units_and_times(drive, tmp_path, name, options):
    file = write_signals(tmp_path / "x", drive, **options).rename(tmp_path / name)
    (source,) = find_runs([file])
    run = read(source, CAR)
    assert_same(run.log, drive, options.get("invalid", 0) + 2, steering=1e-4, rotated=True)
    np.testing.assert_allclose(run.log.steering_time_ns, drive.steering_time_ns, atol=2000)
    assert abs(int(run.log.ins_time_ns[0]) - int(drive.ins_time_ns[0])) < 1e9 * (1 + options.get("invalid", 0))


def test_signals_of_several_messages_are_interpolated_at_the_times_of_one(drive, tmp_path):
    """INS messages on a CAN bus each have their own times, with jitter."""
    start_ns, random = int(drive.ins_time_ns[0]), np.random.default_rng(0)
    time = (drive.ins_time_ns - start_ns) * 1e-9
    latitude, longitude = to_degrees(drive)
    messages = [{"Latitude [deg]": latitude, "Longitude [deg]": longitude}, {"Yaw [rad]": drive.yaw},
                {"VelForward [m/s]": drive.velocity_x, "VelLateral [m/s]": drive.velocity_y},
                {"YawRate [rad/s]": drive.yaw_rate}]
    with MDF() as mdf:
        mdf.start_time = mdf.start_time.fromtimestamp(start_ns * 1e-9, mdf.start_time.tzinfo)
        for number, message in enumerate(messages):
            stamps = time + 4e-4 * number + random.uniform(0.0, 3e-4, len(time))
            mdf.append([Signal(np.interp(stamps, time, values), stamps, name=name, unit="")
                        for name, values in message.items()])
        mdf.append([Signal(drive.steering_wheel_angle, (drive.steering_time_ns - start_ns) * 1e-9,
                           name="SteeringWheelAngle", unit="rad")])
        file = mdf.save(tmp_path / "drive.mf4")
    run = read(find_runs([file])[0], CAR)
    assert len(run.log.ins_time_ns) >= len(time) - 3
    at = (run.log.ins_time_ns - start_ns) * 1e-9
    for name, tolerance in (("velocity_x", 1e-5), ("velocity_y", 1e-5), ("yaw", 1e-4), ("yaw_rate", 2e-3)):
        np.testing.assert_allclose(getattr(run.log, name), np.interp(at, time, getattr(drive, name)), atol=tolerance)
    assert not run.auxiliary.missing and not any("no number" in text for text in run.warnings)


def test_missing_channels_are_listed_with_all_signals_of_the_file(drive, tmp_path):
    file = write_signals(tmp_path / "drive.mf4", drive, steering=False)
    (source,) = find_runs([file])
    with pytest.raises(RunError, match=r"no column was recognised as .*steering_wheel_angle.*EngineSpeed \[1/min\]"):
        read(source, CAR)


def test_layout_of_a_run_file_names_signals(drive, tmp_path):
    write_signals(tmp_path / "drive.mf4", drive, yaw="Kurs")
    (tmp_path / "drive.run.yaml").write_text("csv: drive.mf4\ncolumns: {yaw: Kurs}\n")
    (source,) = find_runs([tmp_path / "drive.run.yaml"])
    assert_same(read(source, CAR).log, drive, 2, steering=1e-4, rotated=True)


def test_signal_that_the_file_lacks_is_rejected_by_its_name(drive, tmp_path):
    write_signals(tmp_path / "drive.mf4", drive)
    (tmp_path / "drive.run.yaml").write_text("csv: drive.mf4\ncolumns: {yaw: Kurs}\n")
    (source,) = find_runs([tmp_path / "drive.run.yaml"])
    with pytest.raises(RunError, match=r"columns: yaw: drive\.mf4 has no column 'Kurs'") as error:
        read(source, CAR)
    assert "asammdf" not in str(error.value)


def test_names_of_repeated_and_decoded_signals(tmp_path):
    """The longer of two signals, no unit twice, times before the trigger, a boolean with gaps, and a comment as in
    decoded CAN logs."""
    with MDF() as mdf:
        mdf.start_time = datetime.fromtimestamp(0, UTC)
        mdf.append([Signal(np.ones(2), np.arange(2.0), name="YawRate", unit="deg/s")])
        mdf.append([Signal(np.ones(1, bool), np.array([2.0]), name="yaw")])
        mdf.append([Signal(np.arange(5.0), np.arange(5.0) - 0.01, name="YawRate", unit="rad/s"),
                    Signal(np.arange(5.0), np.arange(5.0) - 0.01, name="x [m]", unit="m",
                           comment="CAN2.CAN_DataFrame.ID=0x2")])
        file = mdf.save(tmp_path / "decoded.mf4")
    assert is_signal_table(file)
    names, body = read_signals(file, Layout(units={"t": "s"}), [])
    assert names == ["t [s]", "YawRate [rad/s]", "yaw", "x [m]"]
    assert body.splitlines()[:4:3] == ["-0.010000,0,nan,0", "2.000000,nan,1,nan"]


def test_logs_of_frames_remain_can_logs(tmp_path):
    frames = [LogFrame(10_000 * k, 1, 0x002, bytes(8)) for k in range(100)]
    log = write_layout_2(tmp_path / "frames.mf4", 1_700_000_000 * 10**9, frames)
    assert not is_signal_table(log) and is_can_log(log)


def test_damaged_file_is_rejected(drive, tmp_path):
    file = write_signals(tmp_path / "drive.mf4", drive)
    file.write_bytes(file.read_bytes()[:3000])
    (source,) = find_runs([file])
    with pytest.raises(RunError, match="the file is truncated: it ends at byte 3000"):
        read(source, CAR)


def test_texts_arrays_and_repeated_names(tmp_path):
    """An enumeration and an array are rejected as text, not as missing; of equal names the longer signal is used."""
    time = np.arange(60) * 0.1
    values = dict.fromkeys(("x", "y", "yaw", "velocity_y", "yaw_rate", "road_wheel_angle"), np.zeros(60))
    vectors = np.rec.fromarrays([np.zeros((60, 2))], dtype=[("yaw", "<f8", (2,))])
    for name, samples, text in (("velocity_x", np.array([b"S,NA"] * 60), "S NA"), ("yaw", vectors, "array")):
        with MDF() as mdf:
            mdf.append([Signal(np.zeros(3), time[:3], name="x")])
            mdf.append([Signal(samples, time, name=name, encoding="utf-8")])
            mdf.append([Signal(signal, time, name=other) for other, signal in {
                "velocity_x": time, **values}.items() if other != name])
            file = mdf.save(tmp_path / f"{name}.mf4")
        warnings: list[str] = []
        read_signals(file, Layout(), warnings)
        assert warnings == [f"{file}: 2 signals share the name x; the one with the most samples is used"]
        with pytest.raises(RunError, match=f"column {name} has no numbers, but text such as '{text}'"):
            read(find_runs([file])[0], CAR)


def test_advice_for_many_drives_names_the_extension_of_the_file(drive, tmp_path):
    file = write_signals(tmp_path / "drive.mf4", drive, yaw="Gierw")
    with pytest.raises(RunError, match=r"`csv: drive\.mf4` and .*`each: '\*\.mf4'`"):
        read(find_runs([file])[0], CAR)


def test_latitude_and_longitude_in_messages_of_their_own(drive: DriveLog, tmp_path: Path) -> None:
    """A VBOX sends them in separate CAN messages, at different rates."""
    time = (drive.ins_time_ns - drive.ins_time_ns[0]) * 1e-9
    latitude, longitude = to_degrees(drive)
    wheel = np.interp(drive.ins_time_ns, drive.steering_time_ns, drive.steering_wheel_angle)
    signals = {"Latitude": (latitude, "deg"), "Longitude": (longitude, "deg"), "yaw": (drive.yaw, "rad"),
               "vx": (drive.velocity_x, "m/s"), "vy": (drive.velocity_y, "m/s"), "yaw_rate": (drive.yaw_rate, "rad/s"),
               "steering_wheel_angle": (wheel, "rad")}
    with MDF(version="4.10") as mdf:
        for name, (samples, unit) in signals.items():
            stamps = time[::2] - 1e-3 if name == "Longitude" else time
            mdf.append([Signal(np.interp(stamps, time, samples), stamps, name=name, unit=unit)])
        file = Path(mdf.save(tmp_path / "separate.mf4", overwrite=True))
    (source,) = find_runs([file])
    run = read(source, CAR)
    assert_same(run.log, drive, 3, steering=1e-3, rotated=True)
    assert all(count <= 3 for count in run.auxiliary.missing.values()), run.warnings


def test_truncated_table_is_reported_as_truncated(tmp_path: Path) -> None:
    """asammdf writes the description of the signals behind their samples."""
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(np.arange(5000.0), np.arange(5000.0), name="velocity_x")])
        mdf.save(tmp_path / "a.mf4")
    (tmp_path / "a.mf4").write_bytes((tmp_path / "a.mf4").read_bytes()[:40000])
    (source,) = find_runs([tmp_path])
    assert "a.mf4: the file is truncated: it ends at byte 40000, before its first data group at byte 8" in str(
        source.problem)
