"""The stream parser with valid, truncated, corrupted, reordered and duplicated bytes."""

import itertools
import math
from dataclasses import replace
from math import isnan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oxts_bridge import ncom
from oxts_bridge.channels import encode_channel
from oxts_bridge.file_decoder import KINDS, UNKNOWN_TIME, decode_file
from oxts_bridge.ncom import DUPLICATE, LATE, NEW, to_unix_nanoseconds
from oxts_bridge.stream import NcomParser
from trigger_bytes import encode_trigger

START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]


def reseal(data: bytes, **bytes_at: int) -> bytes:
    """Replaces bytes of a packet (b21=5) and recomputes the final checksum."""
    data = bytearray(data)
    for name, value in bytes_at.items():
        data[int(name[1:])] = value
    data[71] = sum(data[1:71]) & 0xFF
    return bytes(data)


def test_valid_packets(drive):
    parser = NcomParser()
    packets = drive(50)
    received = [r for data in packets for r in parser.feed(data, 1)]
    assert [r.raw for r in received] == packets
    assert [r.gps_ns for r in received] == [(START + 4 * i) * 1_000_000 for i in range(50)]
    assert {r.kind for r in received} == {"regular"} and all(r.order == NEW for r in received)
    assert received[0].utc_ns == received[0].gps_ns + (315_964_800 - 18) * 1_000_000_000
    counters = parser.counters
    assert (counters.packets, counters.checksum_errors, counters.skipped_bytes) == (50, 0, 0)


def test_packet_directly_after_a_false_sync_byte_is_found(drive):
    packets = drive(3)
    received = NcomParser().feed(packets[0] + b"\xe7" + packets[1] + b"\xe7\xe7\xe7" + packets[2])
    assert [r.raw for r in received] == packets


def test_checksum_errors_and_skipped_bytes_are_counted(drive):
    packets = drive(4)
    corrupted = packets[1][:40] + bytes([packets[1][40] ^ 4]) + packets[1][41:]
    parser = NcomParser()
    received = parser.feed(packets[0] + corrupted + packets[2] + b"junk" + packets[3])
    assert [r.raw for r in received] == [packets[0], packets[2], packets[3]]
    assert parser.counters.checksum_errors == 1
    assert parser.counters.skipped_bytes == 72 + 4


def test_truncated_datagram_does_not_affect_the_next_one(drive):
    p = drive(5)
    parser = NcomParser()
    received = [r for data in (p[0], p[1][:50], p[2], p[3][20:], p[4]) for r in parser.feed(data)]
    assert [r.raw for r in received] == [p[0], p[2], p[4]]


def test_all_three_checksums_are_required_after_other_data(drive):
    packets = drive(2)
    wrong_inner = reseal(packets[0], b61=(packets[0][61] + 1) & 0xFF)
    parser = NcomParser()
    assert [r.raw for r in parser.feed(b"junk" + wrong_inner + packets[1])] == [packets[1]]


def test_structure_b_is_counted_and_dropped_without_errors(drive):
    packets = drive(3)
    structure_b = reseal(packets[1], b21=11)
    parser = NcomParser()
    assert [r.raw for r in parser.feed(packets[0] + structure_b + packets[2])] == [packets[0], packets[2]]
    counters = parser.counters
    assert counters.structure_b == 1
    assert (counters.checksum_errors, counters.skipped_bytes, counters.inner_checksum_warnings) == (0, 0, 0)


@pytest.mark.parametrize("status", [0, 5, 6, 7, 8, 9, 12, 19, 23, 255])
def test_packets_with_a_status_without_navigation_have_no_values(drive, status):
    packets = drive(3)
    parser = NcomParser()
    received = parser.feed(packets[0] + reseal(packets[1], b21=status) + packets[2])
    middle = received[1]
    assert middle.kind == "empty" and middle.gps_ns is None
    values = [*middle.packet.acceleration, middle.packet.latitude, *middle.packet.velocity_ned, middle.packet.heading]
    assert all(isnan(value) for value in values)
    assert parser.counters.unknown_statuses == (status not in (0, 5, 6, 7))
    assert received[2].gps_ns == (START + 8) * 1_000_000


def test_raw_imu_packet_has_no_time_and_no_position(drive):
    received = NcomParser().feed(drive(1)[0] + reseal(drive(2)[1], b21=1))[1]
    assert received.gps_ns is None and isnan(received.packet.latitude)
    assert received.packet.acceleration[2] == pytest.approx(-9.81)


def test_packet_during_initialisation_is_approximate(drive):
    received = NcomParser().feed(reseal(drive(1)[0], b21=2))[0]
    assert received.rule.navigation == "approximate" and received.gps_ns is not None


