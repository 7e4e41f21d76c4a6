"""Decoding and encoding of frames: recorded bytes and known values; invalid frames update nothing."""

import itertools
import math

import can
import pytest
from canedge_bridge.decode import Decoder
from canedge_bridge.health import Health
from canedge_bridge.ins_time import replace_gps_time
from canedge_bridge.receiver import ReceiverStatus
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from st_core.errors import ConfigurationError

STEP = 10_000_000
RECORDED_ANGLE = math.radians(-2.9)


def encode_steering(decoder, count, angle=0.1):
    """angle: of the steering wheel [rad]."""
    return decoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, count)


def flip_bit(frame):
    """The frame with one bit of its payload flipped, so that its checksum is wrong."""
    return can.Message(arbitration_id=frame.arbitration_id, is_extended_id=False,
                       data=bytes([frame.data[0] ^ 1]) + bytes(frame.data[1:]))


def test_recorded_steering_frame(decoder, frame):
    decoded = decoder.decode(frame(0x002, "1D000007B0"), 5)
    assert decoded.values == {"steering_wheel_angle": pytest.approx(RECORDED_ANGLE)}
    assert (decoded.message, decoded.time_ns, decoded.valid) == ("Leaf_Steering", 5, True)


def test_recorded_wheel_speeds(dbc_file, signals_file, frame):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_WheelSpeedFront": "off"})
    values = decoder.decode(frame(0x284, "3C063C2B1D100000"), 0).values
    assert values["wheel_speed_front_right"] == pytest.approx(76.83 / 3.6)
    assert values["wheel_speed_front_left"] == pytest.approx(77.015 / 3.6)
    assert values["vehicle_speed"] == pytest.approx(74.40 / 3.6)


@pytest.mark.parametrize(("identifier", "data", "values"), [
    # 604: lateral velocity positive to the right.
    (0x604, "E803 3200", {"ins_velocity_x": 10.0, "ins_velocity_y": -0.5}),
    # 634: the same motion in ISO axes, lateral velocity positive to the left.
    (0x634, "E803 CEFF 0000", {"ins_velocity_x": 10.0, "ins_velocity_y": -0.5}),
    # 607: heading 0, 100 and 270 deg, clockwise from north; yaw is counter-clockwise from east.
    (0x607, "0000 0000 0000", {"ins_yaw": math.pi / 2}),
    (0x607, "1027 0000 0000", {"ins_yaw": math.radians(-10)}),
    (0x607, "7869 0000 0000", {"ins_yaw": math.radians(180)}),
    # 633: yaw -10.00 deg.
    (0x633, "18FC 0000 0000", {"ins_yaw": math.radians(-10)}),
    # 608: 20.00 deg/s about the downward axis is a right turn; 636: the same in ISO axes.
    (0x608, "0000 0000 D007", {"ins_yaw_rate": math.radians(-20)}),
    (0x636, "0000 0000 30F8", {"ins_yaw_rate": math.radians(-20)}),
])
def test_ins_signals_are_decoded_in_iso_axes(identifier, data, values, decoder, frame):
    decoded = decoder.decode(frame(identifier, data), 0).values
    assert set(decoded) == set(values)
    for name, value in values.items():
        error = decoded[name] - value
        assert (math.remainder(error, 2 * math.pi) if name == "ins_yaw" else error) == pytest.approx(0, abs=1e-9)


def read_unix_time(decoded):
    return replace_gps_time(decoded.values)["ins_unix_time"]


def test_gps_time_is_decoded_as_utc(decoder, frame):
    # 2021-06-01 10:00:18.25 GPS = 10:00:00.25 UTC
    assert read_unix_time(decoder.decode(frame(0x600, "15 14 06 01 19 12 00 0A"), 0)) == 1_622_541_600.25
    milliseconds = (1_622_541_618_250 - 315_964_800_000).to_bytes(6, "little")
    for offset in (b"\xee", b"\x12", b"\x00"):  # -18, +18, not sent
        decoded = decoder.decode(frame(0x630, milliseconds + offset), 0)
        assert read_unix_time(decoded) == pytest.approx(1_622_541_600.25, abs=1e-6)


