"""Hostile bytes at every reader: inputs and findings; ST_FUZZ_SECONDS for each (60).

`ncom_packets` is the fast one: single packets with changed bytes, most with right checksums, through all that the node
does before its messages. ST_FUZZ_TARGETS=ncom_packets,dbc names targets, ST_FUZZ_SEED a seed; ST_FUZZ_KEEP=1 keeps
findings, made smaller, in tests/fuzz/corpus. As a script its exit status is 1 if there were any.
"""

import json
import os
import random
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fuzz.harness import fuzz, save, smaller
from fuzz.targets import TARGETS
from fuzz.wires import Pipeline, packets, with_checksums

FAST = "ncom_packets"
BLOCK = 2000  # packets through one pipeline: state grows old, and a finding is found again by its seed


def changed(chance: random.Random, packet: bytes) -> bytes:
    """A few bytes changed; three of four times the checksums are right."""
    data = bytearray(packet)
    for _ in range(1 + chance.getrandbits(2)):
        data[1 + int(chance.random() * 71)] = chance.getrandbits(8)
    if chance.random() < 0.1:
        return bytes(data[:chance.randrange(73)])
    return with_checksums(bytes(data)) if chance.random() < 0.75 else bytes(data)


def ncom_block(seed: int) -> list[bytes]:
    chance, base = random.Random(seed), packets()
    return [changed(chance, chance.choice(base)) for _ in range(BLOCK)]


def fuzz_packets(seed: int, seconds: float) -> dict:
    """The whole block is one finding; replay it with ncom_block(seed)."""
    started, inputs, found = time.monotonic(), 0, {}
    base, accepted = packets(), 0
    while time.monotonic() - started < seconds:
        block_seed = seed * 10**9 + inputs // BLOCK
        chance, pipeline = random.Random(block_seed), Pipeline()
        try:
            for k in range(BLOCK):
                pipeline.feed(changed(chance, chance.choice(base)), 10**18 + k * 4_000_000)
            pipeline.finish()
        except Exception as error:
            found.setdefault(f"{type(error).__name__}: {error}"[:60], block_seed)
        inputs += BLOCK
        accepted += pipeline.parser.counters.packets
    elapsed = time.monotonic() - started
    result = {"inputs": inputs, "accepted": accepted, "seconds": elapsed, "per_s": inputs / elapsed}
    return result | {"findings": len(found), **{f"finding {what}": f"seed {at}" for what, at in found.items()}}


def run() -> dict:
    seconds = float(os.environ.get("ST_FUZZ_SECONDS", "60"))
    seed = int(os.environ.get("ST_FUZZ_SEED") or time.time())
    names = [name for name in os.environ.get("ST_FUZZ_TARGETS", "").split(",") if name] or [FAST, *TARGETS]
    results: dict = {"seed": seed}
    for name in names:
        if name == FAST:
            results[name] = fuzz_packets(seed, seconds)
            continue
        tally = fuzz(TARGETS[name], seed, seconds)
        results[name] = {"inputs": tally.inputs, "seconds": tally.seconds, "outcomes": len(tally.outcomes),
                         "findings": len(tally.findings)}
        for finding in tally.findings:
            print(finding, file=sys.stderr)
            if os.environ.get("ST_FUZZ_KEEP"):
                print("kept as", save(TARGETS[name], smaller(TARGETS[name], finding)), file=sys.stderr)
    return results


if __name__ == "__main__":
    results = run()
    print(json.dumps(results, indent=2))
    sys.exit(any(result["findings"] for result in results.values() if isinstance(result, dict)))
