"""Tests of whole processes may exceed their time limits on a busy machine. They have the marker `timing` with the
reason, and may be repeated once.

`./st test --last-failed --once-more`, as called by `.ci/run`, fails if a failed test does not have this marker.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

# Property tests must not fail because the machine is busy.
settings.register_profile("without time limits", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("without time limits")

# Tests started in the background of a script, and the processes that they start, would ignore SIGINT.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--once-more", action="store_true", help="with --last-failed: fail if one is not marked 'timing'")


def pytest_collection_finish(session: pytest.Session) -> None:
    if not session.config.getoption("--once-more") or session.config.option.collectonly:
        return
    unmarked = [item.nodeid for item in session.items if not item.get_closest_marker("timing")]
    if unmarked:
        raise pytest.UsageError("failed, and not marked 'timing': " + ", ".join(unmarked))
    print(f"\n{len(session.items)} failed tests are repeated:")
    for item in session.items:
        print(f"  {item.nodeid}: {item.get_closest_marker('timing').args[0]}")