def test_time_frame_of_a_unit_without_time_gives_nan(decoder, frame):
    assert math.isnan(read_unix_time(decoder.decode(frame(0x600, bytes(8)), 0)))
    assert math.isnan(read_unix_time(decoder.decode(frame(0x630, bytes(7)), 0)))


def test_unknown_error_and_remote_frames_are_counted_and_ignored(decoder, frame):
    assert decoder.decode(frame(0x123, "00"), 0) is None
    assert decoder.decode(can.Message(arbitration_id=0x002, is_extended_id=True, data=bytes(5)), 0) is None
    assert decoder.decode(frame(0x040, bytes(8), is_error_frame=True), 0) is None
    assert decoder.decode(frame(0x002, b"", is_remote_frame=True), 0) is None
    assert decoder.skipped == {"unknown": 2, "error": 1, "remote": 1}


@pytest.mark.parametrize("data", [b"", bytes(1), bytes(4), bytes(5) + b"\1", bytes(range(8))])
def test_frame_of_the_wrong_length_updates_nothing(data, decoder, frame):
    assert decoder.decode(frame(0x002, data), 7) is None
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_length, statistics.good, statistics.last_seen_ns) == (1, 0, None)


@pytest.mark.parametrize(("mode", "valid", "wrong", "last_ns"), [
    ("off", True, 0, STEP), ("warn", False, 1, STEP), ("drop", None, 1, 0)])
def test_frame_with_a_wrong_checksum_is_accepted_marked_or_dropped(mode, valid, wrong, last_ns, dbc_file, signals_file):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_Steering.checksum": mode})
    assert decoder.decode(encode_steering(decoder, 0), 0).valid
    decoded = decoder.decode(flip_bit(encode_steering(decoder, 1)), STEP)
    assert (decoded.valid if decoded else None) is valid
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_checksum, statistics.last_seen_ns) == (wrong, last_ns)
    # The counter of the rejected frame counts as received, so the next frame is valid.
    assert decoder.decode(encode_steering(decoder, 2), 2 * STEP).valid
    assert statistics.lost == 0


@pytest.mark.parametrize(("mode", "valid", "wrong", "last_ns"), [
    ("off", True, 0, STEP), ("warn", False, 1, STEP), ("drop", None, 1, 0)])
def test_frame_with_a_wrong_counter_is_accepted_marked_or_dropped(mode, valid, wrong, last_ns, dbc_file, signals_file):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_Steering.counter": mode})
    assert decoder.decode(encode_steering(decoder, 0), 0).valid
    decoded = decoder.decode(encode_steering(decoder, 4), STEP)
    assert (decoded.valid if decoded else None) is valid
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_counter, statistics.last_seen_ns) == (wrong, last_ns)
    assert statistics.lost == (0 if mode == "off" else 3)
    assert decoder.decode(encode_steering(decoder, 5), 2 * STEP).valid


def test_wheel_speeds_with_a_wrong_checksum_are_dropped_by_default(decoder):
    frame = decoder.encode("Leaf_WheelSpeedFront", {"vehicle_speed": 10.0}, 3)
    assert decoder.decode(frame, 0) is not None
    assert decoder.decode(flip_bit(frame), 1) is None


def test_invalid_checks_are_rejected(dbc_file, signals_file):
    for checks, text in (({"Leaf_Brake": "off"}, "check Leaf_Brake"),
                         ({"Leaf_Steering.crc": "off"}, "check Leaf_Steering.crc"),
                         ({"Leaf_Steering": "maybe"}, "'maybe' is not one of off, warn, drop")):
        with pytest.raises(ConfigurationError, match=text):
            Decoder(dbc_file, signals_file, checks=checks)


def test_value_that_is_not_finite_updates_nothing(dbc_file, edit_table, tmp_path, frame):
    text = dbc_file.read_text().replace('SG_ VelForward : 0|16@1- (0.01,0) [-327.68|327.67] "m/s" LOGGER\n'
                                        ' SG_ VelLateral : 16|16@1- (0.01,0) [-327.68|327.67] "m/s" LOGGER',
                                        'SG_ VelForward : 0|32@1- (1,0) [0|0] "m/s" LOGGER')
    path = tmp_path / "float.dbc"
    path.write_text(text + "\nSIG_VALTYPE_ 1540 VelForward : 1;\n")
    decoder = Decoder(path, edit_table(lambda m: m["RT_VelocityLevel"]["signals"].pop("VelLateral")))
    assert decoder.encode("RT_VelocityLevel", {"ins_velocity_x": 2.5}).data == bytes.fromhex("00002040")
    for data in ("0000C07F", "0000807F"):  # NaN, infinity
        assert decoder.decode(frame(0x604, data), 9) is None
    statistics = decoder.statistics("RT_VelocityLevel")
    assert (statistics.not_finite, statistics.last_seen_ns) == (2, None)


