"""CAN vectors: a synthetic drive and a real CANedge2 file, both as MF4, against the values read by other programs.

Two sets (tests/support.py): "excerpt" in tests/golden/data, and "complete" in the reference data. The excerpt has
every hundredth value of a signal of the drive, not every tenth, and the first 262 of 5588 frames of the real file, two
of them with id 0x002.
"""

import csv
from collections import defaultdict
from pathlib import Path

import can
import numpy as np
import pytest
from canedge_bridge.decode import Decoder
from canedge_bridge.extraction import Extractor, stack_bytes
from canedge_bridge.signals import load_dbc
from support import ROOT, SETS, vectors

asammdf = pytest.importorskip("asammdf", reason="asammdf is an offline requirement")

DBC = ROOT / "config" / "can" / "leaf_ze0.dbc"
TABLE = ROOT / "config" / "can" / "leaf_ze0.yaml"
REAL = "canedge2_2F6913DB_00000004_00000001"
EVERY = {"excerpt": 100, "complete": 10}  # the vector has one of this number of values of the drive


def read_frames(path: Path) -> dict[str, np.ndarray]:
    """All data frames of an MF4 file, merged by time: time, and the CAN_DataFrame members without their prefix."""
    parts = defaultdict(list)
    with asammdf.MDF(path) as file:
        for index, group in enumerate(file.groups):
            if group.channel_group.cycles_nr and any(c.name == "CAN_DataFrame" for c in group.channels):
                signal = file.get("CAN_DataFrame", group=index)
                parts["time"].append(signal.timestamps)
                for name in ("BusChannel", "ID", "IDE", "DLC", "DataLength", "DataBytes", "Dir"):
                    parts[name].append(np.array(signal.samples[f"CAN_DataFrame.{name}"]))
    merged = {name: np.concatenate(values) for name, values in parts.items()}
    order = np.argsort(merged["time"], kind="stable")
    return {name: values[order] for name, values in merged.items()}


@pytest.fixture(scope="module", params=SETS)
def which(request):
    return request.param


@pytest.fixture(scope="module")
def drive(which):
    return read_frames(vectors(which, "can/synthetic_leaf_rt.mf4"))


@pytest.fixture(scope="module")
def real(which):
    return read_frames(vectors(which, f"can/{REAL}.MF4"))


@pytest.fixture(scope="module")
def samples(which):
    """signal -> [(seconds, value)], one of EVERY[which] values of the drive"""
    with vectors(which, "can/synthetic_leaf_rt.decoded.csv").open() as file:
        table = defaultdict(list)
        for row in csv.DictReader(file):
            table[row["signal"]].append((float(row["t_s"]), float(row["value"])))
    assert sum(map(len, table.values())) == 36_000 / EVERY[which]
    return table


def assert_sampled(times, values, expected, every):
    assert len(values[::every]) == len(expected)
    expected_times, expected_values = np.array(expected).T
    assert np.abs(times[::every] - expected_times).max() < 1e-6
    # The values in the file are rounded to the resolution of the signal.
    assert np.abs(values[::every] - expected_values).max() < 1e-9


def test_log_decoder_reads_the_values_of_the_vector(which, drive, samples):
    decoded = {}
    for message in load_dbc(DBC).messages:
        rows = drive["ID"] == message.frame_id
        data = stack_bytes(drive["DataBytes"][rows], message.length)
        decoded |= {s.name: (rows, Extractor(message, s).extract(data)) for s in message.signals}
    for name, expected in samples.items():
        rows, values = decoded[name]
        assert_sampled(drive["time"][rows], values, expected, EVERY[which])


