"""The DBC and the signal table of the Leaf, edited copies of them, and receivers."""

import math
import time
from pathlib import Path
from typing import Any

import can
import pytest
import yaml
from canedge_bridge.decode import Decoder
from canedge_bridge.receiver import Receiver

CONFIG = Path(__file__).resolve().parents[4] / "config" / "can"


@pytest.fixture(scope="session")
def dbc_file() -> Path:
    return CONFIG / "leaf_ze0.dbc"


@pytest.fixture(scope="session")
def signals_file() -> Path:
    return CONFIG / "leaf_ze0.yaml"


@pytest.fixture
def node_parameters(dbc_file, signals_file) -> dict[str, Any]:
    """Parameters of the node on a loopback bus."""
    return {"interface": "udp_multicast", "channel": "239.74.13.90", "dbc_file": dbc_file,
            "signals_file": signals_file, "steering_ratio": 17.3, "steering_wheel_offset": math.radians(-2.7)}


@pytest.fixture
def decoder(dbc_file, signals_file) -> Decoder:
    return Decoder(dbc_file, signals_file)


@pytest.fixture
def edit_dbc(dbc_file, tmp_path):
    """edit_dbc(old, new) -> path of a copy of the DBC with one text replaced."""

    def edit(old: str, new: str) -> Path:
        text = dbc_file.read_text()
        assert text.count(old) == 1
        path = tmp_path / "edited.dbc"
        path.write_text(text.replace(old, new))
        return path

    return edit


@pytest.fixture
def edit_table(signals_file, tmp_path):
    """edit_table(change) -> path of a copy of the table after change(messages), which edits in place."""

    def edit(change) -> Path:
        document = yaml.safe_load(signals_file.read_text())
        change(document["messages"])
        path = tmp_path / "edited.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return edit


@pytest.fixture
def frame():
    """frame(arbitration_id, data, **options) -> frame with 11 identifier bits. data: bytes or hexadecimal text."""

    def make(arbitration_id: int, data: str | bytes, **options) -> can.Message:
        payload = bytes.fromhex(data) if isinstance(data, str) else data
        return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=payload, **options)

    return make


@pytest.fixture
def wait_until():
    """wait_until(condition, limit=10.0) -> whether the condition became true within the limit [s]."""

    def wait(condition, limit: float = 10.0) -> bool:
        end = time.monotonic() + limit
        while not condition():
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        return True

    return wait


@pytest.fixture
def start_receiver():
    """start_receiver(...) -> a started Receiver; `received`: (frame, time_ns), `states`: (state, reason)."""
    started = []

    def start(open_bus, on_frame=None, **options) -> Receiver:
        received, states = [], []
        receiver = Receiver(open_bus, on_frame or (lambda frame, time_ns: received.append((frame, time_ns))),
                            on_state=lambda state, reason: states.append((state, reason)), **options)
        receiver.received, receiver.states = received, states
        started.append(receiver)
        receiver.start()
        return receiver

    yield start
    for receiver in started:
        receiver.stop()
