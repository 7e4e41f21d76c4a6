"""Malformed input for every reader: a short run; `./st bench fuzz` runs longer."""

import os
import signal
from pathlib import Path

import pytest

from fuzz import harness
from fuzz.harness import Finding, Target, check
from fuzz.targets import TARGETS

MAX_INPUTS, MAX_SECONDS = 40, 5.0  # per target

# Known findings that are not corrected yet: input in corpus/ -> description.
OPEN: dict[str, str] = {}
WITHOUT_OPEN_FINDINGS = sorted(set(TARGETS) - {name.partition("/")[0] for name in OPEN})


def _corpus() -> list:
    marks = {name: pytest.mark.xfail(reason=reason, raises=Finding) for name, reason in OPEN.items()}
    names = {f"{target.name}/{path.name}": (target, path) for target in TARGETS.values() for path in target.corpus}
    return [pytest.param(*each, id=name, marks=marks.get(name, ())) for name, each in names.items()]


@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_are_accepted(name, capfd):
    for seed in TARGETS[name].seeds():
        check(TARGETS[name], seed)


@pytest.mark.parametrize(("target", "path"), _corpus())
def test_input_of_an_earlier_finding_passes(target, path):
    check(target, path.read_bytes())


@pytest.mark.slow
@pytest.mark.parametrize("name", WITHOUT_OPEN_FINDINGS)
def test_mutated_inputs_give_no_finding(name):
    """The inputs are the same in every run."""
    tally = harness.fuzz(TARGETS[name], 1, MAX_SECONDS, MAX_INPUTS)
    assert not tally.findings, tally.findings[0]
    assert tally.inputs


def _failing(run) -> Target:
    return Target("failing", lambda: [b"seed"], run)


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
        check(_failing(run), b"x")


def test_harness_reports_a_crash_of_a_fragile_target():
    def crash(data: bytes, folder: Path) -> str:
        os.kill(os.getpid(), signal.SIGSEGV)
        return "not reached"

    with pytest.raises(Finding, match="ended with -11"):
        check(Target("crash", lambda: [b""], crash, fragile=True), b"x")


def test_input_of_a_finding_is_minimised():
    def refuse(data: bytes, folder: Path) -> str:
        assert b"\x7f" not in data
        return "fine"

    target = _failing(refuse)
    with pytest.raises(Finding) as finding:
        check(target, bytes(range(256)))
    assert harness.minimise(target, finding.value) == b"\x7f"


def test_different_findings_are_counted_separately():
    def run(data: bytes, folder: Path) -> str:
        if len(data) > 8:
            raise ValueError("too long")
        assert data[:1] != b"\xff"
        return "fine"

    tally = harness.fuzz(_failing(run), 1, 60.0, max_inputs=800)
    assert {finding.place.split()[0] for finding in tally.findings} == {"ValueError", "AssertionError"}
    assert tally.outcomes["fine"] > 100
