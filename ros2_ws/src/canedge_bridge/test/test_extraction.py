"""A frame by cantools equals the frame in columns, to the last bit, also where the DBC does not list its selector."""

import random

import cantools
import numpy as np
import pytest
from canedge_bridge.extraction import decode_frame, decode_log

MULTIPLEXED = """VERSION ""
BS_:
BU_: A
BO_ 100 Multi: 8 A
 SG_ Common : 0|8@1- (0.3,-7.1) [0|0] "" A
 SG_ Which M : 8|2@1+ (1,0) [0|0] "" A
 SG_ First m0 : 16|12@1- (0.7,1.3) [0|0] "" A
 SG_ Second m1 : 22|13@0- (0.5,2) [0|0] "" A
 SG_ Rest : 32|32@1- (1,0) [0|0] "" A

SIG_VALTYPE_ 100 Rest : 1;
"""


@pytest.mark.parametrize(("selector", "names"), [
    (0, {"Common", "Which", "First", "Rest"}), (1, {"Common", "Which", "Second", "Rest"}),
    (2, {"Common", "Which", "Rest"}), (3, {"Common", "Which", "Rest"}),
])
def test_signals_of_a_multiplexed_frame(selector, names):
    database, rng = cantools.database.load_string(MULTIPLEXED, "dbc"), random.Random(selector)
    for _ in range(200):
        data = bytearray(rng.randbytes(8))
        data[1], data[7] = data[1] & 0xFC | selector, data[7] & 0x3F  # no NaN among the floats
        values = decode_frame(database.get_message_by_name("Multi"), bytes(data))
        columns = decode_log(database, np.array([100]), np.frombuffer(data, np.uint8)[None], np.array([8]))["Multi"]
        assert set(values) == names
        assert values == {name: column[0] for name, column in columns.signals.items() if not np.isnan(column[0])}
