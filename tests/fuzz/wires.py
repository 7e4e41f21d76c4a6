"""Fuzz targets for received data: NCOM packets, CAN frames, datagrams of the simulated bus."""

import math
import os
import socket
import struct
from collections import Counter
from copy import copy
from functools import cache
from pathlib import Path

import can
from canedge_bridge.decode import Decoder, _MessageState
from canedge_bridge.ins_time import replace_gps_time
from canedge_bridge.receiver import Receiver, describe_error_frame
from canedge_bridge.transport import LoopbackMulticastBus, pack_message, parse_channel
from oxts_bridge import ncom
from oxts_bridge.channels import FIELDS, encode_channel
from oxts_bridge.file_decoder import decode_file
from oxts_bridge.motion import FIRST_FIX, UNIT, Accuracy, Origin, extract_motion
from oxts_bridge.ncom import PACKET_SIZE, SYNC, NcomError
from oxts_bridge.status import StatusTracker
from oxts_bridge.stream import NcomParser, StreamStatistics
from support import ROOT

from .harness import Target, one_line

CAN = ROOT / "config" / "can"
LAST_STAMP_NS = 2**31 * 10**9


class Pipeline:
    """Processes the bytes of a port as the node does, up to its messages; checks invariants at every packet."""

    def __init__(self) -> None:
        self.parser, self.status = NcomParser(), StatusTracker()
        self.origins, self.statistics = (Origin(FIRST_FIX), Origin(UNIT)), StreamStatistics()
        self.fed = 0

    def feed(self, data: bytes, received_ns: int) -> int:
        """Number of packets completed by the data."""
        self.fed += len(data)
        packets = self.parser.feed(data, received_ns)
        counters = self.parser.counters
        waiting = self.fed - PACKET_SIZE * counters.packets - counters.skipped_bytes
        assert 0 <= waiting < PACKET_SIZE, f"{waiting} bytes are neither packet nor skipped"
        for received in packets:
            self._process(received, received_ns)
        return len(packets)

    def _process(self, received, now_ns: int) -> None:
        packet = received.packet
        assert received.utc_ns is None or 0 < received.utc_ns < LAST_STAMP_NS, received.utc_ns
        if received.rule.has_status:
            seconds = None if received.gps_ns is None else received.gps_ns * 1e-9
            place = (packet.latitude, packet.longitude, packet.altitude) if packet.channel == 25 else None
            self.status.update(packet.channel, packet.batch_s, seconds, place)
        assert received.event_ns is None or 0 < received.event_ns < LAST_STAMP_NS
        motion = extract_motion(received)
        if motion is not None:
            for origin in self.origins:
                frame = origin.update(motion, self.status, now_ns)
                if frame is not None:
                    assert all(map(math.isfinite, motion.locate(frame))), motion
            assert all(map(math.isfinite, (*motion.attitude.to_quaternion(), *motion.velocity, *motion.body_velocity)))
        if received.kind == "regular":
            self.statistics.add(received)

    def finish(self) -> None:
        Accuracy.from_status(self.status)
        self.statistics.summarise_steps()
        self.statistics.summarise_clock_offset()
        assert len(self.status.values) < 2000 and len(self.status.raw) <= 256
        assert math.isnan(self.status.get_number("no such field"))


def with_checksums(data: bytes) -> bytes:
    """Corrects the three checksums of every 72 bytes from the start that begin with the sync byte."""
    out = bytearray(data)
    for at in range(0, len(out) - PACKET_SIZE + 1, PACKET_SIZE):
        if out[at] == SYNC:
            packet = out[at:at + PACKET_SIZE]
            packet[22] = sum(packet[1:22]) & 0xFF
            packet[61] = sum(packet[1:61]) & 0xFF
            packet[71] = sum(packet[1:71]) & 0xFF
            out[at:at + PACKET_SIZE] = packet
    return bytes(out)


