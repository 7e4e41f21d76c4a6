"""Signals of one frame and of many frames against cantools."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from canedge_bridge.extraction import Extractor, has_length, stack_bytes, strip_padding
from canedge_bridge.signals import load_dbc
from hypothesis import given, settings
from hypothesis import strategies as st

DATABASE = load_dbc(Path(__file__).resolve().parents[4] / "config" / "can" / "leaf_ze0.dbc")


def extract_one(message, data):
    """Signals of one frame by name."""
    extractors = [Extractor(message, signal) for signal in message.signals]
    return {e.signal.name: e.extract(data) for e in extractors if e.is_present(data)}


def extract_all(message, frames):
    """Signals of many frames by name, one dictionary per frame."""
    data = stack_bytes(np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1), message.length)
    found = [{} for _ in frames]
    for signal in message.signals:
        extractor = Extractor(message, signal)
        sent = np.broadcast_to(extractor.is_present(data), len(frames))
        for k, value in enumerate(extractor.extract(data)):
            if sent[k]:
                found[k][signal.name] = value
    return found


def assert_equal_to_cantools(message, frames):
    expected = [message.decode(data, decode_choices=False) for data in frames]
    assert [extract_one(message, data) for data in frames] == expected
    assert extract_all(message, frames) == expected


@settings(max_examples=150, deadline=None)
@given(message=st.sampled_from(DATABASE.messages), data=st.data())
def test_any_frames_are_decoded_like_cantools(message, data):
    frame = st.binary(min_size=message.length, max_size=message.length)
    assert_equal_to_cantools(message, data.draw(st.lists(frame, min_size=1, max_size=10)))


def test_extreme_frames_of_every_message_are_decoded_like_cantools():
    generator = np.random.default_rng(1)
    extremes = [bytes(8), b"\xff" * 8, b"\x80" + bytes(7), bytes(7) + b"\x80", b"\x7f" + b"\xff" * 7]
    for message in DATABASE.messages:
        frames = [data[: message.length] for data in extremes + [generator.bytes(8) for _ in range(200)]]
        assert_equal_to_cantools(message, frames)


LAYOUTS = st.tuples(st.booleans(), st.booleans(), st.integers(1, 64), st.integers(0, 63),
                    st.sampled_from([1, 0.1, -0.5, 1e-7]), st.sampled_from([0, -40, 0.25]))


@settings(max_examples=300, deadline=None)
@given(layout=LAYOUTS, data=st.binary(min_size=8, max_size=8))
def test_any_layout_is_decoded_like_cantools(layout, data):
    """One signal anywhere in the frame, either byte order, signed or not, 1 to 64 bits."""
    big_endian, signed, length, first, scale, offset = layout
    first %= 65 - length
    start = 8 * (first // 8) + 7 - first % 8 if big_endian else first
    database = cantools.database.load_string(
        f'VERSION ""\nBU_:\nBO_ 5 M: 8 Vector__XXX\n SG_ S : {start}|{length}@{int(not big_endian)}'
        f'{"-" if signed else "+"} ({scale},{offset}) [0|0] "" Vector__XXX\n', "dbc")
    expected = database.decode_message(5, data)
    assert extract_one(database.messages[0], data) == expected
    # Integers of more than 53 bits have no exact float: cantools keeps them as integers, an array cannot.
    (found,) = extract_all(database.messages[0], [data])
    assert found["S"] == pytest.approx(float(expected["S"]), rel=0 if length <= 53 else 1e-15, abs=0)


@pytest.mark.parametrize(("kind", "length", "data", "value"), [
    (1, 32, "000020C0", -2.5), (2, 64, "00000000000004C0", -2.5)])
def test_floating_point_signals_of_both_sizes(kind, length, data, value):
    database = cantools.database.load_string(
        f'VERSION ""\nBU_:\nBO_ 2147483653 M: {length // 8} X\n SG_ S : 0|{length}@1- (1,0) [0|0] "" X\n'
        f'SIG_VALTYPE_ 2147483653 S : {kind};\n', "dbc")
    frame = bytes.fromhex(data)
    assert extract_one(database.messages[0], frame) == {"S": value}
    assert extract_all(database.messages[0], [frame, frame]) == [{"S": value}] * 2


MULTIPLEXED = """VERSION ""
BU_: X
BO_ 5 M: 8 X
 SG_ Which M : 0|4@1+ (1,0) [0|0] "" X
 SG_ Inner m1M : 4|4@1+ (1,0) [0|0] "" X
 SG_ A m0 : 8|16@1- (0.1,0) [0|0] "" X
 SG_ B m1 : 15|16@0- (0.5,1) [0|0] "" X
 SG_ C m3 : 24|8@1+ (1,0) [0|0] "" X
 SG_ Always : 32|8@1+ (1,0) [0|0] "" X

SG_MUL_VAL_ 5 Inner Which 1-1;
SG_MUL_VAL_ 5 A Which 0-0;
SG_MUL_VAL_ 5 B Which 1-1;
SG_MUL_VAL_ 5 C Inner 3-3;
"""


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.integers(2, 4), st.binary(min_size=7, max_size=7)), min_size=1,
                max_size=20))
def test_multiplexed_signals_are_decoded_like_cantools(rows):
    database = cantools.database.load_string(MULTIPLEXED, "dbc")
    message, frames = database.messages[0], [bytes([which | inner << 4]) + rest for which, inner, rest in rows]
    for data, found in zip(frames, extract_all(message, frames), strict=True):
        assert extract_one(message, data) == found
        if data[0] & 15 == 0 or data[0] == 0x31:  # cantools rejects selectors without a signal
            assert found == message.decode(data, decode_choices=False)
        else:
            assert "A" not in found and "C" not in found and "Always" in found


@pytest.mark.parametrize(("further", "accepted"), [
    (b"", True), (bytes(3), True), (b"\xff" * 7, True), (b"\xaa" * 59, True), (b"\0\0\1", False), (b"\1", False)])
def test_further_bytes_are_accepted_only_as_padding(further, accepted):
    data = bytes([0xE7, 0xFF, 0, 7, 0]) + further
    wide = np.zeros((1, 64), np.uint8)
    wide[0, : len(data)] = list(data)
    assert has_length(wide, np.array([len(data)]), 5).tolist() == [accepted]
    assert (strip_padding(data, 5) == data[:5]) == accepted