@pytest.mark.parametrize("latitude", [2.0, 1.6, -1.6, -1e9, math.nan, math.inf])
def test_impossible_position_is_masked_and_counted(packet, latitude):
    parser = NcomParser()
    first, second = (one.packet for one in parser.feed(packet(START, 0, latitude=latitude) + packet(START + 4)))
    assert isnan(first.latitude) and isnan(first.longitude) and isnan(first.altitude) and not isnan(second.latitude)
    assert first.heading == pytest.approx(0.523599)
    assert parser.counters.impossible_positions == 1


def test_duplicated_and_reordered_datagrams(drive):
    packets = drive(6)
    parser = NcomParser()
    order = [r.order for i in (0, 1, 1, 3, 2, 4, 4, 5) for r in parser.feed(packets[i])]
    assert order == [NEW, NEW, DUPLICATE, NEW, LATE, NEW, DUPLICATE, NEW]
    assert (parser.counters.late, parser.counters.duplicates) == (1, 2)


def test_utc_offset_of_the_unit_replaces_that_of_the_table(packet):
    parser = NcomParser()
    offset = encode_channel(16, {"TimeUtcOffset": -18})
    received = parser.feed(packet(START, 0) + packet(START + 4, 16, batch_s=offset) + packet(START + 8, 3))
    assert [r.utc_ns - received[0].utc_ns for r in received] == [0, 4_000_000, 8_000_000]
    later = parser.feed(packet(START + 12, 16, batch_s=encode_channel(16, {"TimeUtcOffset": -19})))[0]
    assert later.utc_ns - received[0].utc_ns == 12_000_000 - 1_000_000_000
    parser.feed(packet(START + 16, 16, batch_s=encode_channel(16, {"TimeUtcOffset": 5})))
    assert parser.utc_offset == -19


def test_trigger_packets_have_their_own_time_and_do_not_affect_the_clock(packet):
    parser = NcomParser()
    event_ns = (START + 5) * 1_000_000 + 3_400_000 - 4_000
    trigger = packet(START + 8, 24, batch_s=encode_trigger(24, event_ns, 7), navigation_status=22)
    old = packet(START - 500, 43, batch_s=encode_trigger(43, event_ns - 500_000_000, 1), navigation_status=22)
    not_a_trigger = packet(START + 8, 3, navigation_status=22)
    received = parser.feed(packet(START, 0) + trigger + trigger + old + not_a_trigger + packet(START + 4, 3))
    assert [r.kind for r in received] == ["regular", "trigger", "trigger", "trigger", "empty", "regular"]
    assert [r.order for r in received] == [NEW, NEW, DUPLICATE, NEW, NEW, NEW]
    assert received[1].gps_ns == event_ns - event_ns % 4_000
    assert received[5].gps_ns == (START + 4) * 1_000_000
    assert parser.counters.late == 0


def test_restart_reports_the_events_again(packet):
    parser = NcomParser()
    event = encode_trigger(24, START * 1_000_000, 1)
    stream = packet(START, 0) + packet(START + 8, 24, batch_s=event, navigation_status=22) + b"".join(
        packet(START + 10 * k, 43, batch_s=encode_trigger(43, (START + 10 * k) * 1_000_000, k)) for k in (1, 2, 3))
    passes = []
    for _ in range(2):
        passes.append([(r.event_ns, r.order) for r in parser.feed(stream)])
        parser.restart()
    assert passes[0] == passes[1]
    assert [event_ns is not None for event_ns, _ in passes[0]] == [False, True, False, True, True]


def test_restart_resets_the_time_and_keeps_the_counts(drive):
    parser = NcomParser()
    parser.feed(b"".join(drive(20)) + drive(1)[0][:30])
    parser.restart()
    received = parser.feed(b"".join(drive(20)))
    assert len(received) == 20 and all(r.order == NEW for r in received)
    assert parser.counters.packets == 40 and parser.counters.skipped_bytes == 0


# Streams that were damaged in transmission


@st.composite
def damaged(draw, packets):
    """Datagrams after loss, repetition, swaps, truncation, bit errors and other data."""
    datagrams = list(packets)
    for _ in range(draw(st.integers(0, 12))):
        at = draw(st.integers(0, len(datagrams) - 1))
        kind = draw(st.sampled_from(["drop", "repeat", "swap", "head", "tail", "bit", "junk", "merge"]))
        if kind == "drop" and len(datagrams) > 1:
            del datagrams[at]
        elif kind == "repeat":
            datagrams.insert(draw(st.integers(at, min(at + 3, len(datagrams)))), datagrams[at])
        elif kind == "swap" and at + 1 < len(datagrams):
            datagrams[at], datagrams[at + 1] = datagrams[at + 1], datagrams[at]
        elif kind == "head":
            datagrams[at] = datagrams[at][draw(st.integers(0, 71)) :]
        elif kind == "tail":
            datagrams[at] = datagrams[at][: draw(st.integers(0, 71))]
        elif kind == "bit" and datagrams[at]:
            data = bytearray(datagrams[at])
            data[draw(st.integers(0, len(data) - 1))] ^= 1 << draw(st.integers(0, 7))
            datagrams[at] = bytes(data)
        elif kind == "junk":
            datagrams.insert(at, draw(st.binary(max_size=200)))
        elif kind == "merge" and at + 1 < len(datagrams):
            datagrams[at : at + 2] = [datagrams[at] + datagrams[at + 1]]
    return datagrams


