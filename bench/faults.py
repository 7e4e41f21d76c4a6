"""Injects faults into the running suite: time to detection and recovery, losses; docs/measurements/reliability.md.

It takes fourteen minutes. ST_FAULTS=long adds an INS that is silent for two minutes; ST_FAULTS=short injects only a few
faults; ST_FAULTS=a,b injects those with a or b in their names. Only the rows of injected faults are replaced.
"""

import math
import os
import sys
import tempfile
from pathlib import Path

from faults.car import Drive, WindingRoad
from faults.catalogue import DRIVING, FAULTS, LONG, Fault
from faults.measure import Recorded, Row, evaluate, inject_all
from faults.rig import running

from ._pages import format_row, format_table, read_part, replace_part

PAGE = Path(__file__).resolve().parents[1] / "docs" / "measurements" / "reliability.md"

ALL = (*FAULTS, *DRIVING, *LONG)
ROAD_DURATION = 900.0  # s


def choose_faults() -> tuple[Fault, ...]:
    choice = os.environ.get("ST_FAULTS", "")
    if choice in ("", "long"):
        return tuple(f for f in ALL if choice or f not in LONG)
    parts = choice.split(",")
    return tuple(f for f in ALL if (f.short if choice == "short" else any(p in f.name for p in parts)))


def run() -> dict:
    faults = choose_faults()
    rows = measure(tuple(f for f in faults if f not in DRIVING), None)
    rows += measure(tuple(f for f in faults if f in DRIVING), WindingRoad(ROAD_DURATION))
    write_table(rows)
    return {r.fault.name: {"notice": r.notice, "clear": r.clear, "recover": r.recover, "ticks lost": r.ticks_lost,
                           "packets not recorded": r.packets_lost, "verdict": assess(r)} for r in rows}


def measure(faults: tuple[Fault, ...], drive: Drive | None) -> list[Row]:
    if not faults:
        return []
    with tempfile.TemporaryDirectory(prefix="st-faults-") as name:
        folder = Path(name)
        with running(folder, drive=drive) as rig:
            windows = inject_all(rig, faults, lambda text: print(text, file=sys.stderr, flush=True))
        recorded = Recorded(folder)
        return [evaluate(window, rig, recorded) for window in windows]


def assess(row: Row) -> str:
    """Verdict on a row: as expected, or the problems that are still open."""
    if row.problems:
        return "open: " + "; ".join(row.problems)
    if row.fault in DRIVING:
        return f"as expected; cleared {row.clear:.0f} s after its end"
    return f"open: {row.fault.open}" if row.fault.open else "as expected"


def write_table(rows: list[Row]) -> None:
    """Replaces the rows of these faults on the page."""
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in read_part(PAGE, "fault table").splitlines()}
    for r in rows:
        notice = "-" if math.isnan(r.notice) else f"{r.notice:.1f}"
        lines[r.fault.name] = format_row((r.fault.name, r.fault.expected, notice, f"{r.recover:.1f}", r.ticks_lost,
                                          r.packets_lost, assess(r).replace("|", "/")))
    head = ("fault", "required behaviour", "noticed after, s", "predictions back after, s",
            "predictions not in the bag", "packets not in the bag", "verdict")
    replace_part(PAGE, "fault table", "\n".join([
        format_table(head, ()), *(lines[fault.name] for fault in ALL if fault.name in lines)]))
