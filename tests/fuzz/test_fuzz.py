"""Malformed input for every reader: a short run; `./st bench fuzz` runs longer."""

import os
import signal
from pathlib import Path

import pytest

from fuzz import harness
from fuzz.harness import Finding, Target, check
from fuzz.targets import TARGETS

MAX_INPUTS, MAX_SECONDS = 40, 5.0  # per target

CORPUS = [pytest.param(target, path, id=f"{target.name}/{path.name}") for target in TARGETS.values()
          for path in target.corpus]


@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_are_accepted(name, capfd):
    for seed in TARGETS[name].seeds():
        check(TARGETS[name], seed)


@pytest.mark.parametrize(("target", "path"), CORPUS)
def test_input_of_an_earlier_finding_passes(target, path):
    check(target, path.read_bytes())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TARGETS))
def test_mutated_inputs_give_no_finding(name):
    """The inputs are the same in every run."""
    tally = harness.fuzz(TARGETS[name], 1, MAX_SECONDS, MAX_INPUTS)
    assert not tally.findings, tally.findings[0]
    assert tally.inputs


def _hang(data: bytes, folder: Path) -> str:
    signal.alarm(1)  # stands in for the time limit
    while True:
        pass


def _raise(data: bytes, folder: Path) -> str:
    raise KeyError(data)


def _allocate(data: bytes, folder: Path) -> str:
    memory = b"x" * (harness.MAX_MEMORY + (64 << 20))  # not zero: the system allocates zeros only when written
    return f"fine, {len(memory)}"


def _allocate_and_hang(data: bytes, folder: Path) -> str:
    outcome = _allocate(data, folder)
    _hang(data, folder)
    return outcome


@pytest.mark.parametrize(("run", "message"), [
    (_hang, "Hang"), (_raise, "KeyError"), (_allocate, "MB of memory"), (_allocate_and_hang, "Hang.*MB of memory"),
])
def test_harness_reports_hangs_errors_and_memory(run, message):
    with pytest.raises(Finding, match=message):
        check(Target("failing", lambda: [b"seed"], run), b"x")


def test_harness_reports_a_crash_of_a_fragile_target():
    def crash(data: bytes, folder: Path) -> str:
        os.kill(os.getpid(), signal.SIGSEGV)
        return "not reached"

    with pytest.raises(Finding, match="ended with -11"):
        check(Target("crash", lambda: [b""], crash, fragile=True), b"x")
