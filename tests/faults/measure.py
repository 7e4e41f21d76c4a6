"""What a fault did: from what was seen at the terminal while it ran, and from the recordings afterwards."""

import time
from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bags import nanoseconds, read_messages
from st_recordings.mcap import recover

from .catalogue import GO_ON, STOP, Fault
from .rig import Rig

RATE = 10.0  # predictions per second
# A prediction that starts so long after the last good input came from no input [s].
GRACE = 0.1
# Where predictions are to go on there has to be one so soon, whatever else the machine does [s].
LATEST = 3.0
AFTER, AFTER_RESTART = 1.5, 4.0  # s
RESTART = 30.0  # s


@dataclass(frozen=True)
class Window:
    """When a fault was in, and when all was well again [ns]."""

    fault: Fault
    begin_ns: int
    end_ns: int
    well_ns: int
    restarts: dict[str, int]
    is_well: bool


@dataclass(frozen=True)
class Row:
    """One line of the table; times in s, NaN: none. clear: from the end of the fault until its check is well."""

    fault: Fault
    notice: float
    clear: float
    recover: float
    ticks_lost: int
    packets_lost: int
    problems: tuple[str, ...]


def put(rig: Rig, fault: Fault, until_told: bool = False) -> Window:
    before = dict(rig.supervisor.restarts)
    begin = time.time_ns()  # a fault that takes time to be put in may be told meanwhile
    undo = fault.put(rig)
    rig.run(fault.seconds, lambda: until_told and rig.says(fault.check, fault.words))
    undo()
    end = time.time_ns()
    wanted = before.get(fault.restarts, 0) + 1
    rig.run(RESTART, lambda: not fault.restarts or rig.supervisor.restarts.get(fault.restarts, 0) >= wanted)
    # Checks speak once a second; a recorder that was started again has to find its topics first.
    rig.run(AFTER_RESTART if fault.restarts else AFTER)
    is_well = rig.run(fault.settles, rig.is_well)
    rig.run(AFTER)
    well = time.time_ns()
    new = {name: n - before.get(name, 0) for name, n in rig.supervisor.restarts.items() if n > before.get(name, 0)}
    return Window(fault, begin, end, well, new, is_well)


class Recorded:
    """The bags of a run, those that were cut mended first. Times in ns."""

    def __init__(self, folder: Path):
        issued, starts, sent = set(), set(), []
        for bag in sorted(folder.glob("bag*")):
            recover(bag)
            messages = read_messages(bag)
            predictions = messages.get("/predictor/linear/prediction", ())
            issued.update(nanoseconds(m.issued_at) for m in predictions)
            starts.update(nanoseconds(m.header.stamp) for m in predictions)
            sent += [nanoseconds(m.header.stamp) for m in messages.get("/ins/ncom", ())]
        self.issued = np.array(sorted(issued))
        self.packets = np.array(sorted(sent))
        self.starts = np.array(sorted(starts))


def between(times: np.ndarray, begin: int, end: int) -> int:
    return bisect_left(times, end) - bisect_left(times, begin)


def row(window: Window, rig: Rig, recorded: Recorded) -> Row:
    fault, problems = window.fault, []
    notice = next(((s.time_ns - window.begin_ns) * 1e-9 for s in rig.seen
                   if s.time_ns >= window.begin_ns and s.time_ns <= window.well_ns and s.name == fault.check
                   and s.level and fault.words in s.message), float("nan"))
    if fault.check and np.isnan(notice):
        said = [s for s in rig.seen if window.begin_ns <= s.time_ns <= window.well_ns and s.level]
        problems.append(f"{fault.check} did not say {fault.words!r}; said: {[(s.name, s.message) for s in said][:6]}")
    clear = next(((s.time_ns - window.end_ns) * 1e-9 for s in rig.seen
                  if s.time_ns >= window.end_ns and s.name == fault.check and not s.level), float("nan"))
    after = recorded.issued[recorded.issued >= window.end_ns]
    first_after = int(after[0]) if len(after) else window.well_ns
    if not len(after):
        problems.append("no prediction afterwards")
    if not window.is_well:
        problems.append("not well afterwards")
    got = between(recorded.issued, window.begin_ns, first_after)
    due = (first_after - window.begin_ns) * 1e-9 * RATE
    lost = max(0, round(due - got))
    grace = round(GRACE * 1e9)
    inside = between(recorded.starts, window.begin_ns + grace, window.end_ns - grace)
    if fault.predictions == STOP and inside:
        problems.append(f"{inside} predictions from stale input")
    latest = max(window.end_ns, window.begin_ns + round(LATEST * 1e9))
    went_on = between(recorded.starts, window.begin_ns + grace, latest)
    if fault.predictions == GO_ON and fault.restarts != "recorder" and not went_on:
        problems.append("predictions did not go on")
    expected = {fault.restarts: 1} if fault.restarts else {}
    if window.restarts.keys() != expected.keys():
        problems.append(f"started again: {window.restarts}, expected {expected}")
    sent = np.array(rig.car.ins.sent_ns)
    handed_on = between(sent, window.begin_ns, window.well_ns - 10**9)
    kept = between(recorded.packets, window.begin_ns, window.well_ns - 10**9)
    recover_after = (first_after - window.end_ns) * 1e-9
    return Row(fault, notice, clear, recover_after, lost, max(0, handed_on - kept), tuple(problems))


def run(rig: Rig, faults: tuple[Fault, ...], said=lambda text: None) -> list[Window]:
    windows = []
    for fault in faults:
        windows.append(put(rig, fault))
        said(f"{fault.name}: {'well' if windows[-1].is_well else 'not well'}")
    return windows