def test_named_value_of_the_steering_is_no_angle(dbc_file, signals_file, tmp_path):
    path = tmp_path / "named.dbc"
    path.write_text(dbc_file.read_text() + '\nVAL_ 2 SteeringWheelAngle 3000 "SNA" 0 "straight" ;\n')
    decoder = Decoder(path, signals_file)
    for count, (degrees, is_angle) in enumerate([(-300.0, False), (0.0, True), (0.1, True), (-300.0, False)]):
        decoded = decoder.decode(encode_steering(decoder, count, math.radians(degrees)), count * STEP)
        assert (decoded is not None) == is_angle, degrees
    assert decoder.statistics("Leaf_Steering").not_finite == 2


def test_named_value_of_a_signed_signal_may_be_given_as_unsigned_number(dbc_file, signals_file, tmp_path):
    path = tmp_path / "named.dbc"
    path.write_text(dbc_file.read_text() + '\nVAL_ 2 SteeringWheelAngle 65535 "SNA" ;\n')
    decoder = Decoder(path, signals_file)
    for count, raw in enumerate((-1, 1)):
        angle = decoder.table.messages["Leaf_Steering"].signals[0].dbc.scale * raw
        decoded = decoder.decode(encode_steering(decoder, count, math.radians(angle)), count * STEP)
        assert (decoded is None) == (raw == -1)


def test_implausible_angle_updates_nothing(decoder):
    assert decoder.decode(encode_steering(decoder, 0, 0.0), 0) is not None
    assert decoder.decode(encode_steering(decoder, 1, math.radians(1200)), STEP) is None
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.implausible, statistics.last_seen_ns) == (1, 0)


def test_frame_with_two_faults_is_one_bad_frame(dbc_file, signals_file):
    decoder = Decoder(dbc_file, signals_file, checks={"Leaf_Steering": "warn"})
    assert decoder.decode(encode_steering(decoder, 0, 0.0), 0) is not None
    assert decoder.decode(flip_bit(encode_steering(decoder, 1)), STEP) is not None
    assert decoder.decode(encode_steering(decoder, 4, math.radians(1200)), 2 * STEP) is None  # counter and angle
    assert decoder.decode(encode_steering(decoder, 5, math.radians(1200)), 3 * STEP) is None
    statistics = decoder.statistics("Leaf_Steering")
    assert (statistics.wrong_checksum, statistics.wrong_counter, statistics.implausible, statistics.bad) == (1, 1, 2, 3)
    health = Health("can0", decoder, ReceiverStatus, lambda: 0)
    assert {check.name: check.message for check in health.checks()}["frames"] == (
        "3 bad frames since the last report, 3 since start")


def test_wrong_byte_order_is_detected_while_steering(decoder):
    """The low and high bytes are interchanged, as if the DBC stated the wrong byte order."""
    assert decoder.plausibility_faults() == []
    accepted = 0
    for count in range(200):
        data = bytearray(encode_steering(decoder, count, math.radians(0.5 * count)).data)
        data[0], data[1] = data[1], data[0]
        swapped = can.Message(arbitration_id=2, is_extended_id=False, data=data)
        accepted += decoder.decode(swapped, count * STEP) is not None
    assert accepted <= 20
    assert "SteeringWheelAngle decodes to implausible values" in decoder.plausibility_faults()[0]
    # Ten consecutive plausible frames end it.
    results = [decoder.decode(encode_steering(decoder, count, 0.0), count * STEP) for count in range(200, 320)]
    assert decoder.plausibility_faults() == [] and results[-1] is not None and results[8] is None


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(identifier=st.integers(0, 0x7FF) | st.sampled_from([0x002, 0x284, 0x285, 0x600, 0x630, 0x604, 0x607]),
       data=st.binary(max_size=8), flags=st.sampled_from([{}, {"is_error_frame": True}, {"is_extended_id": True}]),
       time_ns=st.integers(-2**62, 2**62))
