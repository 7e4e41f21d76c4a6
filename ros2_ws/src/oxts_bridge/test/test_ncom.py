"""Encoding and decoding of one packet."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge import ncom
from oxts_bridge.channels import decode_channel, encode_channel

EXAMPLE = bytes.fromhex(
    "e7 00 87 d2 04 00 d2 e9 ff cc 80 fe ce ff ff 19 00 00 39 30 00 04 b3 7d 3f c6 c7 d2 0a ed 3f 87 44 e7 4a 18"
    "57 96 bf 00 00 c9 42 a0 86 01 50 c3 00 78 ec ff 4f fd 07 e2 54 01 3b 56 fd 37 00 f0 72 6e 01 0e 06 06 06 5f"
)


def example() -> ncom.Packet:
    status = encode_channel(0, {"GpsMinutes": 24015600, "GpsNumObs": 14, "GpsPosMode": 6, "GpsVelMode": 6,
                                "GpsAttMode": 6})
    return ncom.Packet(
        milliseconds=34560, acceleration=(0.1234, -0.5678, -9.81), angular_rate=(-0.0005, 0.00025, 0.12345),
        navigation_status=4, latitude=math.radians(52), longitude=math.radians(-1.25), altitude=100.5,
        velocity_ned=(10.0, 5.0, -0.5), heading=math.radians(30), pitch=math.radians(5), roll=math.radians(-10),
        channel=0, batch_s=status)


def test_encode_example():
    assert ncom.encode(example()) == EXAMPLE


def test_decode_example():
    packet, expected = ncom.decode(EXAMPLE), example()
    assert (packet.milliseconds, packet.navigation_status, packet.channel) == (34560, 4, 0)
    assert packet.acceleration == pytest.approx(expected.acceleration, abs=5e-5)
    assert packet.angular_rate == pytest.approx(expected.angular_rate, abs=5e-6)
    assert (packet.latitude, packet.longitude, packet.altitude) == (expected.latitude, expected.longitude, 100.5)
    assert packet.velocity_ned == pytest.approx((10, 5, -0.5), abs=5e-5)
    assert (packet.heading, packet.pitch, packet.roll) == pytest.approx(
        (expected.heading, expected.pitch, expected.roll), abs=5e-7)
    assert decode_channel(0, packet.batch_s)["GpsMinutes"] == 24015600


def test_invalid_components_are_decoded_as_nan():
    data = bytearray(EXAMPLE)
    for at in (*range(3, 21, 3), *range(43, 61, 3)):
        data[at : at + 3] = b"\x00\x00\x80"
    packet = ncom.decode(bytes(data))
    values = [*packet.acceleration, *packet.angular_rate, *packet.velocity_ned, packet.heading, packet.pitch,
              packet.roll]
    assert all(math.isnan(value) for value in values)
    assert packet.latitude == math.radians(52)
    assert ncom.encode(packet)[3:21] == data[3:21]


@pytest.mark.parametrize(("value", "raw"), [
    (838.8607, 0x7FFFFF), (1e9, 0x7FFFFF), (math.inf, 0x7FFFFF), (-838.8607, -0x7FFFFF), (-1e9, -0x7FFFFF),
    (math.nan, -0x800000),
])
def test_too_large_values_saturate_and_are_not_invalid(value, raw):
    packet = example()
    packet.acceleration = (value, 0.0, 0.0)
    assert int.from_bytes(ncom.encode(packet)[3:6], "little", signed=True) == raw


def test_ranges_of_the_three_checksums():
    data = ncom.encode(example())
    assert data[22] == sum(data[1:22]) % 256
    assert data[61] == sum(data[1:61]) % 256
    assert data[71] == sum(data[1:71]) % 256
    assert ncom.inner_checksums_match(data)
    assert not ncom.inner_checksums_match(data[:22] + bytes([data[22] ^ 1]) + data[23:])
    assert not ncom.inner_checksums_match(data[:61] + bytes([data[61] ^ 1]) + data[62:])


@pytest.mark.parametrize("data", [b"", EXAMPLE[:71], EXAMPLE + b"\0", b"\0" + EXAMPLE[1:]])
def test_bytes_that_are_not_a_packet_are_rejected(data):
    with pytest.raises(ncom.NcomError, match="not an NCOM packet"):
        ncom.decode(data)


def test_structure_b_is_rejected():
    data = EXAMPLE[:21] + bytes([11]) + EXAMPLE[22:]
    with pytest.raises(ncom.NcomError, match="structure B"):
        ncom.decode(data)


@pytest.mark.parametrize(("name", "value"), [
    ("milliseconds", 65536), ("milliseconds", -1), ("channel", 256), ("batch_s", b"123"), ("navigation_status", 300),
    ("navigation_status", 11), ("altitude", 1e300),
])
def test_value_that_cannot_be_encoded_is_rejected(name, value):
    packet = example()
    setattr(packet, name, value)
    with pytest.raises(ncom.NcomError):
        ncom.encode(packet)


def component(limit):
    return st.floats(-limit, limit) | st.just(math.nan)


@given(
    acceleration=st.tuples(*[component(838.0)] * 3),
    rate=st.tuples(*[component(83.0)] * 3),
    velocity=st.tuples(*[component(838.0)] * 3),
    angles=st.tuples(*[component(8.3)] * 3),
    latitude=st.floats(-1.6, 1.6),
    longitude=st.floats(-3.2, 3.2),
    altitude=st.floats(-500, 9000, width=32),
    status=st.integers(0, 255).filter(lambda number: number != 11),
    channel=st.integers(0, 255),
    batch_s=st.binary(min_size=8, max_size=8),
    ms=st.integers(0, 65535),
)
def test_decoded_packet_equals_the_encoded_one_within_half_a_unit(
    acceleration, rate, velocity, angles, latitude, longitude, altitude, status, channel, batch_s, ms
):
    data = ncom.encode(ncom.Packet(ms, acceleration, rate, status, latitude, longitude, altitude, velocity, *angles,
                                   channel, batch_s))
    decoded = ncom.decode(data)
    assert decoded.acceleration == pytest.approx(acceleration, abs=0.51e-4, nan_ok=True)
    assert decoded.angular_rate == pytest.approx(rate, abs=0.51e-5, nan_ok=True)
    assert decoded.velocity_ned == pytest.approx(velocity, abs=0.51e-4, nan_ok=True)
    assert (decoded.heading, decoded.pitch, decoded.roll) == pytest.approx(angles, abs=0.51e-6, nan_ok=True)
    assert (decoded.latitude, decoded.longitude, decoded.altitude) == (latitude, longitude, altitude)
    assert (decoded.milliseconds, decoded.navigation_status) == (ms, status)
    assert (decoded.channel, decoded.batch_s) == (channel, batch_s)
    assert ncom.encode(decoded) == data
