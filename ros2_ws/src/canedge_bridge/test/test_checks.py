"""Checksum rules on recorded bytes, and the check of message counters."""

import numpy as np
import pytest
from canedge_bridge.checks import CHECKSUM_RULES, CheckSpec, CounterCheck, Mode, find_counter_faults
from canedge_bridge.extraction import Field, stack_bytes
from hypothesis import given
from hypothesis import strategies as st

XOR_NIBBLE = CheckSpec("", Field((), 4, 4, 4), Mode.WARN, CHECKSUM_RULES["xor_nibble"][1])
SUM8 = CheckSpec("", Field((), 7, 0, 8), Mode.DROP, CHECKSUM_RULES["sum8_id"][1])
SECOND = 1_000_000_000


def test_check_nibble_of_a_recorded_steering_frame():
    data = bytes.fromhex("1D000007B0")
    assert XOR_NIBBLE.compute(data, 0x002) == 0xB


def test_sum_computed_by_hand():
    # 0x3C + 6 + 0x3C + 0x2B + 0x1D + 0x10 + 7 = 0xDD; + 0x02 + 0x84 = 0x163
    data = bytes.fromhex("3C063C2B1D100700")
    assert SUM8.compute(data, 0x284) == 0x63
    assert SUM8.compute(data, 0x285) == 0x64


@given(data=st.binary(min_size=5, max_size=5), bit=st.integers(0, 39))
def test_nibble_detects_every_single_bit_error(data, bit):
    nibble = XOR_NIBBLE.compute(data, 2)
    damaged = bytearray([*data[:4], data[4] & 0xF | nibble << 4])
    damaged[bit // 8] ^= 1 << bit % 8
    assert XOR_NIBBLE.compute(bytes(damaged), 2) != XOR_NIBBLE.field.read(bytes(damaged))


@given(frames=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5), identifier=st.integers(0, 2**29 - 1))
def test_checksums_of_many_frames_equal_those_of_single_frames(frames, identifier):
    data = stack_bytes(np.frombuffer(b"".join(frames), np.uint8).reshape(-1, 8), 8)
    for check in (XOR_NIBBLE, SUM8):
        assert check.compute(data, identifier).tolist() == [check.compute(frame, identifier) for frame in frames]
        assert check.is_correct(data, identifier).tolist() == [check.is_correct(frame, identifier) for frame in frames]


def check_counters(values, step_ns=10_000_000):
    """(whether each counter value is accepted, number of lost frames)."""
    check = CounterCheck(Field((), 0, 0, 4), SECOND)
    return [check.accepts(bytes([v]), i * step_ns) for i, v in enumerate(values)], check.lost


@pytest.mark.parametrize(("values", "accepted", "lost"), [
    ([13, 14, 15, 0, 1], [True] * 5, 0),
    ([3, 4, 7, 8], [True, True, False, True], 2),
    ([3, 3, 4], [True, False, True], 0),
    ([15, 1], [True, False], 1),
    ([5, 4, 5], [True, False, True], 14),
])
def test_counter_detects_lost_and_repeated_frames(values, accepted, lost):
    assert check_counters(values) == (accepted, lost)


def test_any_counter_is_accepted_after_an_interruption():
    assert check_counters([3, 9], step_ns=2 * SECOND) == ([True, True], 0)


def test_any_counter_is_accepted_after_the_clock_was_set_back():
    check = CounterCheck(Field((), 0, 0, 4), SECOND)
    assert check.accepts(b"\x03", 10 * SECOND)
    assert check.accepts(b"\x09", 0)
    assert check.accepts(b"\x0a", 1000)


def test_skipped_frame_is_not_lost():
    check = CounterCheck(Field((), 0, 0, 4), SECOND)
    check.accepts(b"\x03", 0)
    check.skip(1)
    assert check.accepts(b"\x05", 2)
    assert check.lost == 0


@given(frames=st.lists(st.tuples(st.integers(0, 15), st.integers(-SECOND, 2 * SECOND), st.booleans()), min_size=1))
def test_counters_of_a_log_are_judged_like_those_of_single_frames(frames):
    field, check = Field((), 0, 0, 4), CounterCheck(Field((), 0, 0, 4), SECOND)
    counters, steps, wrong_checksum = (np.array(column) for column in zip(*frames, strict=True))
    time_ns = np.cumsum(steps)
    faults = []
    for counter, time, is_wrong in zip(counters.tolist(), time_ns.tolist(), wrong_checksum, strict=True):
        faults.append(not is_wrong and not check.accepts(bytes([counter]), time))
        if is_wrong:
            check.skip(time)
    data = stack_bytes(counters.astype(np.uint8)[:, None], 1)
    assert find_counter_faults(field, data, time_ns, wrong_checksum, SECOND).tolist() == faults
