"""The shipped DBC and table, and changed copies of them."""

import time
from pathlib import Path

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
def decoder(dbc_file, signals_file) -> Decoder:
    return Decoder(dbc_file, signals_file)


@pytest.fixture
def changed_dbc(dbc_file, tmp_path):
    """changed_dbc(old, new) -> path of the DBC with one text replaced."""

    def change(old: str, new: str) -> Path:
        text = dbc_file.read_text()
        assert text.count(old) == 1
        path = tmp_path / "changed.dbc"
        path.write_text(text.replace(old, new))
        return path

    return change


@pytest.fixture
def changed_table(signals_file, tmp_path):
    """changed_table(lambda messages: ...) -> path of the table after a change in place."""

    def change(edit) -> Path:
        document = yaml.safe_load(signals_file.read_text())
        edit(document["messages"])
        path = tmp_path / "changed.yaml"
        path.write_text(yaml.safe_dump(document))
        return path

    return change


def frame(arbitration_id: int, data: str | bytes, **options) -> can.Message:
    payload = bytes.fromhex(data) if isinstance(data, str) else data
    return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=payload, **options)


@pytest.fixture(name="frame")
def _frame():
    return frame


@pytest.fixture
def until():
    """until(condition): waits for it, at most ten seconds, and returns whether it became true."""

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
    """start_receiver(...) -> a started Receiver; `seen`: (frame, time_ns) each, `states`: (state, reason) each."""
    started = []

    def start(open_bus, on_frame=None, **options) -> Receiver:
        seen, states = [], []
        receiver = Receiver(open_bus, on_frame or (lambda frame, time_ns: seen.append((frame, time_ns))),
                            on_state=lambda state, reason: states.append((state, reason)), **options)
        receiver.seen, receiver.states = seen, states
        started.append(receiver)
        receiver.start()
        return receiver

    yield start
    for receiver in started:
        receiver.stop()
