"""Where packets are in bytes: one rule for streams and files.

After bytes that are no packet it searches on by single bytes, and takes the next packet only if its three checksums and
its navigation status are right: one in 256 false syncs passes the final checksum alone.
"""

from dataclasses import dataclass

from .navigation import BY_STATUS
from .ncom import CHECKSUM_3_AT, PACKET_SIZE, STATUS_AT, STRUCTURE_B, SYNC, inner_checksums_match

_SYNC = bytes([SYNC])


@dataclass
class Counters:
    """What became of the bytes since start."""

    packets: int = 0
    checksum_errors: int = 0  # a packet was due here, but its final checksum is wrong
    skipped_bytes: int = 0  # belong to no packet
    inner_checksum_warnings: int = 0  # checksum 1 or 2 wrong, final one right: accepted, as the vendor does
    late: int = 0
    duplicates: int = 0
    unknown_statuses: int = 0  # reserved navigation status: ignored
    unknown_channels: int = 0
    structure_b: int = 0  # vendor-internal, dropped
    triggers: int = 0
    impossible_positions: int = 0  # NaN or out of range where the navigation status declares a position: masked


def next_packet(data: bytes, at: int, in_step: bool, counters: Counters) -> tuple[int, bool]:
    """Position of the first packet from `at` on; where none is whole any more, of the bytes to wait for. And whether a
    packet is due there.

    in_step: whether one is due at `at`. Counts checksum_errors and skipped_bytes.
    """
    while at < len(data):
        if data[at] == SYNC:
            raw = data[at : at + PACKET_SIZE]
            if len(raw) < PACKET_SIZE:
                break
            if sum(raw[1:CHECKSUM_3_AT]) & 0xFF == raw[CHECKSUM_3_AT] and (in_step or _plausible(raw)):
                return at, True
            counters.checksum_errors += in_step
        following = data.find(_SYNC, at + 1)
        following = len(data) if following < 0 else following
        counters.skipped_bytes += following - at
        at, in_step = following, False
    return at, in_step


def _plausible(raw: bytes) -> bool:
    """Whether 72 bytes with the right final checksum, found by searching, are to be believed."""
    status = raw[STATUS_AT]
    return status == STRUCTURE_B or (BY_STATUS[status].known and inner_checksums_match(raw))
