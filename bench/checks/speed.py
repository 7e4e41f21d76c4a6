"""Processor time of a check for recordings of different lengths."""

import time

from .._pages import format_table
from .score import run_check
from .virtual import virtual_drive

MINUTES = (1, 10, 30)
REPEATS = 3


def main() -> str:
    """The Markdown table; prints each row as soon as it is ready."""
    longest = virtual_drive("S6", 1, 60.0 * MINUTES[-1])
    start = int(longest.log.ins_time_ns[0])
    rows = []
    for minutes in MINUTES:
        recording = longest.between(start, start + round(minutes * 60e9))
        seconds = min(_measure(recording) for _ in range(REPEATS))
        rows.append((str(minutes), str(len(recording.log.x)), f"{seconds:.2f}", f"{seconds / minutes:.3f}"))
        print(*rows[-1], flush=True)
    return format_table(("minutes at 100 Hz", "samples", "s of processor time", "s per minute"), rows)


def _measure(recording) -> float:
    begin = time.process_time()
    run_check(recording)
    return time.process_time() - begin
