"""The whole-log decoder against cantools, message by message and value by value."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from canedge_bridge.extraction import EXTENDED, decode_log, strip_padding
from canedge_bridge.signals import load_dbc
from hypothesis import given, settings
from hypothesis import strategies as st

DATABASE = load_dbc(Path(__file__).resolve().parents[4] / "config" / "can" / "leaf_ze0.dbc")


def arrays(frames):
    """[(id, payload)] -> ids, payload, lengths"""
    payload = np.zeros((len(frames), 8), np.uint8)
    for row, (_, data) in zip(payload, frames, strict=True):
        row[: len(data)] = list(data)
    return np.array([i for i, _ in frames], np.uint32), payload, np.array([len(d) for _, d in frames])


def assert_equal_to_cantools(database, frames):
    decoded = decode_log(database, *arrays(frames))
    taken = 0
    for name, columns in decoded.items():
        message = database.get_message_by_name(name)
        for place, row in enumerate(columns.rows):
            expected = message.decode(frames[row][1], decode_choices=False)
            assert {s: column[place] for s, column in columns.signals.items()} == expected
            taken += 1
    lengths = {m.frame_id | (EXTENDED if m.is_extended_frame else 0): m.length for m in database.messages}
    assert taken == sum(lengths.get(i) == len(data) for i, data in frames)


KNOWN = st.sampled_from(DATABASE.messages).flatmap(
    lambda m: st.tuples(st.just(m.frame_id), st.binary(min_size=m.length, max_size=m.length)))
OTHER = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))


@settings(max_examples=150, deadline=None)
@given(st.lists(KNOWN | OTHER, max_size=40))
def test_equal_to_cantools_on_any_frames(frames):
    assert_equal_to_cantools(DATABASE, frames)


def test_equal_to_cantools_on_every_message_of_the_dbc():
    generator = np.random.default_rng(1)
    corners = [bytes(8), b"\xff" * 8, b"\x80" + bytes(7), bytes(7) + b"\x80", b"\x7f" + b"\xff" * 7]
    frames = [(m.frame_id, data[: m.length]) for m in DATABASE.messages
              for data in corners + [generator.bytes(8) for _ in range(200)]]
    generator.shuffle(frames)
    assert_equal_to_cantools(DATABASE, [(int(i), data) for i, data in frames])


LAYOUTS = st.tuples(st.booleans(), st.booleans(), st.integers(1, 64), st.integers(0, 63),
                    st.sampled_from([1, 0.1, -0.5, 1e-7]), st.sampled_from([0, -40, 0.25]))


@settings(max_examples=300, deadline=None)
@given(layout=LAYOUTS, data=st.binary(min_size=8, max_size=8))
def test_equal_to_cantools_on_any_layout(layout, data):
    """One signal anywhere in the frame, either byte order, signed or not, 1 to 64 bits."""
    big, signed, length, first, scale, offset = layout
    first %= 65 - length
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    database = cantools.database.load_string(
        f'VERSION ""\nBU_:\nBO_ 5 M: 8 Vector__XXX\n SG_ S : {start}|{length}@{int(not big)}{"-" if signed else "+"} '
        f'({scale},{offset}) [0|0] "" Vector__XXX\n', "dbc")
    value = decode_log(database, *arrays([(5, data)]))["M"].signals["S"][0]
    # Integers of more than 53 bits have no exact double: cantools keeps them as integers, an array cannot.
    assert value == pytest.approx(float(database.decode_message(5, data)["S"]), rel=0 if length <= 53 else 1e-15, abs=0)


@pytest.mark.parametrize(("kind", "length", "data", "value"), [
    (1, 32, "000020C0", -2.5), (2, 64, "00000000000004C0", -2.5)])
def test_floating_point_signals(kind, length, data, value):
    database = cantools.database.load_string(
        f'VERSION ""\nBU_:\nBO_ 2147483653 M: {length // 8} X\n SG_ S : 0|{length}@1- (1,0) [0|0] "" X\n'
        f'SIG_VALTYPE_ 2147483653 S : {kind};\n', "dbc")
    columns = decode_log(database, *arrays([(5, bytes.fromhex(data)), (5 | EXTENDED, bytes.fromhex(data))]))["M"]
    assert columns.rows.tolist() == [1]
    assert columns.signals["S"].tolist() == [value]


def test_order_of_arrival_is_kept():
    frames = [(0x002, bytes([i, 0, 0, 0, 0])) for i in range(50)]
    mixed = [f for pair in zip(frames, [(0x604, bytes(4))] * 50, strict=True) for f in pair]
    columns = decode_log(DATABASE, *arrays(mixed), messages=["Leaf_Steering"])
    assert list(columns) == ["Leaf_Steering"]
    assert columns["Leaf_Steering"].rows.tolist() == list(range(0, 100, 2))
    assert columns["Leaf_Steering"].signals["SteeringWheelAngle"] == pytest.approx(-0.1 * np.arange(50))


def test_what_it_does_not_take():
    ids, payload, lengths = arrays([(2, bytes(5))])
    with pytest.raises(ValueError, match=r"expected shapes \(n,\)"):
        decode_log(DATABASE, ids, payload[:, :5], lengths)
    with pytest.raises(KeyError):
        decode_log(DATABASE, ids, payload, lengths, ["Nobody"])


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
def test_multiplexed_signals_are_those_of_cantools(rows):
    database = cantools.database.load_string(MULTIPLEXED, "dbc")
    frames = [(5, bytes([which | inner << 4]) + rest) for which, inner, rest in rows]
    columns = decode_log(database, *arrays(frames))["M"].signals
    for k, (_, data) in enumerate(frames):
        if data[0] & 15 == 0 or data[0] == 0x31:  # cantools refuses selectors without a signal
            expected = database.decode_message(5, data, decode_choices=False)
            assert {s: c[k] for s, c in columns.items() if not np.isnan(c[k])} == expected
        else:
            assert np.isnan(columns["A"][k]) and np.isnan(columns["C"][k])


@pytest.mark.parametrize(("rest", "taken"), [
    (b"", True), (bytes(3), True), (b"\xff" * 7, True), (b"\xaa" * 59, True), (b"\0\0\1", False), (b"\1", False)])
def test_only_padding_may_follow(rest, taken):
    data = bytes([0xE7, 0xFF, 0, 7, 0]) + rest
    wide = np.zeros((1, 64), np.uint8)
    wide[0, : len(data)] = list(data)
    assert bool(decode_log(DATABASE, np.array([2]), wide, np.array([len(data)]))) == taken
    assert (strip_padding(data, 5) == data[:5]) == taken


def test_nothing_in_nothing_out():
    assert decode_log(DATABASE, np.zeros(0, np.uint32), np.zeros((0, 8), np.uint8), np.zeros(0)) == {}
