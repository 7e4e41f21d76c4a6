"""Fuzzes every reader: number of inputs and findings.

`ncom_bulk` is the fastest target: blocks of packets with changed bytes are parsed as a stream, and every tenth block is
also decoded as a file, which must give the same result. `ncom_packets` processes single packets, most of them with
correct checksums, as the node does. ST_FUZZ_SECONDS: processor time for each target (60 s). ST_FUZZ_TARGETS: names of
targets, such as ncom_packets,dbc. ST_FUZZ_SEED: seed. ST_FUZZ_KEEP=1: findings are minimised and stored in
tests/fuzz/corpus.
"""

import os
import random
import sys
import time
from collections.abc import Callable

import numpy as np
from fuzz.harness import fuzz, minimise, processor_seconds, save
from fuzz.targets import TARGETS
from fuzz.wires import Pipeline, packets, with_checksums
from oxts_bridge.file_decoder import decode_file
from oxts_bridge.ncom import PACKET_SIZE
from oxts_bridge.stream import NcomParser

FAST, BULK = "ncom_packets", "ncom_bulk"
MAX_PACKETS = 12_000_000
BLOCK = 2000  # packets


def mutate(rng: random.Random, packet: bytes) -> bytes:
    """Changes 1 to 4 bytes. A tenth of the packets is then cut; three quarters of the rest get valid checksums."""
    data = bytearray(packet)
    for _ in range(1 + rng.getrandbits(2)):
        data[1 + int(rng.random() * 71)] = rng.getrandbits(8)
    if rng.random() < 0.1:
        return bytes(data[:rng.randrange(73)])
    return with_checksums(bytes(data)) if rng.random() < 0.75 else bytes(data)


def fuzz_blocks(check: Callable[[int, int], int], seed: int, seconds: float) -> dict:
    """Counts of inputs, accepted packets and findings; a failure counts once and is reproduced by its block seed.

    check: (seed of the block, its number) -> packets that it accepts.
    """
    started, blocks, accepted, failures = processor_seconds(), 0, 0, {}
    while processor_seconds() - started < seconds and blocks * BLOCK < MAX_PACKETS:
        try:
            accepted += check(seed * 10**9 + blocks, blocks)
        except Exception as error:
            failures.setdefault(f"{type(error).__name__}: {error}"[:60], seed * 10**9 + blocks)
        blocks += 1
    elapsed = processor_seconds() - started
    result = {"inputs": blocks * BLOCK, "accepted": accepted, "seconds": elapsed, "findings": len(failures)}
    return result | {f"finding {text}": f"seed {at}" for text, at in failures.items()}


def check_packets(seed: int, number: int) -> int:
    """Processes single packets with one pipeline and its state."""
    rng, base, pipeline = random.Random(seed), packets(), Pipeline()
    for k, packet in enumerate([mutate(rng, rng.choice(base)) for _ in range(BLOCK)]):
        pipeline.feed(packet, 10**18 + k * 4_000_000)
    pipeline.finish()
    return pipeline.parser.counters.packets


def make_bulk_block(seed: int, base: np.ndarray) -> bytes:
    """Packets with 1 to 3 changed bytes each, three of four with correct checksums; bytes are missing in 5 places."""
    rng = np.random.default_rng(seed)
    data = base[rng.integers(len(base), size=BLOCK)]
    rows = np.arange(BLOCK)
    for probability in (1.0, 0.5, 0.25):
        hit = rows[rng.random(BLOCK) < probability]
        data[hit, rng.integers(1, PACKET_SIZE, len(hit))] = rng.integers(256, size=len(hit))
    with_checksum = rows[rng.random(BLOCK) < 0.75]
    for end in (22, 61, 71):
        data[with_checksum, end] = data[with_checksum, 1:end].sum(axis=1, dtype=np.uint32) & 0xFF
    stream = bytearray(data.tobytes())
    for at in rng.integers(len(stream) - 100, size=5).tolist():
        del stream[at:at + at % 97]
    return bytes(stream)


def check_bulk(seed: int, number: int) -> int:
    """Checks that every byte is counted as packet, skipped or pending, and that both decoders agree."""
    base = np.frombuffer(b"".join(packets()), np.uint8).reshape(-1, PACKET_SIZE)
    data, parser = make_bulk_block(seed, base), NcomParser()
    received, counters = parser.feed(data, 10**18), parser.counters
    pending = len(data) - PACKET_SIZE * counters.packets - counters.skipped_bytes
    assert 0 <= pending < PACKET_SIZE, f"{pending} bytes are neither packet nor skipped"
    if number % 10 == 0:
        columns = decode_file(data)
        found = columns.checksum_errors, columns.skipped_bytes
        assert found == (counters.checksum_errors, counters.skipped_bytes), "stream and file decoder disagree"
    return len(received)


def run() -> dict:
    seconds = float(os.environ.get("ST_FUZZ_SECONDS", "60"))
    seed = int(os.environ.get("ST_FUZZ_SEED") or time.time())
    names = [name for name in os.environ.get("ST_FUZZ_TARGETS", "").split(",") if name] or [BULK, FAST, *TARGETS]
    results: dict = {"seed": seed}
    for name in names:
        if name in (FAST, BULK):
            results[name] = fuzz_blocks(check_packets if name == FAST else check_bulk, seed, seconds)
            continue
        tally = fuzz(TARGETS[name], seed, seconds)
        results[name] = {"inputs": tally.inputs, "seconds": tally.seconds, "outcomes": len(tally.outcomes),
                         "findings": len(tally.findings)}
        for finding in tally.findings:
            print(finding, file=sys.stderr)
            if os.environ.get("ST_FUZZ_KEEP"):
                print("stored as", save(TARGETS[name], minimise(TARGETS[name], finding)), file=sys.stderr)
    return results
