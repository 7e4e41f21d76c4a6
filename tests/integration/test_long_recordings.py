"""Alignment of a recording of ten hours, in which the clocks drift apart by more than a second."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from oxts_bridge.ncom import MINUTE_MS, Packet, encode
from scipy.signal import butter, lfilter
from st_core.leap_seconds import GPS_EPOCH_UNIX, leap_seconds_at_gps
from st_recordings.runs import find_runs, read
from support import read_car

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

HOURS, RATE = 10, 20  # h, Hz
OFFSET, DRIFT = 2.5, 40e-6  # s, 1
START = datetime(2024, 5, 1, 9, tzinfo=UTC)


def motion(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [m/s] and yaw rate [rad/s]."""
    random = np.random.default_rng(1)
    speed = np.abs(12 + 60 * lfilter(*butter(2, 0.006), random.standard_normal(len(seconds))))
    return speed, 0.5 * lfilter(*butter(2, 0.02), random.standard_normal(len(seconds)))


def write_ncom(file: Path, seconds: np.ndarray, speed: np.ndarray, rate: np.ndarray) -> None:
    start_ms = (int(START.timestamp()) - GPS_EPOCH_UNIX) * 1000
    start_ms += leap_seconds_at_gps(start_ms // 1000) * 1000
    yaw = np.cumsum(rate) / RATE
    heading = (np.pi / 2 - yaw + np.pi) % (2 * np.pi) - np.pi
    packet = Packet(navigation_status=4, acceleration=(0.0, 0.0, -9.81), latitude=0.8, longitude=0.3, altitude=100.0,
                    pitch=0.0, roll=0.0)
    with file.open("wb") as stream:
        rows = zip((start_ms + np.round(seconds * 1000)).astype(int).tolist(), speed.tolist(), rate.tolist(),
                   heading.tolist(), strict=True)
        for k, (ms, v, r, h) in enumerate(rows):
            minute, packet.milliseconds = divmod(ms, MINUTE_MS)
            packet.angular_rate, packet.heading = (0.0, 0.0, -r), h
            packet.velocity_ned = (v * np.cos(h), v * np.sin(h), 0.0)
            packet.channel = 0 if k % 10 == 0 else 200
            packet.batch_s = minute.to_bytes(4, "little") + bytes(4) if k % 10 == 0 else bytes(8)
            stream.write(encode(packet))


def write_mf4(file: Path, seconds: np.ndarray, speed: np.ndarray, rate: np.ndarray) -> None:
    """Messages of steering, forward velocity and yaw rate of the RT, with stamps of the logger's clock."""
    from asammdf import MDF, Signal

    n = len(seconds)
    payload = np.zeros((3, n, 8), np.uint8)
    angle = np.round(np.degrees(17 * np.arctan(2.7 * rate / np.maximum(speed, 1))) / -0.1).astype("<i2")
    payload[0, :, :2] = angle.view(np.uint8).reshape(n, 2)
    payload[0, :, 3], payload[0, :, 4] = 7, np.arange(n) % 16
    nibbles = np.bitwise_xor.reduce(payload[0, :, :5], axis=1)
    payload[0, :, 4] |= ((nibbles >> 4) ^ (nibbles & 0xF)) << 4
    payload[1, :, :2] = np.round(speed / 0.01).astype("<i2").view(np.uint8).reshape(n, 2)
    payload[2, :, 4:6] = np.round(np.degrees(-rate) / 0.01).astype("<i2").view(np.uint8).reshape(n, 2)
    names = (("BusChannel", "u1"), ("ID", "<u4"), ("DLC", "u1"), ("DataLength", "u1"), ("DataBytes", "(8,)u1"))
    rows = np.zeros((n, 3), [(f"CAN_DataFrame.{name}", kind) for name, kind in names])
    rows["CAN_DataFrame.BusChannel"] = 1
    rows["CAN_DataFrame.ID"] = (0x002, 0x604, 0x608)
    rows["CAN_DataFrame.DLC"] = rows["CAN_DataFrame.DataLength"] = (5, 4, 6)
    rows["CAN_DataFrame.DataBytes"] = np.swapaxes(payload, 0, 1)
    logger = (seconds - OFFSET) / (1 + DRIFT) + 5.0  # the session started 5 s earlier
    stamps = np.repeat(np.round(logger / 50e-6) * 50e-6, 3)
    log = MDF(version="4.11")
    log.header.start_time = datetime.fromtimestamp(START.timestamp() - 5, UTC)
    log.append([Signal(samples=rows.reshape(-1), timestamps=stamps, name="CAN_DataFrame")], acq_name="CAN1")
    log.save(file)
    log.close()


def test_ten_hours_are_aligned_to_3_ms_and_a_tenth_of_a_ppm(tmp_path: Path) -> None:
    seconds = np.arange(HOURS * 3600 * RATE) / RATE
    speed, rate = motion(seconds)
    write_ncom(tmp_path / "day.ncom", seconds, speed, rate)
    write_mf4(tmp_path / "day.mf4", seconds, speed, rate)
    run = read(find_runs([tmp_path])[0], read_car("leaf"))
    assert (run.alignment.method, run.alignment.verdict) == ("shared signals", "good"), run.alignment.reasons
    assert run.alignment.drift_ppm == pytest.approx(DRIFT * 1e6, abs=0.1)
    since = (run.alignment.at_ns - int(START.timestamp() * 1e9)) * 1e-9  # on the logger's clock
    # These frames have no latency; the reader assumes 2 ms.
    assert run.alignment.offset_ns * 1e-9 == pytest.approx(OFFSET + since * DRIFT, abs=3e-3)
    assert run.log.duration == pytest.approx(HOURS * 3600, abs=1)
    assert len(run.log.steering_time_ns) == len(seconds)