@pytest.fixture(scope="module")
def wrapping_drive(drive):
    """A drive over the end of a minute, with channel 0 in every tenth packet."""
    return drive(60, 24_015_600 * 60_000 + 59_880)


@given(data=st.data())
def test_damaged_stream_never_raises_and_repeats_no_packet(wrapping_drive, data):
    parser = NcomParser()
    sent = set(wrapping_drive)
    received = [r for datagram in data.draw(damaged(wrapping_drive)) for r in parser.feed(datagram, None)]
    new = [r for r in received if r.order == NEW]
    times = [r.gps_ns for r in new if r.gps_ns is not None and r.kind == "regular" and r.raw in sent]
    if all(r.raw in sent for r in new):  # otherwise one bit error in 256 gives a valid packet with another time
        assert times == sorted(set(times))
        true_time = {raw: (24_015_600 * 60_000 + 59_880 + 4 * i) * 1_000_000 for i, raw in enumerate(wrapping_drive)}
        assert all(r.gps_ns in (None, true_time[r.raw]) for r in new)


@given(data=st.binary(max_size=1500), portions=st.lists(st.integers(1, 200), max_size=30))
def test_random_bytes_never_raise(data, portions):
    parser = NcomParser()
    for portion in portions:
        parser.feed(data[:portion])
        data = data[portion:]
    parser.feed(data)


@given(data=st.data(), portions=st.lists(st.integers(1, 300), min_size=1, max_size=8))
def test_result_does_not_depend_on_the_portions(wrapping_drive, data, portions):
    stream = b"".join(data.draw(damaged(wrapping_drive)))
    whole, portioned = NcomParser(), NcomParser()
    expected = whole.feed(stream)
    received = []
    for size in itertools.cycle(portions):
        received += portioned.feed(stream[:size])
        stream = stream[size:]
        if not stream:
            break
    found, reference = ([(r.offset, r.raw, r.gps_ns, r.order) for r in each] for each in (received, expected))
    assert found == reference
    assert whole.counters == portioned.counters


@given(data=st.data(), joined=st.booleans())
def test_file_decoder_equals_the_parser(wrapping_drive, packet, data, joined):
    """joined: a drive of half a day earlier follows."""
    stream = b"".join(data.draw(damaged(wrapping_drive)))
    if joined:
        earlier = [packet(START - 43_200_000 + 4 * i, 0 if i % 10 == 3 else 3) for i in range(30)]
        status_only = replace(ncom.decode(packet(START, 0)), navigation_status=10, milliseconds=0)
        stream += ncom.encode(status_only) + b"".join(data.draw(damaged(earlier)))
    parser = NcomParser()
    received = parser.feed(stream)
    if not parser.counters.packets:
        return
    columns = decode_file(stream)
    rows = [i for i in range(len(columns)) if columns.navigation_status[i] != ncom.STRUCTURE_B]
    assert columns.offset[rows].tolist() == [r.offset for r in received]
    assert [KINDS[kind] for kind in columns.kind[rows]] == [r.kind for r in received]
    assert columns.order[rows].tolist() == [r.order for r in received]
    assert columns.gps_ns[rows].tolist() == [UNKNOWN_TIME if r.gps_ns is None else r.gps_ns for r in received]
    assert columns.utc_ns[rows].tolist() == [UNKNOWN_TIME if r.utc_ns is None else r.utc_ns for r in received]
    counters = parser.counters
    assert (columns.checksum_errors, columns.skipped_bytes) == (counters.checksum_errors, counters.skipped_bytes)
    for i, r in zip(rows, received, strict=True):
        p = r.packet
        assert columns.acceleration[:, i] == pytest.approx(p.acceleration, rel=1e-15, nan_ok=True)
        assert columns.velocity_ned[:, i] == pytest.approx(p.velocity_ned, rel=1e-15, nan_ok=True)
        assert [columns.latitude[i], columns.altitude[i], columns.heading[i]] == pytest.approx(
            [p.latitude, p.altitude, p.heading], rel=1e-15, nan_ok=True)


