"""Bytes from a UDP port on loopback and from a file."""

import math
import socket
import threading
import time

import pytest
from oxts_bridge.ncom import NcomError, decode
from oxts_bridge.sources import ReplaySource, UdpSource, continues_stream
from oxts_bridge.stream import NcomParser, StreamStatistics

START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]


def latitude_at(north):
    """Latitude [rad] at a distance north [m] of the unit."""
    return math.radians(52.0) + north / 6_375_500.0  # meridian radius


class Sink:
    """Stores what a source delivers, and can wait for it."""

    def __init__(self):
        self.parser = NcomParser()
        self.data, self.times, self.publish = [], [], []
        self.changes = 0
        self._condition = threading.Condition()

    def on_data(self, data, received_ns, publish):
        with self._condition:
            self.data.append(data)
            self.times.append(received_ns)
            self.publish.append(publish)
            self._condition.notify_all()
        return len(self.parser.feed(data))

    def on_change(self):
        with self._condition:
            self.changes += 1
            self._condition.notify_all()

    def wait(self, condition, limit=10.0):
        with self._condition:
            return self._condition.wait_for(condition, limit)


@pytest.fixture
def sink():
    return Sink()


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


@pytest.fixture
def udp(sink, port):
    """udp(sender_filter) -> a running source."""
    sources = []

    def start(sender_filter=""):
        source = UdpSource("127.0.0.1", port, sender_filter, sink.on_data, sink.on_change)
        source.start()
        sources.append(source)
        return source

    yield start
    for source in sources:
        source.stop()


def open_sender(address="127.0.0.1"):
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((address, 0))
    return sock


def send_until(sock, port, data, sink, condition):
    """Repeats the datagram until the source is open and the condition is true."""
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:
        sock.sendto(data, ("127.0.0.1", port))
        sink.wait(condition, 0.05)
    assert condition()


def test_every_datagram_is_received_with_a_kernel_time(udp, sink, port, drive):
    source = udp()
    packets = drive(200)
    with open_sender() as sock:
        send_until(sock, port, b"hello", sink, lambda: sink.data)
        sink.data.clear(), sink.times.clear()
        before = time.time_ns()
        for packet in packets:
            sock.sendto(packet, ("127.0.0.1", port))
        assert sink.wait(lambda: sink.data[-1:] == packets[-1:])
    assert [data for data in sink.data if data != b"hello"] == packets
    assert before - 1_000_000_000 < sink.times[0] <= sink.times[-1] <= time.time_ns()
    assert sink.times == sorted(sink.times)
    assert source.status.sender == "127.0.0.1"


def test_sender_filter_selects_one_sender(udp, sink, port, drive):
    source = udp("127.0.0.2")
    selected, ignored = drive(2)
    with open_sender("127.0.0.2") as unit, open_sender("127.0.0.3") as other:
        send_until(unit, port, selected, sink, lambda: sink.data)
        for _ in range(5):
            other.sendto(ignored, ("127.0.0.1", port))
        send_until(unit, port, selected, sink, lambda: source.status.ignored_datagrams.get("127.0.0.3", 0) == 5)
    assert set(sink.data) == {selected}
    assert source.status.sender == "127.0.0.2"


def test_first_unit_is_used_without_a_filter(udp, sink, port, drive):
    source = udp()
    selected, ignored = drive(2)
    with open_sender("127.0.0.2") as unit, open_sender("127.0.0.3") as other, open_sender("127.0.0.4") as no_unit:
        send_until(no_unit, port, b"not ncom", sink, lambda: sink.data)
        send_until(unit, port, selected, sink, lambda: source.status.sender == "127.0.0.2")
        for _ in range(5):
            other.sendto(ignored, ("127.0.0.1", port))
        send_until(unit, port, selected, sink, lambda: source.status.ignored_datagrams.get("127.0.0.3", 0) == 5)
    assert ignored not in sink.data


