"""NCOM files in ISO axes and the local map, and NCOM files that cannot be used."""

import csv
from pathlib import Path

import numpy as np
import pytest
from oxts_bridge.geometry import LocalFrame
from oxts_bridge.ncom import Packet, encode
from st_recordings.runs.errors import RunError
from st_recordings.runs.ncom import read_ncom
from support import vectors

MINUTE = 23_000_000  # since the GPS epoch: 2023


def packets(times: list[float], status: int = 4, minutes: bool = True, east: float = 10.0) -> bytes:
    """Packets of a drive to the east. times: since MINUTE [s]; minutes: channel 0 is sent; east: velocity [m/s]."""
    stream = b""
    for k, t in enumerate(times):
        minute, ms = divmod(round(t * 1000), 60_000)
        channel0 = minutes and k % 10 == 0
        batch = (MINUTE + minute).to_bytes(4, "little") + bytes(4) if channel0 else bytes(8)
        stream += encode(Packet(
            milliseconds=ms, acceleration=(0.0, 0.0, -9.81), angular_rate=(0.0, 0.0, 0.0), navigation_status=status,
            latitude=0.8, longitude=0.3 + east * t / 4.45e6, altitude=100.0, velocity_ned=(0.0, east, 0.0),
            heading=np.pi / 2, pitch=0.0, roll=0.0, channel=0 if channel0 else 1, batch_s=batch))
    return stream


# The two cases with the derived values of the vendor; the shorter one is part of the repository.
drives = pytest.mark.parametrize(("which", "case"), [("excerpt", "filters"), ("complete", "drive_100hz")])


@drives
def test_axes_agree_with_the_iso_values_of_the_vendor(which: str, case: str) -> None:
    log = read_ncom(vectors(which, f"ncom/{case}.ncom"))
    with vectors(which, f"ncom/{case}.expected.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for k, name in enumerate(("IsoVoX", "IsoVoY", "IsoVoZ")):
        expected = np.array([float(row[name]) for row in rows])[log.rows]
        np.testing.assert_allclose(log.motion.body_velocity[k], expected, atol=1e-9)
    # FRD -> FLU, and heading from north clockwise -> yaw from east counter-clockwise.
    np.testing.assert_allclose(log.values["yaw_rate"], [-np.radians(float(row["Wz"])) for row in rows], atol=1e-12)
    np.testing.assert_allclose(log.values["acceleration_y"], [-float(row["Ay"]) for row in rows], atol=1e-12)
    heading = np.radians([float(row["Heading"]) for row in rows])
    np.testing.assert_allclose(np.exp(1j * log.values["yaw"]), np.exp(1j * (np.pi / 2 - heading)), atol=1e-12)
    assert np.abs(np.diff(log.values["yaw"])).max() < 0.1


@drives
def test_positions_are_in_the_local_map_of_the_origin(which: str, case: str) -> None:
    log = read_ncom(vectors(which, f"ncom/{case}.ncom"))
    columns, last = log.columns, int(log.rows[-1])
    frame = LocalFrame(*log.origin)
    expected = frame.to_enu(columns.latitude[last], columns.longitude[last], columns.altitude[last])
    np.testing.assert_allclose([axis[-1] for axis in log.position], expected, atol=1e-6)
    assert [axis[0] for axis in log.position] == pytest.approx([0, 0, 0], abs=1e-6)
    # Velocity is the derivative of position: body axes, yaw and map are consistent.
    time = (log.time_ns - log.time_ns[0]) * 1e-9
    east = np.gradient(log.position[0], time)
    forward, left = log.motion.body_velocity[:2]
    yaw = log.values["yaw"]
    np.testing.assert_allclose(east[5:-5], (forward * np.cos(yaw) - left * np.sin(yaw))[5:-5], atol=0.05)


def test_packets_without_a_fix_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "start.ncom"
    file.write_bytes(packets([0.0, 0.1], status=2) + packets([0.2 + 0.01 * k for k in range(20)]))
    log = read_ncom(file)
    assert len(log.time_ns) == 20
    assert "2 of 22 packets (9.1 %) have no fix, no time or an invalid value; they were left out" in log.warnings[0]
    assert log.is_utc


@pytest.mark.parametrize(("content", "message"), [
    (b"MDF     4.11    " + bytes(200), "no NCOM packet .* an MDF log"),
    (packets([0.1 * k for k in range(50)], status=2),
     r"no packet has a fix; navigation status: 2 \(initialising\) in 50"),
    (packets([0.1 * k for k in range(50)], minutes=False), "no packet has the GPS minute"),
])
def test_unusable_file_is_rejected(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "bad.ncom"
    file.write_bytes(content)
    with pytest.raises(RunError, match=rf"bad\.ncom: {message}"):
        read_ncom(file)


def test_packets_with_a_wrong_checksum_are_counted(tmp_path: Path) -> None:
    file = tmp_path / "damaged.ncom"
    stream = bytearray(packets([0.01 * k for k in range(300)]))
    stream[100 * 72 + 30] ^= 0xFF
    file.write_bytes(bytes(stream[: 200 * 72 + 40]))
    log = read_ncom(file)
    assert len(log.time_ns) == 199
    assert " packet has a wrong checksum" in log.warnings[0]


def test_longest_part_is_kept_where_the_clock_was_set_back(tmp_path: Path) -> None:
    file = tmp_path / "back.ncom"
    file.write_bytes(packets([30 + 0.01 * k for k in range(400)]) + packets([10 + 0.01 * k for k in range(900)]))
    log = read_ncom(file)
    assert (np.diff(log.time_ns) > 0).all()
    assert len(log.time_ns) > 880
    assert "the clock was set back by 23.890 s: 400 of 1290 packets (31 %)" in log.warnings[-1]


def test_packets_in_an_xcom_container(tmp_path: Path) -> None:
    file = tmp_path / "drive.xcom"
    stream = packets([0.01 * k for k in range(100)])
    pages = b"".join(b"OggS" + bytes(23) + stream[k : k + 72 * 10] for k in range(0, len(stream), 72 * 10))
    file.write_bytes(pages)
    assert len(read_ncom(file).time_ns) == 100


def test_packets_of_two_units_cause_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "drive.ncom"
    first = packets([0.01 * k for k in range(100)])
    second = b"".join(packets([0.01 * k], east=12.0) for k in range(100))
    file.write_bytes(b"".join(first[k : k + 72] + second[k : k + 72] for k in range(0, len(first), 72)))
    warning = read_ncom(file).warnings[0]
    assert "100 of 200 packets (50 %) are out of order or have the time of an earlier packet" in warning


@pytest.mark.parametrize(("magic", "record_header", "size"), [
    (b"\xd4\xc3\xb2\xa1", 16, 72), (b"\x4d\x3c\xb2\xa1", 16, 72), (b"\n\r\r\n", 28, 72), (b"\xd4\xc3\xb2\xa1", 16, 54)])
def test_packets_in_a_network_capture(tmp_path: Path, magic: bytes, record_header: int, size: int) -> None:
    """UDP over IP over Ethernet. size: recorded bytes of each packet, 54 with a snapshot length of 96."""
    file = tmp_path / "drive.pcap"
    stream = packets([0.01 * k for k in range(100)])
    parts = (bytes(record_header + 42) + stream[k : k + size] for k in range(0, len(stream), 72))
    file.write_bytes(magic + bytes(20) + b"".join(parts))
    if size < 72:
        with pytest.raises(RunError, match="a network capture without complete NCOM packets: record whole datagrams"):
            read_ncom(file)
    else:
        log = read_ncom(file)
        assert len(log.time_ns) == 100 and not log.warnings
