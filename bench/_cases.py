"""Runs cases, keeps their records as JSON lines, changes limits for an ablation, and computes intervals of scores."""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scipy.stats import binomtest
from st_recordings.paths import source_version

FACTORS = (0.5, 2.0)
"""Factors on each limit in an ablation."""
Record = dict[str, Any]


def interleave(groups_of_blocks: Mapping[str, Sequence[Sequence[Any]]]) -> list[Sequence[Any]]:
    """The groups of cases of all blocks, in an order in which all blocks advance at the same rate."""
    groups = [((k + 0.5) / len(groups), block, group) for block, groups in groups_of_blocks.items()
              for k, group in enumerate(groups)]
    return [group for *_, group in sorted(groups, key=lambda g: g[:2])]


def read_records(*files: Path) -> list[Record]:
    """Records of files of JSON lines; if several contain a case with the same limit, the last counts."""
    records = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    return list({(r["set"], r["block"], r["index"], *r.get("limit", ())): r for r in records}.values())


def run_all(cases: Iterable[Any], file: Path, until: float | None, run: Callable[[Any], Record | None],
            report: Callable[[Record], None]) -> list[Record]:
    """Records of all cases, which are appended to the file one by one; cases in the file are not run again, so that an
    interrupted run can be continued.

    until: Unix time after which no case starts. run: runs a case; None for a case without a record.
    """
    done = {(r["set"], r["block"], r["index"]): r for r in (read_records(file) if file.exists() else ())}
    records = []
    file.parent.mkdir(parents=True, exist_ok=True)
    for case in cases:
        key = case.set_, case.block, case.index
        if key not in done:
            if until is not None and time.time() >= until:
                break
            begin = time.process_time()
            record = run(case)
            if record is None:
                continue
            done[key] = {"set": key[0], "block": key[1], "index": key[2], "version": source_version(), **record,
                         "case_s": round(time.process_time() - begin, 2)}
            with file.open("a") as out:
                out.write(json.dumps(done[key]) + "\n")
            report(done[key])
        records.append(done[key])
    return records


def map_parallel(function: Callable[[Any], Any], tasks: Iterable[Any], jobs: int) -> Iterator[Any]:
    """Results in the order of the tasks, from one or several processes."""
    if jobs == 1:
        yield from map(function, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(function, tasks)


@contextmanager
def multiplied(limits: Sequence[tuple[Any, str]], factor: float) -> Iterator[None]:
    """Context in which limits are multiplied: (module or object, also a frozen dataclass; name); integers stay so."""
    before = [getattr(*limit) for limit in limits]
    try:
        for (owner, name), value in zip(limits, before, strict=True):
            object.__setattr__(owner, name, type(value)(factor * value))
        yield
    finally:
        for (owner, name), value in zip(limits, before, strict=True):
            object.__setattr__(owner, name, value)


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a proportion by Wilson, JASA 22 (1927); (0, 1) for no cases."""
    if not count:
        return 0.0, 1.0
    low, high = binomtest(hits, count).proportion_ci(method="wilson")
    return float(low), float(high)
