"""Bytes from a real UDP port on loopback and from a file."""

import math
import socket
import threading
import time

import pytest
from oxts_bridge.ncom import NcomError, decode
from oxts_bridge.sources import EARTH_RADIUS, Continuity, ReplaySource, UdpSource, is_address
from oxts_bridge.stream import NcomParser, StreamStatistics

START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]


def elsewhere(north):
    """Latitude [rad] so many metres further north."""
    return math.radians(52.0) + north / EARTH_RADIUS


class Sink:
    """Takes what a source hands over, and can wait for it."""

    def __init__(self):
        self.parser = NcomParser()
        self.data, self.times, self.wanted = [], [], []
        self.changes = 0
        self._news = threading.Condition()

    def take(self, data, received_ns, wanted):
        with self._news:
            self.data.append(data)
            self.times.append(received_ns)
            self.wanted.append(wanted)
            self._news.notify_all()
        return len(self.parser.feed(data))

    def changed(self):
        with self._news:
            self.changes += 1
            self._news.notify_all()

    def wait(self, condition, limit=10.0):
        with self._news:
            return self._news.wait_for(condition, limit)


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
        source = UdpSource("127.0.0.1", port, sender_filter, sink.take, sink.changed)
        source.start()
        sources.append(source)
        return source

    yield start
    for source in sources:
        source.stop()


def sender(address="127.0.0.1"):
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((address, 0))
    return sock


def send_until(sock, port, data, sink, condition):
    """Repeats until the source is open and has taken it."""
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:
        sock.sendto(data, ("127.0.0.1", port))
        sink.wait(condition, 0.05)
    assert condition()


def test_every_datagram_arrives_with_the_kernels_time(udp, sink, port, drive):
    source = udp()
    packets = drive(200)
    with sender() as sock:
        send_until(sock, port, b"hello", sink, lambda: sink.data)
        sink.data.clear(), sink.times.clear()
        before = time.time_ns()
        for packet in packets:
            sock.sendto(packet, ("127.0.0.1", port))
        assert sink.wait(lambda: sink.data[-1:] == packets[-1:])
    arrived = [data for data in sink.data if data != b"hello"]
    assert arrived == packets
    assert before - 1_000_000_000 < sink.times[0] <= sink.times[-1] <= time.time_ns()
    assert sink.times == sorted(sink.times)
    assert source.status.sender == "127.0.0.1"


def test_only_the_wanted_sender_is_heard(udp, sink, port, drive):
    source = udp("127.0.0.2")
    ours, foreign = drive(2)
    with sender("127.0.0.2") as unit, sender("127.0.0.3") as other:
        send_until(unit, port, ours, sink, lambda: sink.data)
        for _ in range(5):
            other.sendto(foreign, ("127.0.0.1", port))
        send_until(unit, port, ours, sink, lambda: source.status.ignored.get("127.0.0.3", 0) == 5)
    assert set(sink.data) == {ours}
    assert source.status.sender == "127.0.0.2"


def test_without_a_filter_the_first_unit_is_kept(udp, sink, port, drive):
    source = udp()
    ours, foreign = drive(2)
    with sender("127.0.0.2") as unit, sender("127.0.0.3") as other, sender("127.0.0.4") as junk:
        send_until(junk, port, b"not ncom", sink, lambda: sink.data)
        send_until(unit, port, ours, sink, lambda: source.status.sender == "127.0.0.2")
        for _ in range(5):
            other.sendto(foreign, ("127.0.0.1", port))
        send_until(unit, port, ours, sink, lambda: source.status.ignored.get("127.0.0.3", 0) == 5)
    assert foreign not in sink.data


class TestTwoOnOneAddress:
    """The port and where the stream has been decide; the one that was there stays."""

    @pytest.fixture
    def source(self, sink, port):
        stream = Continuity()

        def take(data, received_ns, wanted):
            for packet in NcomParser().feed(data):
                stream.update(packet.packet)
            return sink.take(data, received_ns, wanted)

        source = UdpSource("127.0.0.1", port, "", take, sink.changed, stream.continues)
        source.start()
        yield source
        source.stop()

    def test_another_car_is_ignored_and_counted(self, source, sink, port, packet):
        with sender() as unit, sender() as other:
            send_until(unit, port, packet(START), sink, lambda: source.status.sender)
            for k in range(1, 21):
                other.sendto(packet(START + 4 * k, latitude=elsewhere(6.4)), ("127.0.0.1", port))
                unit.sendto(packet(START + 4 * k), ("127.0.0.1", port))
            send_until(unit, port, packet(START + 84), sink, lambda: source.status.ignored_ports >= 20)
            name = f"127.0.0.1 port {other.getsockname()[1]}"
        assert source.status.ignored == {name: 20}
        assert {data[23:31] for data in sink.data} == {packet(START)[23:31]}

    def test_a_port_for_every_datagram_is_one_stream(self, source, sink, port, packet):
        with sender() as first:
            send_until(first, port, packet(START), sink, lambda: source.status.sender)
        sent = [packet(START + 4 * k, velocity_ned=(0.0, 0.0, 0.0)) for k in range(1, 21)]
        for data in sent:
            with sender() as sock:
                sock.sendto(data, ("127.0.0.1", port))
        assert sink.wait(lambda: sink.data[-20:] == sent)
        assert source.status.ignored_ports == 0


