"""Runs all cases of a set, drive by drive, in one or several processes."""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from . import drives
from .corruptions import FAULTS, Fault, Size
from .score import Drive, Record, scale_size, score_case

MIN_SIZE_FACTOR, MAX_SIZE_FACTOR = 0.7, 1.5
"""Range of the sizes of the sealed set, relative to those of the development set."""


def run_matrix(set_: str, names: Sequence[str], kinds: Sequence[str], jobs: int) -> Iterator[list[Record]]:
    """Yields the records of each drive, in the order of `names`."""
    tasks = [(set_, name, tuple(kinds)) for name in names]
    yield from map_parallel(score_drive, tasks, jobs)


def map_parallel(function, tasks: Iterable[tuple], jobs: int) -> Iterator:
    if jobs == 1:
        yield from map(function, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(function, tasks)


def score_drive(task: tuple[str, str, tuple[str, ...]]) -> list[Record]:
    set_, name, kinds = task
    drive = Drive(drives.load(name, set_))
    return [record for fault in map(FAULTS.__getitem__, kinds) for size in choose_sizes(fault, name, set_)
            if (record := score_case(drive, fault, size)) is not None]


def choose_sizes(fault: Fault, drive: str, set_: str) -> list[Size]:
    if set_ == "development":
        return list(fault.sizes)
    generator = np.random.default_rng(zlib.crc32(f"{set_} {drive} {fault.name}".encode()))
    factors = generator.uniform(MIN_SIZE_FACTOR, MAX_SIZE_FACTOR, len(fault.sizes))
    return [scale_size(size, fault.operation, factor)
            for size, factor in zip(fault.sizes, factors.tolist(), strict=True)]