@pytest.mark.parametrize("milliseconds", [60_000, 65_535])
def test_packet_with_impossible_milliseconds_has_no_time_and_does_not_affect_the_clock(drive, milliseconds):
    packets = drive(30)
    packets[12] = ncom.encode(replace(ncom.decode(packets[12]), milliseconds=milliseconds))
    parser = NcomParser()
    received = parser.feed(b"".join(packets))
    times = [None if i == 12 else (START + 4 * i) * 1_000_000 for i in range(30)]
    assert [r.gps_ns for r in received] == times and all(r.order == NEW for r in received)
    columns = decode_file(b"".join(packets))
    assert columns.gps_ns.tolist() == [UNKNOWN_TIME if time is None else time for time in times]
    assert (parser.counters.impossible_times, parser.counters.late, parser.clock.jumps) == (1, 0, 0)


@pytest.mark.parametrize("channel", [82, 83, 84, 86, 92, 96, 255])
def test_packets_with_channels_of_unknown_layout_are_valid_and_counted(packet, channel):
    """Channels of other products (xNAV) and of later firmware."""
    parser = NcomParser()
    received = parser.feed(packet(START, 0) + packet(START + 4, channel, batch_s=bytes(range(8))))
    assert received[1].gps_ns == (START + 4) * 1_000_000
    assert received[1].packet.latitude == received[0].packet.latitude
    assert parser.counters.unknown_channels == 1


@pytest.mark.parametrize("size", [1, 71, 72, 73, 144, 500, 1472])
def test_each_portion_gives_the_packets_it_completes(drive, size):
    """size: of serial bytes, parts of a file, full datagrams [bytes]."""
    packets = drive(40)
    stream = b"".join(packets)
    parser = NcomParser()
    received = []
    for at in range(0, len(stream), size):
        received += parser.feed(stream[at : at + size])
        assert len(received) == min(at + size, len(stream)) // 72
    assert [r.raw for r in received] == packets and parser.counters.skipped_bytes == 0
    assert [r.gps_ns for r in received] == [(START + 4 * i) * 1_000_000 for i in range(40)]


@pytest.mark.parametrize(("at", "accepted"), [(22, True), (61, True), (71, False)])
def test_only_the_final_checksum_is_decisive(drive, at, accepted):
    packets = drive(3)
    wrong = bytearray(packets[1])
    wrong[at] ^= 0x55
    data = bytes(wrong) if at == 71 else reseal(bytes(wrong))
    parser = NcomParser()
    received = parser.feed(packets[0] + data + packets[2])
    assert len(received) == 2 + accepted and received[-1].raw == packets[2]
    counters = parser.counters
    assert (counters.checksum_errors, counters.inner_checksum_warnings) == (int(not accepted), int(accepted))
    assert len(NcomParser().feed(data)) == accepted  # also at the start of a stream


def test_week_rollover_in_stream_and_file(drive):
    """GPS week 2382 to 2383 without channel 0 near it."""
    packets = drive(60, 10_080 * 2383 * 60_000 - 100, every=50)
    received = NcomParser().feed(b"".join(packets))
    times = [(10_080 * 2383 * 60_000 - 100 + 4 * i) * 1_000_000 for i in range(60)]
    assert [r.gps_ns for r in received] == times == decode_file(b"".join(packets)).gps_ns.tolist()


def test_minute_of_a_live_stream_is_from_the_host_until_the_unit_sends_it(drive):
    parser, first_ns = NcomParser(), to_unix_nanoseconds(START * 1_000_000)
    packets = [*drive(7, START, 500, every=0), *drive(1, START + 3_500), *drive(1, START + 4_000, every=0)]
    known = []
    for i, data in enumerate(packets):
        gps_ns = parser.feed(data, first_ns + 500_000_000 * i)[0].gps_ns
        assert gps_ns in (None, (START + 500 * i) * 1_000_000)
        known.append((gps_ns is not None, parser.minute_from_host))
    assert known == [(False, False)] * 5 + [(False, True), (True, True), (True, False), (True, False)]
    assert all(received.gps_ns is None for received in NcomParser().feed(b"".join(packets[:7])))


def test_late_packet_of_the_previous_minute_does_not_set_the_minute(drive):
    parser, change = NcomParser(), (START // 60_000 + 1) * 60_000
    packets = [*drive(5, change - 1_900, 500, every=0), *drive(1, change - 5, every=0),
               *drive(2, change + 600, 500, every=0)]
    after_ms = [*range(0, 2_001, 500), 2_200, 2_500, 3_000]  # time of receipt
    first_ns = to_unix_nanoseconds((change - 1_900) * 1_000_000)
    received = [parser.feed(data, first_ns + ms * 1_000_000)[0] for data, ms in zip(packets, after_ms, strict=True)]
    assert received[5].order == LATE
    assert received[-1].gps_ns == (change + 1_100) * 1_000_000
