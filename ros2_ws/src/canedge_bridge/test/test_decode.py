"""Frames to signals and back, with recorded bytes and known values; bad frames change nothing."""

import itertools
import math

import can
import pytest
from canedge_bridge.decode import Decoder
from canedge_bridge.table_reader import TableError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

STEP = 10_000_000
STRAIGHT = math.radians(-2.9)


def steering(decoder, count, angle=0.1):
    return decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, count)


def spoiled(frame):
    """The same frame with a wrong checksum: one payload bit flipped, which the check detects."""
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False,
                       data=bytes([frame.data[0] ^ 1]) + bytes(frame.data[1:]))


def test_recorded_steering_frame(decoder, frame):
    decoded = decoder.decode(frame(0x002, "1D000007B0"), 5)
    assert decoded.values == {"steering_wheel_angle": pytest.approx(STRAIGHT)}
    assert (decoded.message, decoded.time_ns, decoded.valid) == ("Leaf_Steering", 5, True)


def test_recorded_wheel_speeds(dbc_file, signals_file, frame):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_WheelSpeedFront": "off"})
    values = decoder.decode(frame(0x284, "3C063C2B1D100000"), 0).values
    assert values["wheel_speed_front_right"] == pytest.approx(76.83 / 3.6)
    assert values["wheel_speed_front_left"] == pytest.approx(77.015 / 3.6)
    assert values["vehicle_speed"] == pytest.approx(74.40 / 3.6)


@pytest.mark.parametrize(("identifier", "data", "values"), [
    # 604: 10.00 m/s forward, 0.50 m/s to the RIGHT.
    (0x604, "E803 3200", {"ins_velocity_x": 10.0, "ins_velocity_y": -0.5}),
    # 634: the same motion in ISO axes, 0.50 m/s to the right is -0.50 to the left.
    (0x634, "E803 CEFF 0000", {"ins_velocity_x": 10.0, "ins_velocity_y": -0.5}),
    # 607: heading 0 deg is north, 90 deg from east; heading 100 deg is a little south of east.
    (0x607, "0000 0000 0000", {"ins_yaw": math.pi / 2}),
    (0x607, "1027 0000 0000", {"ins_yaw": math.radians(-10)}),
    (0x607, "7869 0000 0000", {"ins_yaw": math.radians(180)}),
    # 633: yaw -10.00 deg.
    (0x633, "18FC 0000 0000", {"ins_yaw": math.radians(-10)}),
    # 608: 20.00 deg/s about the axis that points down is a right turn.
    (0x608, "0000 0000 D007", {"ins_yaw_rate": math.radians(-20)}),
    (0x636, "0000 0000 30F8", {"ins_yaw_rate": math.radians(-20)}),
])
def test_the_ins_on_can_in_our_axes(identifier, data, values, decoder, frame):
    decoded = decoder.decode(frame(identifier, data), 0).values
    assert set(decoded) == set(values)
    for name, value in values.items():
        error = decoded[name] - value
        assert (math.remainder(error, 2 * math.pi) if name == "ins_yaw" else error) == pytest.approx(0, abs=1e-9)


def test_gps_time_on_can_is_utc(decoder, frame):
    # 2021-06-01 10:00:18.25 GPS = 10:00:00.25 UTC
    assert decoder.decode(frame(0x600, "15 14 06 01 19 12 00 0A"), 0).values["ins_unix_time"] == 1_622_541_600.25
    milliseconds = (1_622_541_618_250 - 315_964_800_000).to_bytes(6, "little")
    for offset in (b"\xee", b"\x12", b"\x00"):  # -18, +18, not sent
        decoded = decoder.decode(frame(0x630, milliseconds + offset), 0)
        assert decoded.values["ins_unix_time"] == pytest.approx(1_622_541_600.25, abs=1e-6)


def test_a_time_frame_before_the_unit_knows_the_time(decoder, frame):
    assert math.isnan(decoder.decode(frame(0x600, bytes(8)), 0).values["ins_unix_time"])
    assert math.isnan(decoder.decode(frame(0x630, bytes(7)), 0).values["ins_unix_time"])


def test_what_is_not_ours_is_counted_and_ignored(decoder, frame):
    assert decoder.decode(frame(0x123, "00"), 0) is None
    assert decoder.decode(can.Message(arbitration_id=0x002, is_extended_id=True, data=bytes(5)), 0) is None
    assert decoder.decode(frame(0x040, bytes(8), is_error_frame=True), 0) is None
    assert decoder.decode(frame(0x002, b"", is_remote_frame=True), 0) is None
    assert (decoder.frames.unknown, decoder.frames.error, decoder.frames.remote) == (2, 1, 1)


