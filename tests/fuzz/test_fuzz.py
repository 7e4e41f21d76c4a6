"""Hostile bytes at every reader, for seconds here and for as long as one likes with `./st bench fuzz`."""

import os
import signal
from pathlib import Path

import pytest

from fuzz import harness
from fuzz.harness import Finding, Target, check
from fuzz.targets import TARGETS

MOST_EACH, SECONDS_EACH = 40, 5.0

# Findings that are known and not put right yet: input in corpus/ -> what is wrong.
OPEN: dict[str, str] = {}
SOUND = sorted(set(TARGETS) - {name.partition("/")[0] for name in OPEN})


def _kept() -> list:
    found = [(target, path) for target in TARGETS.values() for path in target.corpus]
    marks = {name: pytest.mark.xfail(reason=why, raises=Finding) for name, why in OPEN.items()}
    names = [f"{target.name}/{path.name}" for target, path in found]
    return [pytest.param(*each, id=name, marks=marks.get(name, ())) for each, name in zip(found, names, strict=True)]


@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_are_taken(name, capfd):
    for seed in TARGETS[name].seeds():
        check(TARGETS[name], seed)


@pytest.mark.parametrize(("target", "path"), _kept())
def test_what_once_was_a_finding(target, path):
    check(target, path.read_bytes())


@pytest.mark.parametrize("name", SOUND)
def test_a_short_run(name):
    """Always the same inputs: what is new is found by the long run."""
    tally = harness.fuzz(TARGETS[name], 1, SECONDS_EACH, MOST_EACH)
    assert not tally.findings, tally.findings[0]
    assert tally.inputs


def _failing(run) -> Target:
    return Target("failing", lambda: [b"seed"], run)


def _hang(data: bytes, folder: Path) -> str:
    signal.alarm(1)  # as if the time were over
    while True:
        pass


def _raise(data: bytes, folder: Path) -> str:
    raise KeyError(data)


def _waste(data: bytes, folder: Path) -> str:
    held = b"x" * (harness.MOST_MEMORY + (64 << 20))  # written to, or the system would not hand it out
    return f"fine, {len(held)}"


def _waste_slowly(data: bytes, folder: Path) -> str:
    held = _waste(data, folder)
    _hang(data, folder)
    return held


@pytest.mark.parametrize(("run", "message"), [
    (_hang, "Hang"), (_raise, "KeyError"), (_waste, "MB of memory"), (_waste_slowly, "Hang.*MB of memory"),
])
def test_the_harness_sees(run, message):
    with pytest.raises(Finding, match=message):
        check(_failing(run), b"x")


def test_the_harness_survives_a_crash():
    def crash(data: bytes, folder: Path) -> str:
        os.kill(os.getpid(), signal.SIGSEGV)
        return "not reached"

    with pytest.raises(Finding, match="ended with -11"):
        check(Target("crash", lambda: [b""], crash, fragile=True), b"x")


def test_a_finding_is_made_smaller():
    def refuse(data: bytes, folder: Path) -> str:
        assert b"\x7f" not in data
        return "fine"

    target = _failing(refuse)
    with pytest.raises(Finding) as found:
        check(target, bytes(range(256)))
    assert harness.smaller(target, found.value) == b"\x7f"


def test_findings_are_found_and_told_apart():
    def run(data: bytes, folder: Path) -> str:
        if len(data) > 8:
            raise ValueError("too long")
        assert data[:1] != b"\xff"
        return "fine"

    tally = harness.fuzz(_failing(run), 1, 60.0, most=800)
    assert {finding.place.split()[0] for finding in tally.findings} == {"ValueError", "AssertionError"}
    assert tally.outcomes["fine"] > 100