def packets() -> list[bytes]:
    """A valid packet of every status channel and navigation status."""
    base = dict(milliseconds=2_630, acceleration=(0.1, -0.2, -9.8), angular_rate=(0.001, 0.002, 0.1), latitude=0.9,
                longitude=-0.02, altitude=100.0, velocity_ned=(10.0, 5.0, -0.1), heading=0.5, pitch=0.01, roll=-0.02)
    minutes = encode_channel(0, {"GpsMinutes": 23_702_000, "GpsNumObs": 12, "GpsPosMode": 6, "GpsVelMode": 6,
                                 "GpsAttMode": 6})
    made = [ncom.Packet(**base, navigation_status=4, channel=0, batch_s=minutes)]
    for number, channel in enumerate(FIELDS):
        batch_s = bytes([number, 1, 2, 0, 3, 0, 1, 1])
        made.append(ncom.Packet(**base | {"milliseconds": 2_640 + 10 * number}, navigation_status=4, channel=channel,
                                batch_s=batch_s))
    for status in (*range(11), *range(20, 23), 255):
        made.append(ncom.Packet(**base, navigation_status=status, channel=0, batch_s=minutes))
    return [ncom.encode(packet) for packet in made]


def _streams() -> list[bytes]:
    """Streams of nine packets, the first with the time."""
    valid = packets()
    return [b"".join([valid[0], *valid[k:k + 8]]) for k in range(0, len(valid), 8)]


def _ncom_stream(data: bytes, folder: Path) -> str:
    """In chunks whose size depends on the content; a single chunk gives the same number of packets."""
    size = 1 + (data[0] if data else 0) % 200
    pipeline, found = Pipeline(), 0
    for k, at in enumerate(range(0, len(data), size)):
        found += pipeline.feed(data[at:at + size], 10**18 + k * 10_000_000)
    pipeline.finish()
    whole = NcomParser()
    assert len(whole.feed(data)) == found
    return " ".join(name for name, value in vars(pipeline.parser.counters).items() if value)


def _ncom_file(data: bytes, folder: Path) -> str:
    """The file decoder finds the same packets as the stream decoder."""
    parser = NcomParser()
    received = parser.feed(data)
    try:
        columns = decode_file(data)
    except NcomError as error:
        assert not parser.counters.packets
        return one_line(error, data)
    offsets = [r.offset for r in received]
    # The stream omits the vendor's private packets, the file includes their offsets.
    assert offsets == [o for o, s in zip(columns.offset.tolist(), columns.raw[:, 21].tolist(), strict=True) if s != 11]
    counters = parser.counters
    assert (columns.checksum_errors, columns.skipped_bytes) == (counters.checksum_errors, counters.skipped_bytes)
    return f"{len(columns)} packets"


_FRAME = struct.Struct("<IBB")  # identifier with the flags of linux/can.h, length, flags


_table = cache(lambda: Decoder(CAN / "leaf_ze0.dbc", CAN / "leaf_ze0.yaml"))


def _decoder() -> Decoder:
    """A decoder in its initial state, without reading the files again."""
    decoder = copy(_table())
    decoder._states = {spec.key: _MessageState(spec) for spec in decoder.table.messages.values()}
    decoder.skipped = Counter()
    return decoder


def _frames() -> list[bytes]:
    decoder, made = _decoder(), []
    for k, name in enumerate(decoder.table.messages):
        frame = decoder.encode(name, {}, k)
        made.append(_FRAME.pack(frame.arbitration_id, len(frame.data), 0) + bytes(frame.data))
    error = _FRAME.pack(0x20000004, 8, 0) + bytes(8)
    return [b"".join(made), b"".join(made[:3] * 4), made[0] + error]