@pytest.mark.parametrize("data", [b"", bytes(1), bytes(4), bytes(5) + b"\1", bytes(range(8))])
def test_wrong_length_updates_nothing(data, decoder, frame):
    assert decoder.decode(frame(0x002, data), 7) is None
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_length, statistics.good, statistics.last_seen_ns) == (1, 0, None)


@pytest.mark.parametrize(("mode", "valid", "wrong", "seen"), [
    ("off", True, 0, STEP), ("warn", False, 1, STEP), ("drop", None, 1, 0)])
def test_wrong_checksum(mode, valid, wrong, seen, dbc_file, signals_file):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_Steering.checksum": mode})
    assert decoder.decode(steering(decoder, 0), 0).valid
    decoded = decoder.decode(spoiled(steering(decoder, 1)), STEP)
    assert (decoded.valid if decoded else None) is valid
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_checksum, statistics.last_seen_ns) == (wrong, seen)
    # The frame after it is as good as any: its counter is not judged by the bad frame's.
    assert decoder.decode(steering(decoder, 2), 2 * STEP).valid
    assert statistics.lost == 0


@pytest.mark.parametrize(("mode", "valid", "wrong", "seen"), [
    ("off", True, 0, STEP), ("warn", False, 1, STEP), ("drop", None, 1, 0)])
def test_wrong_counter(mode, valid, wrong, seen, dbc_file, signals_file):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_Steering.counter": mode})
    assert decoder.decode(steering(decoder, 0), 0).valid
    decoded = decoder.decode(steering(decoder, 4), STEP)
    assert (decoded.valid if decoded else None) is valid
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_counter, statistics.last_seen_ns) == (wrong, seen)
    assert statistics.lost == (0 if mode == "off" else 3)
    assert decoder.decode(steering(decoder, 5), 2 * STEP).valid


def test_the_wheel_speed_checksum_drops_by_default(decoder):
    good = decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 10.0}, 3)
    assert decoder.decode(good, 0) is not None
    assert decoder.decode(spoiled(good), 1) is None


def test_a_check_for_nobody_is_refused(dbc_file, signals_file):
    for checks, text in (({"Leaf_Brake": "off"}, "check Leaf_Brake"),
                         ({"Leaf_Steering.crc": "off"}, "check Leaf_Steering.crc"),
                         ({"Leaf_Steering": "maybe"}, "'maybe' is not one of off, warn, drop")):
        with pytest.raises(TableError, match=text):
            Decoder(dbc_file, signals_file, checks=checks)


def test_not_a_number_updates_nothing(dbc_file, changed_table, tmp_path, frame):
    text = dbc_file.read_text().replace('SG_ VelForward : 0|16@1- (0.01,0) [-327.68|327.67] "m/s" LOGGER\n'
                                        ' SG_ VelLateral : 16|16@1- (0.01,0) [-327.68|327.67] "m/s" LOGGER',
                                        'SG_ VelForward : 0|32@1- (1,0) [0|0] "m/s" LOGGER')
    path = tmp_path / "float.dbc"
    path.write_text(text + "\nSIG_VALTYPE_ 1540 VelForward : 1;\n")
    decoder = Decoder(path, changed_table(lambda m: m["RT_VelocityLevel"]["signals"].pop("VelLateral")))
    assert decoder.encode("RT_VelocityLevel", {"ins_velocity_x": 2.5}).data == bytes.fromhex("00002040")
    for data in ("0000C07F", "0000807F"):  # NaN, infinity
        assert decoder.decode(frame(0x604, data), 9) is None
    statistics = decoder.statistics("RT_VelocityLevel")
    assert (statistics.not_finite, statistics.last_seen_ns) == (2, None)


def test_an_impossible_angle_updates_nothing(decoder):
    assert decoder.decode(steering(decoder, 0, 0.0), 0) is not None
    assert decoder.decode(steering(decoder, 1, math.radians(1200)), STEP) is None
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.implausible, statistics.last_seen_ns) == (1, 0)