class TestTwoUnitsAtOneAddress:
    """The port and the continuity of the position distinguish two streams; the first one is used."""

    @pytest.fixture
    def source(self, sink, port):
        newest = []

        def on_data(data, received_ns, publish):
            newest[:] = [received.packet for received in NcomParser().feed(data)][-1:] or newest
            return sink.on_data(data, received_ns, publish)

        source = UdpSource("127.0.0.1", port, "", on_data, sink.on_change,
                           lambda data: continues_stream(newest[0], data))
        source.start()
        yield source
        source.stop()

    def test_stream_of_another_car_is_ignored_and_counted(self, source, sink, port, packet):
        with open_sender() as unit, open_sender() as other:
            send_until(unit, port, packet(START), sink, lambda: source.status.sender)
            for k in range(1, 21):
                other.sendto(packet(START + 4 * k, latitude=latitude_at(6.4)), ("127.0.0.1", port))
                unit.sendto(packet(START + 4 * k), ("127.0.0.1", port))
            send_until(unit, port, packet(START + 84), sink, lambda: source.status.competing_datagrams >= 20)
            name = f"127.0.0.1 port {other.getsockname()[1]}"
        assert source.status.ignored_datagrams == {name: 20}
        assert {data[23:31] for data in sink.data} == {packet(START)[23:31]}

    def test_datagrams_of_changing_ports_are_one_stream(self, source, sink, port, packet):
        with open_sender() as first:
            send_until(first, port, packet(START), sink, lambda: source.status.sender)
        sent = [packet(START + 4 * k, velocity_ned=(0.0, 0.0, 0.0)) for k in range(1, 21)]
        for data in sent:
            with open_sender() as sock:
                sock.sendto(data, ("127.0.0.1", port))
        assert sink.wait(lambda: sink.data[-20:] == sent)
        assert source.status.competing_datagrams == 0


@pytest.mark.parametrize(("changes", "continues"), [
    ({}, True),
    ({"latitude": latitude_at(0.1)}, True),  # the distance driven in 10 ms
    ({"latitude": latitude_at(640.0)}, False),
    ({"latitude": latitude_at(-6.4)}, False),
    ({"latitude": math.nan}, False), ({"latitude": math.inf}, False), ({"altitude": math.inf}, False),
])
def test_stream_continues_at_a_reachable_position(packet, changes, continues):
    newest, later = decode(packet(START)), packet(START + 10, **changes)
    assert continues_stream(newest, later) is continues
    assert not continues_stream(None, later)  # no packet before
    assert not continues_stream(newest, packet(START, **changes))  # not later
    assert not continues_stream(newest, packet(START + 5000, **changes))  # too late
    assert not continues_stream(newest, b"not ncom")


def test_busy_port_is_reported_and_opened_when_it_is_free(udp, sink, port, drive):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))  # without address reuse
        source = udp()
        assert sink.wait(lambda: source.status.problem)
        assert f"127.0.0.1 port {port}: Address already in use" in source.status.problem
    assert sink.wait(lambda: source.status.problem == "" and sink.changes == 2)
    with open_sender() as sock:
        send_until(sock, port, drive(1)[0], sink, lambda: sink.data)


def test_two_programs_can_receive_on_one_port(udp, sink, port):
    first, second = udp(), udp()
    time.sleep(0.3)
    assert (first.status.problem, second.status.problem) == ("", "")
    assert (first.status.is_shared, second.status.is_shared) == (False, True)


def replay(path, sink, **options):
    source = ReplaySource(path, sink.on_data, sink.on_change, **options)
    source.start()
    return source