def _can_frames(data: bytes, folder: Path) -> str:
    """Frames through decoder and error handling of the receiver; every frame is counted once."""
    decoder = _decoder()
    count = at = decoded = 0
    while at + _FRAME.size <= len(data):
        identifier, size, more = _FRAME.unpack_from(data, at)
        payload = data[at + _FRAME.size:at + _FRAME.size + min(size, 64)]
        at += _FRAME.size + len(payload)
        count += 1
        frame = can.Message(arbitration_id=identifier & 0x1FFFFFFF, is_extended_id=bool(identifier & 0x80000000),
                            is_remote_frame=bool(identifier & 0x40000000), data=payload, is_fd=len(payload) > 8,
                            is_error_frame=bool(identifier & 0x20000000), timestamp=0.01 * count)
        if frame.is_error_frame:
            assert describe_error_frame(frame)[0].isprintable()
        found = decoder.decode(frame, round((count + more) * 1e7))
        if found is not None:
            decoded += 1
            assert all(map(math.isfinite, found.values.values())), found
            replace_gps_time(found.values)
    rows = [decoder.statistics(name) for name in decoder.table.messages]
    assert decoded == sum(row.good for row in rows)
    assert decoder.skipped.total() <= count
    assert all(text.isprintable() for text in decoder.plausibility_faults())
    reasons = {name for row in rows for name, value in vars(row).items() if value and name != "last_seen_ns"}
    return " ".join(sorted(reasons | set(decoder.skipped)))


def _datagrams() -> list[bytes]:
    frames = [can.Message(arbitration_id=2, is_extended_id=False, data=bytes(5)),
              can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)),
              can.Message(arbitration_id=0x18FEF100, data=bytes(64), is_fd=True)]
    return [pack_message(frame) for frame in frames]


MARKER = can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"the end.")


@cache
def _loopback() -> tuple[LoopbackMulticastBus, socket.socket]:
    """A bus of this process, and a socket that sends to it."""
    channel = f"239.74.13.77:{20_000 + os.getpid() % 20_000}"
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    sender.connect(parse_channel(channel))
    return LoopbackMulticastBus(channel), sender


def _can_datagram(data: bytes, folder: Path) -> str:
    """One datagram through bus, receiver and decoder; an exception in one of them would reopen the bus."""
    bus, sender = _loopback()
    decoder = _decoder()
    seen: list[can.Message] = []
    receiver = Receiver(lambda: bus, lambda frame, time_ns: seen.append(frame) or decoder.decode(frame, time_ns))
    malformed = bus.malformed_count
    sender.send(data[:4096])
    sender.send(pack_message(MARKER))  # avoids a time-out where the input is not a frame
    while not seen or seen[-1].data != MARKER.data:
        receiver._receive(bus)
    status = receiver.status()
    assert status.callback_errors == 0
    assert status.frames + status.error_frames + bus.malformed_count - malformed == 2
    return "not a frame" if bus.malformed_count > malformed else f"a frame; {status.last_error}"


NCOM_FRAGMENTS = (bytes([SYNC]), bytes([SYNC]) * 72, b"\x80\0\0", b"\xff\xff\x7f", struct.pack("<d", math.nan),
              struct.pack("<d", math.inf), struct.pack("<d", 1e300), struct.pack("<i", 30_525_000), b"\x0b")
CAN_FRAGMENTS = tuple(struct.pack("<I", i) for i in (0x002, 0x284, 0x285, 0x600, 0x604, 0x630, 0x20000040, 0x40000002))
DATAGRAM_WORDS = (b"\xc0", b"\xc3", b"\x90", b"\x80", b"\xca\x7f\xc0\0\0", b"\xcb\x40\0\0\0\0\0\0\0", b"\xa1a",
                  b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\x91" * 600, b"\xc7\x10\xff",
                  b"\xcf" + b"\xff" * 8)

TARGETS = (
    Target("ncom_stream", _streams, _ncom_stream, NCOM_FRAGMENTS, repair=with_checksums),
    Target("ncom_file", _streams, _ncom_file, NCOM_FRAGMENTS, repair=with_checksums),
    Target("can_frames", _frames, _can_frames, CAN_FRAGMENTS),
    Target("can_datagram", _datagrams, _can_datagram, DATAGRAM_WORDS),
)
