"""Tests of whole processes can miss their time on a busy machine. Those marked `timing` say why, and may run once more.

`./st test --last-failed --once-more`, as `.ci/run` calls it, ends red where a test failed that has no such mark.
"""

import signal

import pytest
from hypothesis import HealthCheck, settings

# No property fails because the machine is busy.
settings.register_profile("without time limits", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("without time limits")

# Started in the background of a script, the tests ignore SIGINT, and so would all processes that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--once-more", action="store_true", help="with --last-failed: refuse tests not marked 'timing'")


def pytest_collection_finish(session: pytest.Session) -> None:
    if not session.config.getoption("--once-more") or session.config.option.collectonly:
        return
    unmarked = [item.nodeid for item in session.items if not item.get_closest_marker("timing")]
    if unmarked:
        raise pytest.UsageError("failed, and not marked 'timing': " + ", ".join(unmarked))
    print(f"\n{len(session.items)} failed tests run once more:")
    for item in session.items:
        print(f"  {item.nodeid}: {item.get_closest_marker('timing').args[0]}")
