"""A virtual CAN interface per test, and receivers on it."""

from pathlib import Path

import pytest
import vcan
from canedge_bridge.decode import Decoder
from canedge_bridge.receiver import Receiver
from canedge_bridge.transport import open_bus
from support import ROOT

NAME = "stvcan0"


@pytest.fixture(scope="session")
def no_can() -> str:
    return vcan.unavailable()


@pytest.fixture
def interface(no_can):
    """A vcan interface that is up; deleted after the test."""
    if no_can:
        pytest.skip(f"{no_can}; test_guest.py runs this test in a guest with CAN")
    created = vcan.Interface(NAME)
    created.create()
    yield created
    if created.exists():
        created.delete()


@pytest.fixture(scope="session")
def can_files() -> tuple[Path, Path]:
    return ROOT / "config" / "can" / "leaf_ze0.dbc", ROOT / "config" / "can" / "leaf_ze0.yaml"


@pytest.fixture
def decoder(can_files) -> Decoder:
    return Decoder(*can_files)


@pytest.fixture
def start_receiver(interface):
    """start_receiver(...) -> a running Receiver with lists: `seen` (frame, time_ns), `states` (state, reason)."""
    started = []

    def start(on_frame=None, filters=None, silence=0.5) -> Receiver:
        seen, states, name = [], [], interface.name
        receiver = Receiver(lambda: open_bus("socketcan", name, filters),
                            on_frame or (lambda frame, time_ns: seen.append((frame, time_ns))),
                            on_state=lambda state, reason: states.append((state, reason)), silence=silence,
                            network_interface=name)
        receiver.seen, receiver.states = seen, states
        started.append(receiver)
        receiver.start()
        return receiver

    yield start
    for receiver in started:
        receiver.stop()