@pytest.mark.parametrize(("changes", "follows"), [
    ({}, True),
    ({"latitude": elsewhere(0.1)}, True),  # what it drove meanwhile
    ({"latitude": elsewhere(640.0)}, False),
    ({"latitude": elsewhere(-6.4)}, False),
    ({"latitude": math.nan}, False),
])
def test_what_continues_a_stream(packet, changes, follows):
    stream = Continuity()
    later = packet(START + 10, **changes)
    assert not stream.continues(later)  # nothing to go on from
    stream.update(decode(packet(START)))
    assert stream.continues(later) is follows
    assert not stream.continues(packet(START, **changes))  # not later
    assert not stream.continues(packet(START + 5000, **changes))  # too long ago
    assert not stream.continues(b"not ncom")


def test_a_busy_port_is_told_and_taken_when_it_is_free(udp, sink, port, drive):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", port))  # without address reuse
        source = udp()
        assert sink.wait(lambda: source.status.problem)
        assert f"127.0.0.1 port {port}: Address already in use" in source.status.problem
    assert sink.wait(lambda: source.status.problem == "" and sink.changes == 2)
    with sender() as sock:
        send_until(sock, port, drive(1)[0], sink, lambda: sink.data)


def test_two_programs_can_listen(udp, sink, port):
    first, second = udp(), udp()
    assert sink.wait(lambda: False, 0.3) is False
    assert (first.status.problem, second.status.problem) == ("", "")


@pytest.mark.parametrize(
    ("text", "valid"), [("127.0.0.1", True), ("::1", True), ("localhost", False), ("", False), ("192.168.1", False)]
)
def test_addresses(text, valid):
    assert is_address(text) is valid


def replay(path, sink, **options):
    source = ReplaySource(path, sink.take, sink.changed, **options)
    source.start()
    return source


def test_replay_gives_every_packet_in_order(tmp_path, sink, drive):
    packets = drive(60, step_ms=10)
    (tmp_path / "a.ncom").write_bytes(b"junk".join(packets))
    arrived = []  # by the clock a replay keeps time with, which nobody sets [s]

    def take(data, received_ns, wanted):
        arrived.append(time.monotonic())
        if len(arrived) == 1:
            time.sleep(0.005)  # the first is held up: the others catch up, and are not early for that
        return sink.take(data, received_ns, wanted)

    source = ReplaySource(tmp_path / "a.ncom", take, sink.changed, speed_factor=20.0)
    began = time.monotonic()
    source.start()
    assert sink.wait(lambda: len(sink.data) == 60)
    source.stop()
    assert sink.data == packets
    assert (source.status.progress, source.status.datagrams) == (1.0, 60)
    # 10 ms of file from each to the next, at 20 times its pace; never before its time.
    assert not [k for k, at in enumerate(arrived) if at < began + k * 0.010 / 20]


def test_replay_from_an_offset_still_sets_the_status_from_the_start(tmp_path, sink, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(100, step_ms=10)))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=100.0, start_offset=0.5)
    assert sink.wait(lambda: len(sink.data) == 100)
    source.stop()
    assert sink.wanted == [False] * 50 + [True] * 50


def test_replay_loops(tmp_path, sink, drive):
    packets = drive(20)
    (tmp_path / "a.ncom").write_bytes(b"".join(packets))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=100.0, loop=True)
    assert sink.wait(lambda: len(sink.data) >= 60)
    source.stop()
    assert sink.data[:60] == packets * 3
    assert sink.changes == source.status.loops >= 2


def test_replay_does_not_sit_through_a_joined_file(tmp_path, sink, drive):
    packets = drive(20) + drive(20, 24_015_600 * 60_000 + 7_200_000) + drive(20)
    (tmp_path / "a.ncom").write_bytes(b"".join(packets))
    source = replay(tmp_path / "a.ncom", sink, speed_factor=10.0)
    assert sink.wait(lambda: len(sink.data) == 60)
    source.stop()


def test_replay_of_packets_without_a_time(tmp_path, sink, drive):
    (tmp_path / "a.ncom").write_bytes(b"".join(drive(20, every=0)))
    source = replay(tmp_path / "a.ncom", sink)
    assert sink.wait(lambda: len(sink.data) == 20)
    source.stop()


def test_replay_of_something_else_is_refused_at_once(tmp_path, sink):
    (tmp_path / "a.ncom").write_bytes(b"text " * 100)
    with pytest.raises(NcomError, match=r"a\.ncom: no NCOM packet"):
        ReplaySource(tmp_path / "a.ncom", sink.take, sink.changed)


def test_statistics_count_rate_and_gaps(drive):
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
