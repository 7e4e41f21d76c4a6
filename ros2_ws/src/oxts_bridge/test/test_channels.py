"""Status channels: 8 bytes to named values and back."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge.channels import FIELDS, TABLE, TRIGGER_CHANNELS, decode_channel, decode_event_time, encode_channel
from oxts_bridge.ncom import NcomError
from oxts_bridge.status import decode_up_time
from trigger_bytes import encode_trigger

# The manual lists these without a layout.
UNPUBLISHED = {82, 83, 84, 86, 92}


def test_every_channel_with_a_published_layout_is_in_the_table():
    assert set(TABLE) == set(range(96)) - UNPUBLISHED
    assert sorted(FIELDS) == sorted(TABLE)


def test_names_of_fields_are_unique_in_a_channel():
    assert all(len(FIELDS[channel]) == len(fields) for channel, fields in TABLE.items())


@given(channel=st.sampled_from(sorted(TABLE)), data=st.binary(min_size=8, max_size=8), fresh=st.booleans())
def test_decoded_values_are_unchanged_by_encoding(channel, data, fresh):
    """Encoding is stable, too: decoding and encoding the written bytes reproduces them."""
    if fresh:  # most channels are valid only if this byte marks their values as new
        data = data[:6] + b"\0" + data[7:]
    if channel == 57:  # the encoder always writes the multiplier 1
        data = data[:7] + b"\1"
    values = decode_channel(channel, data)
    written = encode_channel(channel, values)
    decoded = decode_channel(channel, written)
    assert decoded == {name: pytest.approx(value, rel=1e-12) if isinstance(value, float) else value
                       for name, value in values.items()}
    assert encode_channel(channel, decoded) == written


@pytest.mark.parametrize(("channel", "data"), [
    (0, "f0726e010e060606"), (1, "0305070b0df1f3ff"), (2, "0102030405060708"), (3, "14001e0032000003"),
    (13, "640038ff2a00005a"), (16, "9cff6400f6ff00db"), (18, "0102030405060708"), (19, "3038393332362e78"),
    (24, "f0726e016400fb07"), (30, "0102034e880012ab"), (32, "0305070b0df1f3ff"), (48, "f427070bff010002"),
    (50, "ffff00000100fe00"), (55, "f450070b0c065b78"), (64, "0102030821320701"), (66, "00e1f50500ca9a3b"),
    (95, "0102030507e803ff"),
])
def test_bytes_with_a_published_meaning_are_unchanged_by_decoding_and_encoding(channel, data):
    raw = bytes.fromhex(data)
    written = encode_channel(channel, decode_channel(channel, raw))
    described = {48: [0, 1, 2, 3, 5, 6, 7], 95: [0, 1, 2, 3, 4, 5, 6]}.get(channel, range(8))
    assert [written[i] for i in described] == [raw[i] for i in described]


@pytest.mark.parametrize("channel", sorted(TABLE))
def test_fields_without_a_value_are_encoded_as_invalid(channel):
    values = decode_channel(channel, encode_channel(channel, {}))
    for name, value in values.items():
        field = FIELDS[channel][name]
        assert value is None or field.validity.text == "none", name


def test_values_computed_by_hand():
    assert decode_channel(3, bytes([0xE8, 3, 0xD0, 7, 0xB8, 0x0B, 149, 0xFF])) == {
        "NorthAcc": 1.0, "EastAcc": 2.0, "AltAcc": 3.0, "UmacStatus": None}
    assert decode_channel(3, bytes([0xE8, 3, 0xD0, 7, 0xB8, 0x0B, 150, 4]))["NorthAcc"] is None
    assert decode_channel(16, b"\0" * 7 + bytes([0xDD]))["TimeUtcOffset"] == -18
    assert decode_channel(16, b"\0" * 7 + bytes([0xDC]))["TimeUtcOffset"] is None
    assert decode_channel(48, b"\x74\x28\x0a\x14" + b"\xff" * 4)["Undulation"] == pytest.approx(51.78)
    assert decode_channel(48, b"\x00\x80" + b"\xff" * 6)["Undulation"] is None
    assert decode_channel(48, b"\xff" * 8)["Undulation"] is None
    assert decode_channel(48, b"\xff\xff\x0a\x14" + b"\xff" * 4)["Undulation"] == pytest.approx(-0.005)
    innovations = decode_channel(1, bytes([0x15, 0xEB, 0x14, 1, 1, 1, 1, 1]))
    assert (innovations["InnPosX"], innovations["InnPosY"]) == pytest.approx((1.0, -1.1))
    assert innovations["InnPosZ"] is None
    assert decode_channel(57, bytes([0xE8, 3, 0, 0, 0, 0, 0, 2]))["GAPx"] == pytest.approx(2.0)
    assert decode_channel(57, bytes([0xE8, 3, 0, 0, 0, 0, 0, 0xFF]))["GAPx"] == pytest.approx(1.0)
    assert decode_channel(19, b"A~\x7f\x1f\0abc")["DevId"] == "A~\\x7f\\x1f"
    assert decode_channel(63, struct.pack("<ff", -0.5, 0.25)) == {"AngAccFiltFreq": None, "AngAccFiltZeta": 0.25}
    assert decode_channel(200, b"\0" * 8) == {}


def test_nan_is_encoded_as_invalid_and_infinity_saturates():
    unknown = {"NorthAcc": math.nan, "EastAcc": math.nan, "AltAcc": math.nan}
    assert encode_channel(3, unknown) == encode_channel(3, {})
    assert decode_channel(3, encode_channel(3, dict.fromkeys(unknown, math.inf)))["EastAcc"] == 65.535


def test_values_saturate_at_the_largest_that_can_be_encoded():
    values = decode_channel(3, encode_channel(3, {"NorthAcc": 1e6, "EastAcc": 0.0, "AltAcc": 65.535}))
    assert (values["NorthAcc"], values["EastAcc"], values["AltAcc"]) == (65.535, 0.0, 65.535)
    # 0xFFFF means invalid here, so the largest value is one below.
    assert decode_channel(44, encode_channel(44, {"WSpeedScale": 1e9}))["WSpeedScale"] == pytest.approx(6553.4)


@pytest.mark.parametrize(("channel", "values", "text"), [
    (3, {"NorthAcc": 1.0}, "all or none"),
    (0, {"GpsPosMode": 200}, "does not fit"),
    (0, {"GpsPosMode": 300}, "does not fit"),
    (3, {"Northacc": 1.0}, "has no field Northacc"),
    (84, {}, "no published layout"),
    (31, {"PsrDiffEnabled": 1}, "all or none"),
    (63, {"AngAccFiltFreq": 1e39}, "AngAccFiltFreq: 1e[+]39 does not fit"),
])
def test_invalid_values_are_rejected(channel, values, text):
    with pytest.raises(NcomError, match=text):
        encode_channel(channel, values)


@given(channel=st.sampled_from(sorted(TRIGGER_CHANNELS)), gps_ns=st.integers(60_000_000_000, 1_800_000_000_000_000_000),
       count=st.integers(1, 255))
def test_event_times_have_a_resolution_of_four_microseconds(channel, gps_ns, count):
    data = encode_trigger(channel, gps_ns, count)
    assert abs(decode_event_time(channel, data) - gps_ns) <= 2_000
    assert data[7] == count
    assert int.from_bytes(data[4:6], "little") < 60_000


@pytest.mark.parametrize(("fine", "fine_ns"), [(-125, -500_000), (125, 500_000)])
def test_event_time_with_a_fine_part_of_either_sign(fine, fine_ns):
    data = encode_channel(24, {"TrigMinutes": 24015600, "TrigMilliseconds": 500, "TrigFine": fine, "TrigCount": 3})
    assert decode_event_time(24, data) == 24015600 * 60_000_000_000 + 500_000_000 + fine_ns


@pytest.mark.parametrize(("minutes", "count"), [(-10080, 0), (0, 3), (24015600, 0), (2_000_000_000, 3)])
def test_invalid_event_has_no_time(minutes, count):
    assert decode_event_time(24, minutes.to_bytes(4, "little", signed=True) + b"\0\0\0" + bytes([count])) is None


@pytest.mark.parametrize(("code", "seconds"), [
    (0, 0), (10_800, 10_800), (10_801, 181 * 60), (20_700, 604_800), (20_701, 169 * 3600), (65_534, 45_002 * 3600)])
def test_up_time_in_seconds_minutes_and_hours(code, seconds):
    assert decode_up_time(code) == seconds
