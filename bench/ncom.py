"""Decoding speed of NCOM: packet by packet as in the node, and of a whole file. `python bench/ncom.py` or
`st bench ncom`."""

import json
import time
from dataclasses import replace

from oxts_bridge import ncom
from oxts_bridge.channels import encode_channel
from oxts_bridge.file_decoder import decode_file
from oxts_bridge.status import StatusTracker
from oxts_bridge.stream import NcomParser

STREAM_PACKETS = 20_000
FILE_PACKETS = 500_000
REPEATS = 3
RATE = 250


def packets(count: int) -> list[bytes]:
    """A clean 250 Hz drive with the cycle of status channels: 0 every 10th, then accuracies, biases, receivers."""
    minute, ms = 23_702_000, 2_630
    base = ncom.Packet(
        navigation_status=4,
        acceleration=(0.1, -0.2, -9.8),
        angular_rate=(0.001, 0.002, 0.1),
        latitude=0.9,
        longitude=-0.02,
        altitude=100.0,
        velocity_ned=(10.0, 5.0, -0.1),
        heading=0.5,
        pitch=0.01,
        roll=-0.02,
    )
    others = [3, 4, 5, 1, 2, 6, 7, 12, 16, 48, 23, 27]
    result = []
    for i in range(count):
        channel = 0 if i % 10 == 0 else others[i % len(others)]
        fields = {"GpsMinutes": minute, "GpsNumObs": 12, "GpsPosMode": 6, "GpsVelMode": 6, "GpsAttMode": 6}
        # The bytes of each channel change occasionally, like accuracies and counters.
        status = encode_channel(0, fields) if channel == 0 else bytes([i >> 4 & 0x7F, 1, i >> 5 & 0x7F, 2, 3, 0, 0, 1])
        packet = replace(base, milliseconds=ms, channel=channel, batch_s=status, heading=(i % 6000) / 1000 - 3)
        result.append(ncom.encode(packet))
        ms += 1000 // RATE
        if ms >= 60_000:
            ms, minute = ms - 60_000, minute + 1
    return result


def stream() -> float:
    """Seconds per packet: parser with checksums and clock, and the status tracker; one datagram per packet."""
    datagrams = packets(STREAM_PACKETS)
    best = float("inf")
    for _ in range(REPEATS):
        parser, tracker = NcomParser(), StatusTracker()
        start = time.process_time()
        for received_ns, datagram in enumerate(datagrams):
            for received in parser.feed(datagram, received_ns):
                tracker.update_from(received)
        best = min(best, time.process_time() - start)
    return best / STREAM_PACKETS


def whole_file() -> float:
    """Packets per second of decode_file(), times included, on a clean file."""
    data = b"".join(packets(50_000)) * (FILE_PACKETS // 50_000)
    best = float("inf")
    for _ in range(REPEATS):
        start = time.process_time()
        columns = decode_file(data)
        best = min(best, time.process_time() - start)
    return len(columns) / best


def run() -> dict:
    """packets_per_s: whole file; us_per_packet: streaming; of processor time, independent of other programs."""
    return {"name": "ncom", "packets_per_s": whole_file(), "us_per_packet": stream() * 1e6}


if __name__ == "__main__":
    print(json.dumps(run(), indent=2))
