"""Description of error frames with bits as in linux/can/error.h."""

import can
import pytest
from canedge_bridge.receiver import BusState, describe_error_frame
from hypothesis import given
from hypothesis import strategies as st


def error_frame(identifier, data=bytes(8)):
    return can.Message(arbitration_id=identifier, is_extended_id=False, is_error_frame=True, data=data)


@pytest.mark.parametrize(("identifier", "data", "text", "state"), [
    (0x040, "0000000000000000", "bus-off", BusState.BUS_OFF),
    (0x100, "0000000000000000", "controller restarted", BusState.OK),
    (0x004, "0010000000000000", "controller (receive error-passive)", BusState.ERROR_PASSIVE),
    (0x004, "0020000000000000", "controller (transmit error-passive)", BusState.ERROR_PASSIVE),
    (0x004, "0040000000000000", "controller (error-active)", BusState.OK),
    (0x004, "0004000000000000", "controller (receive warning level)", None),
    (0x088, "0000040000000000", "protocol violation (bit stuffing), bus error", None),
    (0x020, "0000000000000000", "no acknowledge", None),
    (0x200, "0000000000008060", "error counters (transmit 128, receive 96)", None),
    (0x002, "0500000000000000", "lost arbitration (bit 5)", None),
    (0x000, "", "unknown error class 0x0", None),
    (0x044, "00", "controller, bus-off", BusState.BUS_OFF),
])
def test_text_and_bus_state(identifier, data, text, state):
    assert describe_error_frame(error_frame(identifier, bytes.fromhex(data))) == (text, state)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_error_frame_is_described(identifier, data):
    assert describe_error_frame(error_frame(identifier, data))[0]
