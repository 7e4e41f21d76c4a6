"""How long a check takes, and whether that grows as the recording does."""

import time

from .score import checked
from .virtual import virtual_drive

MINUTES = (1, 10, 60)
REPEATS = 3


def main() -> int:
    hour = virtual_drive("S6", 1, 60.0 * MINUTES[-1])
    start = int(hour.log.ins_time_ns[0])
    print("minutes  samples  s     s per minute")
    for minutes in MINUTES:
        recording = hour.between(start, start + round(minutes * 60e9))
        seconds = min(_timed(recording) for _ in range(REPEATS))
        print(f"{minutes:7} {len(recording.log.x):8} {seconds:.3f} {seconds / minutes:.4f}", flush=True)
    return 0


def _timed(recording) -> float:
    begin = time.perf_counter()
    checked(recording)
    return time.perf_counter() - begin
