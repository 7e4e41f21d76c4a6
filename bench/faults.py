"""Fault injection in the running suite: detection, recovery, losses. Table: docs/measurements/reliability.md.

Fourteen minutes; ST_FAULTS=long adds an INS silent for two minutes, ST_FAULTS=short leaves most faults out, parts of
names (a,b) select faults and update only their lines of the table.
"""

import math
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from _markers import part, renew
from faults.car import Drive, WindingRoad
from faults.catalogue import DRIVING, FAULTS, LONG, Fault
from faults.measure import Recorded, Row, row
from faults.measure import run as put_all
from faults.rig import running

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "measurements" / "reliability.md"

ALL = (*FAULTS, *DRIVING, *LONG)
ROAD = 900.0  # s


def chosen() -> tuple[Fault, ...]:
    choice = os.environ.get("ST_FAULTS", "")
    if choice in ("", "long"):
        return tuple(f for f in ALL if choice or f not in LONG)
    parts = choice.split(",")
    return tuple(f for f in ALL if (f.short if choice == "short" else any(p in f.name for p in parts)))


def run() -> dict:
    faults = chosen()
    rows = measured(tuple(f for f in faults if f not in DRIVING), None)
    rows += measured(tuple(f for f in faults if f in DRIVING), WindingRoad(ROAD))
    write(rows)
    return {r.fault.name: {"notice": r.notice, "clear": r.clear, "recover": r.recover, "ticks lost": r.ticks_lost,
                           "packets not recorded": r.packets_lost, "verdict": verdict(r)} for r in rows}


def measured(faults: tuple[Fault, ...], drive: Drive | None) -> list[Row]:
    if not faults:
        return []
    with tempfile.TemporaryDirectory(prefix="st-faults-") as name:
        folder = Path(name)
        with running(folder, drive=drive) as rig:
            windows = put_all(rig, faults, lambda text: print(text, file=sys.stderr, flush=True))
        recorded = Recorded(folder)
        return [row(window, rig, recorded) for window in windows]


def verdict(found: Row) -> str:
    if found.problems:
        return "open: " + "; ".join(found.problems)
    if found.fault in DRIVING:
        return f"as expected; cleared {found.clear:.0f} s after its end"
    return f"open: {found.fault.open}" if found.fault.open else "as expected"


def table(rows: list[Row], before: dict[str, str]) -> str:
    head = ("fault", "what is to happen", "noticed after, s", "predictions back after, s", "predictions not in the bag",
            "packets not in the bag", "verdict")
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for r in rows:
        notice = "-" if math.isnan(r.notice) else f"{r.notice:.1f}"
        what = verdict(r).replace("|", "/")
        cells = (r.fault.name, r.fault.expected, notice, f"{r.recover:.1f}", r.ticks_lost, r.packets_lost, what)
        before[r.fault.name] = "| " + " | ".join(map(str, cells)) + " |"
    kept = [before[fault.name] for fault in ALL if fault.name in before]
    return "\n".join([*lines, *kept]) + "\n"


def write(rows: list[Row]) -> None:
    before = {line.split(" | ")[0].removeprefix("| "): line for line in part(DOCUMENT, "fault table").splitlines()}
    renew(DOCUMENT, "fault table", table(rows, before))
