"""Signals by shift and mask are those of cantools, to the last bit."""

import math
import random

import cantools
import pytest
from canedge_bridge.extraction import Extractor
from canedge_bridge.signals import ANGLES, SignalSpec, wrap


def by_cantools(message, signals, data):
    physical = message.decode(data, decode_choices=False)
    values = {s.name: s.gain * physical[s.dbc.name] + s.bias for s in signals}
    return {name: wrap(value) if name in ANGLES else value for name, value in values.items()}


def same(ours, theirs):
    return ours.keys() == theirs.keys() and all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(ours.values(), theirs.values(), strict=True))


def test_every_message_of_the_leaf(decoder):
    chance = random.Random(5)
    for spec in decoder.table.messages.values():
        extract = Extractor(spec.dbc, spec.signals)
        for data in [bytes(spec.dbc.length), b"\xff" * spec.dbc.length,
                     *(chance.randbytes(spec.dbc.length) for _ in range(300))]:
            assert same(extract.si(data), by_cantools(spec.dbc, spec.signals, data)), (spec.name, data.hex())


LAYOUTS = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 100 Odd: 8 A
 SG_ L12 : 3|12@1- (0.3,-7.1) [0|0] "" A
 SG_ B13 : 22|13@0- (0.7,1.3) [0|0] "" A
 SG_ U1 : 24|1@0+ (1,0) [0|0] "" A
 SG_ L17 : 39|17@1+ (2,5) [0|0] "" A
 SG_ Scaled : 56|8@1- (-0.1,0) [0|0] "" A
BO_ 101 Floats: 12 A
 SG_ F32 : 0|32@1- (1,0) [0|0] "" A
 SG_ F32B : 39|32@0- (0.5,2) [0|0] "" A
 SG_ Rest : 64|32@1+ (1,0) [0|0] "" A
BO_ 102 Whole: 8 A
 SG_ F64 : 0|64@1- (1,0) [0|0] "" A
BO_ 103 WholeBig: 8 A
 SG_ U64 : 7|64@0+ (0.5,0) [0|0] "" A
BO_ 104 Long: 64 A
 SG_ Far : 500|12@1- (1,0) [0|0] "" A
 SG_ FarBig : 423|16@0- (0.01,0) [0|0] "" A

SIG_VALTYPE_ 101 F32 : 1;
SIG_VALTYPE_ 101 F32B : 1;
SIG_VALTYPE_ 102 F64 : 2;
"""


@pytest.mark.parametrize("name", ["Odd", "Floats", "Whole", "WholeBig", "Long"])
def test_every_layout(name):
    message = cantools.database.load_string(LAYOUTS, "dbc").get_message_by_name(name)
    signals = [SignalSpec(s, "ins_yaw" if k == 0 and not s.is_float else s.name, "", 1.1, 0.2, 1.0, -math.inf, math.inf,
                          math.inf) for k, s in enumerate(message.signals)]
    extract, chance = Extractor(message, signals), random.Random(7)
    for data in (chance.randbytes(message.length) for _ in range(500)):
        assert same(extract.si(data), by_cantools(message, signals, data)), data.hex()