def test_a_swapped_byte_order_is_found_on_a_turning_wheel(decoder, dbc_file, signals_file):
    """Low byte and high byte exchanged, as decoded by a DBC with the wrong byte order."""
    assert decoder.implausible_signals() == []
    passed = 0
    for count in range(200):
        data = bytearray(steering(decoder, count, math.radians(0.5 * count)).data)
        data[0], data[1] = data[1], data[0]
        wrong = can.Message(arbitration_id=2, is_extended_id=False, data=data)
        passed += decoder.decode(wrong, count * STEP) is not None
    assert passed <= 20
    assert "SteeringWheelAngle decodes to implausible values" in decoder.implausible_signals()[0]
    # Ten good frames in a row end it.
    results = [decoder.decode(steering(decoder, count, 0.0), count * STEP) for count in range(200, 320)]
    assert decoder.implausible_signals() == [] and results[-1] is not None and results[8] is None


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(identifier=st.integers(0, 0x7FF) | st.sampled_from([0x002, 0x284, 0x285, 0x600, 0x630, 0x604, 0x607]),
       data=st.binary(max_size=8), flags=st.sampled_from([{}, {"is_error_frame": True}, {"is_extended_id": True}]),
       time_ns=st.integers(-2**62, 2**62))
def test_no_frame_raises(identifier, data, flags, time_ns, decoder):
    options = {"arbitration_id": identifier, "is_extended_id": False, "data": data} | flags
    decoder.decode(can.Message(**options), time_ns)


FAR_APART_NS = itertools.count(0, 3600 * 10**9)  # any counter is right again


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-14.0, 14.0), count=st.integers(0, 1000))
def test_encoded_steering_decodes_to_itself(angle, count, decoder):
    decoded = decoder.decode(steering(decoder, count, angle), next(FAR_APART_NS))
    assert decoded.valid
    assert decoded.values["steering_wheel_angle"] == pytest.approx(angle, abs=math.radians(0.0501))


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(yaw=st.floats(-10.0, 10.0), name=st.sampled_from(["RT_HeadingPitchRoll", "RT_IsoOrientation"]))
def test_encoded_yaw_decodes_to_itself(yaw, name, decoder):
    frame = decoder.encode(name, {"ins_yaw": yaw})
    decoded = decoder.decode(frame, 0).values["ins_yaw"]
    assert math.remainder(decoded - yaw, 2 * math.pi) == pytest.approx(0, abs=math.radians(0.00501))
    word = int.from_bytes(frame.data[:2], "little")
    assert word <= 35999 if name == "RT_HeadingPitchRoll" else (word <= 18000 or word >= 65536 - 18000)


@pytest.mark.parametrize("name", ["RT_DateTime", "RT_MilliTime"])
@pytest.mark.parametrize("unix_time", [1_622_541_600.25, 1_483_228_799.99, 1_483_228_800.0, 1_325_375_999.996])
def test_encoded_time_decodes_to_itself(name, unix_time, decoder):
    decoded = decoder.decode(decoder.encode(name, {"ins_unix_time": unix_time}), 0)
    assert decoded.values["ins_unix_time"] == pytest.approx(unix_time, abs=0.00501)


def test_encoded_bytes_by_hand(decoder):
    # -2.9 deg left positive is raw 29; counter 0 and the check nibble below it: the recorded frame.
    assert decoder.encode("Leaf_Steering", {"steering_wheel_angle": STRAIGHT}, 0).data == bytes.fromhex("1D000007B0")
    front = decoder.encode("Leaf_WheelSpeedFront", {"WheelSpeedFR": 76.83, "WheelSpeedFL": 77.015,
                                                    "VehicleSpeedABS": 74.40}, 7)
    assert front.data == bytes.fromhex("3C063C2B1D100763")
    assert (front.arbitration_id, front.is_extended_id) == (0x284, False)
    # A message outside the table, as the DBC has it.
    assert decoder.encode("Leaf_Gear", {"GearCode": 4}).data == bytes.fromhex("200000")


def test_a_value_beyond_the_range_is_sent_as_its_end(decoder):
    frame = decoder.encode("RT_VelocityLevel", {"ins_velocity_x": 1e6, "ins_velocity_y": 1e6})
    assert decoder.decode(frame, 0).values == {"ins_velocity_x": 327.67, "ins_velocity_y": 327.68}


def test_what_cannot_be_encoded(decoder):
    with pytest.raises(ValueError, match="nan cannot be encoded"):
        decoder.encode("Leaf_Steering", {"steering_wheel_angle": math.nan})
    with pytest.raises(KeyError, match="no signal wheel"):
        decoder.encode("Leaf_Steering", {"wheel": 1.0})
    with pytest.raises(KeyError, match="Nobody"):
        decoder.encode("Nobody", {})
