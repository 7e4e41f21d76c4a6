"""NCOM files as CSV, and files that are not NCOM."""

import csv
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.export import filter_low_pass, write_csv
from oxts_bridge.ncom import NcomError

START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]

COLUMNS = """
    pkt start_offset out_type nav_mode channel time week tow quality Ax Ay Az Wx Wy Wz Lat Lon Alt Vn Ve Vd Heading
    Pitch Roll Vf Vl Speed2d Speed3d Track Slip Curvature Dist2d Dist3d Af Al Ad Wf Wl Wd Yx Yy Yz FiltAx FiltAy FiltAz
    FiltYx FiltYy FiltYz IsoVoX IsoVoY IsoVoZ IsoVhX IsoVhY IsoVhZ IsoAoX IsoAoY IsoAoZ
"""


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_columns_and_units_of_the_csv(tmp_path, packet, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(30)) + packet(START + 120, 3, acceleration=(math.nan, 0.0, 0.0)))
    assert write_csv(tmp_path / "a.ncom", tmp_path / "a.csv", tmp_path / "s.csv") == 31
    table = rows(tmp_path / "a.csv")
    assert list(table[0]) == COLUMNS.split()
    row = table[5]
    assert [row[name] for name in ("pkt", "start_offset", "out_type", "nav_mode", "quality")] == [
        "5", "360", "regular", "4", "valid"]
    expected = {"time": START / 1000 + 0.02, "tow": START / 1000 % 604_800 + 0.02, "Wz": math.degrees(0.1), "Lat": 52.0,
                "Alt": 100.5, "Heading": 30.0, "Vf": 11.16025, "Vl": -0.66987, "Speed2d": 11.18034, "IsoVoY": 0.74211}
    assert {name: float(row[name]) for name in expected} == pytest.approx(expected, abs=1e-4)
    assert int(row["week"]) == START // 604_800_000
    assert table[30]["Ax"] == "" and table[30]["Ay"] == "0.0"
    changes = rows(tmp_path / "s.csv")
    assert {"pkt": "3", "channel": "3", "field": "NorthAcc", "valid": "1", "value": "0.02"} in changes
    assert not any(row["field"] == "GpsMinutes" for row in changes)


def test_heading_is_written_from_0_to_360_deg(tmp_path, packet):
    (tmp_path / "a.ncom").write_bytes(packet(START, 0, heading=-0.1))
    write_csv(tmp_path / "a.ncom", tmp_path / "a.csv")
    assert float(rows(tmp_path / "a.csv")[0]["Heading"]) == pytest.approx(360 - math.degrees(0.1))


@pytest.mark.parametrize(("content", "text"), [
    (b"", "the file is empty"),
    (b"\xe7" * 50, "no NCOM packet in 50 bytes"),
    (b"time,x,y\n1,2,3\n" * 40, "the file is text"),
    (b"OggS" + bytes(500), "Ogg container"),
    (bytes(range(256)) * 4, "no NCOM packet in 1024 bytes"),
])
def test_other_file_is_rejected_in_one_line(tmp_path, content, text):
    file = tmp_path / "drive.ncom"
    file.write_bytes(content)
    with pytest.raises(NcomError) as error:
        write_csv(file, tmp_path / "out.csv")
    assert str(error.value).startswith(str(file)) and text in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "out.csv").exists()


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.ncom"):
        write_csv(tmp_path / "missing.ncom", tmp_path / "out.csv")


def filter_signal(signal, rate, seconds, cutoff, damping):
    """Samples signal(times [s]) at a rate [Hz] and filters it. cutoff [Hz]."""
    times = np.arange(int(rate * seconds)) / rate
    return filter_low_pass(times, signal(times), [(0, (cutoff, damping))])


def test_low_pass_keeps_a_constant_after_two_samples():
    out = filter_signal(np.ones_like, 100, 1, 5.0, 0.7)
    assert np.isnan(out[:2]).all()
    assert out[2:] == pytest.approx(1.0)


def test_low_pass_gain_at_the_cutoff_is_one_over_two_damping():
    out = filter_signal(lambda t: np.sin(2 * math.pi * 5.0 * t), 100, 4, 5.0, 0.7)
    assert out[200:].max() == pytest.approx(1 / (2 * 0.7), rel=0.02)


def test_low_pass_is_off_at_cutoff_0_and_invalid_above_half_the_sampling_rate():
    assert filter_signal(np.array, 10, 0.3, 0.0, 0.0).tolist() == [0.0, 0.1, 0.2]
    assert np.isnan(filter_signal(np.array, 100, 0.1, 60.0, 0.7)).all()


def test_low_pass_with_new_settings_starts_with_the_last_three_samples():
    times = np.arange(50) / 100
    values = np.cos(20 * times)
    out = filter_low_pass(times, values, [(0, (5.0, 0.7)), (10, (5.0, 0.7)), (20, (None, None)), (30, (10.0, 0.7))])
    assert np.array_equal(out[:30], filter_low_pass(times, values, [(0, (5.0, 0.7))])[:30], equal_nan=True)
    assert out[30:] == pytest.approx(filter_low_pass(times[27:], values[27:], [(0, (10.0, 0.7))])[3:])


@given(north=st.floats(-50, 50), east=st.floats(-50, 50), heading=st.floats(-3.1, 3.1))
def test_slip_is_the_track_relative_to_the_heading(tmp_path_factory, packet, north, east, heading):
    folder = tmp_path_factory.mktemp("slip")
    (folder / "a.ncom").write_bytes(packet(START, 0, velocity_ned=(north, east, 0.0), heading=heading))
    write_csv(folder / "a.ncom", folder / "a.csv")
    row = rows(folder / "a.csv")[0]
    if math.hypot(north, east) > 0.1402:
        slip = float(row["Slip"])
        assert -180 < slip <= 180
        assert math.cos(math.radians(slip)) * float(row["Speed2d"]) == pytest.approx(float(row["Vf"]), abs=1e-6)
        assert math.sin(math.radians(slip)) * float(row["Speed2d"]) == pytest.approx(float(row["Vl"]), abs=1e-6)
    elif math.hypot(north, east) < 0.1398:
        assert row["Slip"] == row["Track"] == row["Curvature"] == ""


def test_distance_excludes_time_gaps(tmp_path, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(251) + drive(251, START + 3_600_000)))
    write_csv(tmp_path / "a.ncom", tmp_path / "a.csv")
    table = rows(tmp_path / "a.csv")
    speed = float(table[1]["Speed2d"])
    # From the packet after the one that sets the minute: 249 steps and 250 steps of 4 ms.
    assert float(table[-1]["Dist2d"]) == pytest.approx(speed * 0.004 * (249 + 250), rel=1e-4)


@pytest.mark.parametrize("outputs", [("run.ncom", None), ("run.csv", "run.ncom"), ("run.csv", "run.csv"),
                                     ("./run.ncom", None)])
def test_output_that_overwrites_the_recording_or_the_other_output_is_rejected(tmp_path, drive, outputs):
    recording = tmp_path / "run.ncom"
    recording.write_bytes(b"".join(drive(3)))
    before = recording.read_bytes()
    csv_path, status_path = (None if name is None else tmp_path / name for name in outputs)
    with pytest.raises(NcomError, match=r"is the recording itself|name two different files"):
        write_csv(recording, csv_path, status_path)
    assert recording.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.ncom"]