# Message, canonical signal, SI value (with sign) of one unit of the DBC, DBC signal of the vector.
LIVE = [
    ("Leaf_Steering", "steering_wheel_angle", np.pi / 180, "SteeringWheelAngle"),
    ("Leaf_WheelSpeedFront", "vehicle_speed", 1 / 3.6, "VehicleSpeedABS"),
    ("Leaf_WheelSpeedFront", "wheel_speed_front_left", 1 / 3.6, "WheelSpeedFL"),
    ("RT_VelocityLevel", "ins_velocity_x", 1.0, "VelForward"),
    ("RT_RateVehicle", "ins_yaw_rate", -np.pi / 180, "AngRateZ"),
    ("RT_IsoVsVelocity", "ins_velocity_x", 1.0, "IsoVsLongitudinalVelocity"),
]


def test_live_decoder_reads_the_values_of_the_vector(which, drive, samples):
    """All frames of the drive are valid and none is unknown."""
    decoder = Decoder(DBC, TABLE)
    decoded = defaultdict(list)
    for time, identifier, data, length in zip(drive["time"], drive["ID"], drive["DataBytes"], drive["DataLength"],
                                              strict=True):
        frame = can.Message(arbitration_id=int(identifier), is_extended_id=False, data=bytes(data[:length]))
        result = decoder.decode(frame, round(time * 1e9))
        assert result is not None and result.valid
        for name, value in result.values.items():
            decoded[result.message, name].append((time, value))
    assert not decoder.skipped and len(drive["ID"]) == 42000
    for message, name, scale, signal in LIVE:
        times, values = np.array(decoded[message, name]).T
        assert_sampled(times, values / scale, samples[signal], EVERY[which])
    yaw = np.array(decoded["RT_IsoOrientation", "ins_yaw"])[:: EVERY[which], 1]
    error = np.degrees(yaw) - np.array(samples["IsoYawAngle"])[:, 1]
    assert np.abs((error + 180) % 360 - 180).max() < 1e-9


def test_messages_in_both_axes_conventions_give_equal_yaw(drive):
    """Message 0x607 is clockwise from north; converted to ENU it equals 0x633 within rounding."""
    decoder = Decoder(DBC, TABLE)
    yaws = defaultdict(list)
    for identifier, data, length in zip(drive["ID"], drive["DataBytes"], drive["DataLength"], strict=True):
        if identifier in (0x607, 0x633):
            frame = can.Message(arbitration_id=int(identifier), is_extended_id=False, data=bytes(data[:length]))
            yaws[int(identifier)].append(decoder.decode(frame, 0).values["ins_yaw"])
    difference = np.degrees(np.array(yaws[0x607]) - np.array(yaws[0x633]))
    assert np.abs((difference + 180) % 360 - 180).max() < 0.011


def test_frames_of_a_real_canedge2_file_equal_the_vector(which, real):
    with vectors(which, f"can/{REAL}.frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(real["time"]) == len(rows) == {"excerpt": 262, "complete": 5588}[which]
    assert np.abs(real["time"] - [float(r["t_rel_s"]) for r in rows]).max() < 1e-6
    for name, column, base in (("BusChannel", "bus", 10), ("Dir", "dir_tx", 10), ("IDE", "ide", 10),
                               ("ID", "id_hex", 16), ("DLC", "dlc", 10), ("DataLength", "len", 10)):
        assert (real[name] == [int(r[column], base) for r in rows]).all(), name
    for data, length, row in zip(real["DataBytes"], real["DataLength"], rows, strict=True):
        assert bytes(data[:length]).hex().upper() == row["data_hex"]


def test_no_frame_of_the_real_file_is_decoded_as_a_leaf_message(which, real):
    """Its GNSS frames have the identifier 0x002 of the steering angle, but another length."""
    decoder = Decoder(DBC, TABLE)
    for identifier, extended, data, length in zip(real["ID"], real["IDE"], real["DataBytes"], real["DataLength"],
                                                  strict=True):
        frame = can.Message(arbitration_id=int(identifier), is_extended_id=bool(extended), data=bytes(data[:length]))
        assert decoder.decode(frame, 0) is None
    gnss = {"excerpt": 2, "complete": 44}[which]
    assert decoder.statistics("Leaf_Steering").wrong_length == (real["ID"] == 0x002).sum() == gnss