def test_decoder_accepts_any_frame(identifier, data, flags, time_ns, decoder):
    options = {"arbitration_id": identifier, "is_extended_id": False, "data": data} | flags
    decoder.decode(can.Message(**options), time_ns)


HOURLY_NS = itertools.count(0, 3600 * 10**9)  # after an hour any counter is valid


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-14.0, 14.0), count=st.integers(0, 1000))
def test_steering_is_unchanged_by_encoding_and_decoding(angle, count, decoder):
    decoded = decoder.decode(encode_steering(decoder, count, angle), next(HOURLY_NS))
    assert decoded.valid
    assert decoded.values["steering_wheel_angle"] == pytest.approx(angle, abs=math.radians(0.0501))


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(yaw=st.floats(-10.0, 10.0), name=st.sampled_from(["RT_HeadingPitchRoll", "RT_IsoOrientation"]))
def test_yaw_is_unchanged_by_encoding_and_decoding(yaw, name, decoder):
    frame = decoder.encode(name, {"ins_yaw": yaw})
    decoded = decoder.decode(frame, 0).values["ins_yaw"]
    assert math.remainder(decoded - yaw, 2 * math.pi) == pytest.approx(0, abs=math.radians(0.00501))
    word = int.from_bytes(frame.data[:2], "little")
    assert word <= 35999 if name == "RT_HeadingPitchRoll" else (word <= 18000 or word >= 65536 - 18000)


@pytest.mark.parametrize("name", ["RT_DateTime", "RT_MilliTime"])
@pytest.mark.parametrize("unix_time", [1_622_541_600.25, 1_483_228_799.99, 1_483_228_800.0, 1_325_375_999.996])
def test_time_is_unchanged_by_encoding_and_decoding(name, unix_time, decoder):
    decoded = decoder.decode(decoder.encode(name, {"ins_unix_time": unix_time}), 0)
    assert read_unix_time(decoded) == pytest.approx(unix_time, abs=0.00501)


def test_encoded_bytes(decoder):
    # -2.9 deg (left positive) is raw 29; with counter 0 and its check nibble this is the recorded frame.
    assert encode_steering(decoder, 0, RECORDED_ANGLE).data == bytes.fromhex("1D000007B0")
    front = decoder.encode("Leaf_WheelSpeedFront", {"WheelSpeedFR": 76.83, "WheelSpeedFL": 77.015,
                                                    "VehicleSpeedABS": 74.40}, 7)
    assert front.data == bytes.fromhex("3C063C2B1D100763")
    assert (front.arbitration_id, front.is_extended_id) == (0x284, False)
    # A message of the DBC that is not in the table.
    assert decoder.encode("Leaf_Gear", {"GearCode": 4}).data == bytes.fromhex("200000")


def test_encoded_values_saturate_at_the_range_of_the_signal(decoder):
    frame = decoder.encode("RT_VelocityLevel", {"ins_velocity_x": 1e6, "ins_velocity_y": 1e6})
    assert decoder.decode(frame, 0).values == {"ins_velocity_x": 327.67, "ins_velocity_y": 327.68}


def test_values_that_cannot_be_encoded_are_rejected(decoder):
    with pytest.raises(ValueError, match="nan cannot be encoded"):
        decoder.encode("Leaf_Steering", {"steering_wheel_angle": math.nan})
    with pytest.raises(KeyError, match="no signal wheel"):
        decoder.encode("Leaf_Steering", {"wheel": 1.0})
    with pytest.raises(KeyError, match="Unknown"):
        decoder.encode("Unknown", {})


def test_optional_messages_skipped_in_a_backlog_do_not_count_as_lost(decoder):
    for number in range(4):
        frames = [decoder.encode(name, {signal: 1.0}, number) for name, signal in (
            ("Leaf_Steering", "steering_wheel_angle"), ("Leaf_WheelSpeedFront", "vehicle_speed"))]
        results = [decoder.decode(frame, number * 10_000_000, needed_only=number == 2) for frame in frames]
        assert [result is not None for result in results] == [True, number != 2]
    wheels = decoder.statistics("Leaf_WheelSpeedFront")
    assert (wheels.good, wheels.bad, wheels.lost) == (3, 0, 0)