def test_replay_sends_every_packet_in_order_and_not_early(tmp_path, sink, drive):
    packets = drive(60, step_ms=10)
    (tmp_path / "a.ncom").write_bytes(b"junk".join(packets))
    delivered = []  # monotonic times [s], as in a replay

    def on_data(data, received_ns, publish):
        delivered.append(time.monotonic())
        if len(delivered) == 1:
            time.sleep(0.005)  # after this delay the following packets catch up, but none is early
        return sink.on_data(data, received_ns, publish)

    source = ReplaySource(tmp_path / "a.ncom", on_data, sink.on_change, speed_factor=20.0)
    began = time.monotonic()
    source.start()
    assert sink.wait(lambda: len(sink.data) == 60)
    source.stop()
    assert sink.data == packets
    assert (source.status.progress, source.status.datagrams) == (1.0, 60)
    # 10 ms between packets in the file, at 20 times the speed.
    assert not [k for k, at in enumerate(delivered) if at < began + k * 0.010 / 20]


def test_replay_from_an_offset_reads_the_status_from_the_start(tmp_path, sink, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(100, step_ms=10)))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=100.0, start_offset=0.5)
    assert sink.wait(lambda: len(sink.data) == 100)
    source.stop()
    assert sink.publish == [False] * 50 + [True] * 50


def test_packets_before_the_offset_take_no_time_of_the_replay(tmp_path, sink, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(60, step_ms=10)))
    times = []  # monotonic [s]

    def on_data(data, received_ns, publish):
        times.append(time.monotonic())
        if not publish:
            time.sleep(0.01)
        return sink.on_data(data, received_ns, publish)

    source = ReplaySource(tmp_path / "a.ncom", on_data, sink.on_change, start_offset=0.3)
    source.start()
    assert sink.wait(lambda: len(sink.data) == 60)
    source.stop()
    assert times[59] - times[29] >= 0.15  # 0.29 s in the file, less a delay of the last packet before the offset

    source = ReplaySource(tmp_path / "a.ncom", on_data, sink.on_change, start_offset=10.0)
    source.start()
    assert sink.wait(lambda: len(sink.data) > 60)
    source.stop()
    assert len(sink.data) < 120


def test_replay_loops(tmp_path, sink, drive):
    packets = drive(20)
    (tmp_path / "a.ncom").write_bytes(b"".join(packets))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=100.0, loop=True)
    assert sink.wait(lambda: len(sink.data) >= 60)
    source.stop()
    assert sink.data[:60] == packets * 3
    assert sink.changes == source.status.loops >= 2


def test_replay_skips_time_gaps_in_a_joined_file(tmp_path, sink, drive):
    packets = drive(20) + drive(20, 24_015_600 * 60_000 + 7_200_000) + drive(20)
    (tmp_path / "a.ncom").write_bytes(b"".join(packets))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=10.0)
    assert sink.wait(lambda: len(sink.data) == 60)
    source.stop()


def test_replay_sends_packets_without_a_time(tmp_path, sink, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(20, every=0)))
    source = replay(tmp_path / "a.ncom", sink)
    assert sink.wait(lambda: len(sink.data) == 20)
    source.stop()


def test_replay_of_another_file_is_rejected_at_once(tmp_path, sink):
    (tmp_path / "a.ncom").write_bytes(b"text " * 100)
    with pytest.raises(NcomError, match=r"a\.ncom: no NCOM packet"):
        ReplaySource(tmp_path / "a.ncom", sink.on_data, sink.on_change)


def test_statistics_give_rate_gaps_and_clock_offset(drive):
    statistics, parser = StreamStatistics(), NcomParser()
    packets = drive(251)
    del packets[100:103]
    for i, data in enumerate(packets):
        for received in parser.feed(data):
            received.received_ns = received.utc_ns + 3_000_000 + (50_000_000 if i == 200 else 0)
            statistics.add(received)
    assert statistics.gaps == 1
    assert statistics.summarise_steps() == (pytest.approx(247.0), pytest.approx(0.016))
    assert statistics.summarise_clock_offset()[0] == pytest.approx(-0.003)
    assert statistics.summarise_steps() == (0.0, 0.0)
