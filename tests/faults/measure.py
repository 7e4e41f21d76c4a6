"""Measures the consequences of a fault, from the diagnostics during the run and from the recordings afterwards."""

import time
from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bags import nanoseconds, read_messages
from st_recordings.recovery import recover

from .catalogue import CONTINUE, STOP, Fault
from .rig import Rig

RATE = 10.0  # predictions per second
MAX_INPUT_AGE = 0.1  # s; a prediction that starts later after the last good input has no input
MAX_PREDICTION_GAP = 3.0  # s; predictions that are expected to continue do so within this time, even on a busy machine
DELAY, DELAY_AFTER_RESTART = 1.5, 4.0  # s; checks publish once a second, a restarted recorder first finds its topics
RESTART_TIMEOUT = 30.0  # s


@dataclass(frozen=True)
class Window:
    """Period of a fault, and the time of recovery [ns].

    Injection and removal take time on a busy machine: the fault is present at least from injected_ns to removal_ns, and
    at most from begin_ns to end_ns.
    """

    fault: Fault
    begin_ns: int
    injected_ns: int
    removal_ns: int
    end_ns: int
    recovered_ns: int
    restarts: dict[str, int]
    is_healthy: bool


@dataclass(frozen=True)
class Row:
    """One row of the table; times [s], NaN if there is none. clear: from the end of the fault until its check is OK."""

    fault: Fault
    notice: float
    clear: float
    recover: float
    ticks_lost: int
    packets_lost: int
    problems: tuple[str, ...]


def inject(rig: Rig, fault: Fault, until_reported: bool = False) -> Window:
    before = dict(rig.supervisor.restarts)
    begin = time.time_ns()  # a fault may be reported before its injection has ended
    undo = fault.inject(rig)
    injected = time.time_ns()
    rig.run(fault.seconds, lambda: until_reported and rig.reports(fault.check, fault.words))
    removal = time.time_ns()
    undo()
    end = time.time_ns()
    count = before.get(fault.restarts, 0) + 1
    rig.run(RESTART_TIMEOUT, lambda: not fault.restarts or rig.supervisor.restarts.get(fault.restarts, 0) >= count)
    rig.run(DELAY_AFTER_RESTART if fault.restarts else DELAY)
    is_healthy = rig.run(fault.recovery_timeout, rig.is_healthy)
    rig.run(DELAY)
    recovered = time.time_ns()
    new = {name: n - before.get(name, 0) for name, n in rig.supervisor.restarts.items() if n > before.get(name, 0)}
    return Window(fault, begin, injected, removal, end, recovered, new, is_healthy)


class Recorded:
    """Times [ns] in the bags of a run; bags that were not closed are recovered first."""

    def __init__(self, folder: Path):
        issued, starts, sent = set(), set(), []
        for bag in sorted(folder.glob("bag*")):
            recover(bag)
            messages = read_messages(bag, ["/predictor/linear/prediction", "/ins/ncom"])
            predictions = messages.get("/predictor/linear/prediction", ())
            issued.update(nanoseconds(m.issued_at) for m in predictions)
            starts.update(nanoseconds(m.header.stamp) for m in predictions)
            sent += [nanoseconds(m.header.stamp) for m in messages.get("/ins/ncom", ())]
        self.issued = np.array(sorted(issued))
        self.packets = np.array(sorted(sent))
        self.starts = np.array(sorted(starts))


def count_between(times: np.ndarray, begin: int, end: int) -> int:
    return bisect_left(times, end) - bisect_left(times, begin)


def evaluate(window: Window, rig: Rig, recorded: Recorded) -> Row:
    fault, problems = window.fault, []
    notice = next(((s.time_ns - window.begin_ns) * 1e-9 for s in rig.seen
                   if s.time_ns >= window.begin_ns and s.time_ns <= window.recovered_ns and s.name == fault.check
                   and s.level and fault.words in s.message), float("nan"))
    if fault.check and np.isnan(notice):
        reports = [s for s in rig.seen if window.begin_ns <= s.time_ns <= window.recovered_ns and s.level]
        problems.append(f"{fault.check} did not report {fault.words!r}, but "
                        f"{[(s.name, s.message) for s in reports][:6]}")
    clear = next(((s.time_ns - window.end_ns) * 1e-9 for s in rig.seen
                  if s.time_ns >= window.end_ns and s.name == fault.check and not s.level), float("nan"))
    after = recorded.issued[recorded.issued >= window.end_ns]
    first_after = int(after[0]) if len(after) else window.recovered_ns
    if not len(after):
        problems.append("no prediction afterwards")
    if not window.is_healthy:
        problems.append("a check still reports a problem afterwards")
    due = (first_after - window.begin_ns) * 1e-9 * RATE
    lost = max(0, round(due - count_between(recorded.issued, window.begin_ns, first_after)))
    input_age = round(MAX_INPUT_AGE * 1e9)
    inside = count_between(recorded.starts, window.injected_ns + input_age, window.removal_ns - input_age)
    if fault.predictions == STOP and inside:
        problems.append(f"{inside} predictions from stale input")
    latest = max(window.end_ns, window.begin_ns + round(MAX_PREDICTION_GAP * 1e9))
    continued = count_between(recorded.starts, window.begin_ns + input_age, latest)
    if fault.predictions == CONTINUE and fault.restarts != "recorder" and not continued:
        problems.append("predictions did not continue")
    expected = {fault.restarts: 1} if fault.restarts else {}
    if window.restarts.keys() != expected.keys():
        problems.append(f"restarts: {window.restarts}, expected {expected}")
    sent = np.array(rig.car.ins.sent_ns)
    sent_count = count_between(sent, window.begin_ns, window.recovered_ns - 10**9)
    recorded_count = count_between(recorded.packets, window.begin_ns, window.recovered_ns - 10**9)
    recover_after = (first_after - window.end_ns) * 1e-9
    return Row(fault, notice, clear, recover_after, lost, max(0, sent_count - recorded_count), tuple(problems))


def inject_all(rig: Rig, faults: tuple[Fault, ...], report=lambda text: None) -> list[Window]:
    windows = []
    for fault in faults:
        windows.append(inject(rig, fault))
        report(f"{fault.name}: {'recovered' if windows[-1].is_healthy else 'not recovered'}")
    return windows
