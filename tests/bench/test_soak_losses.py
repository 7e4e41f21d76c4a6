"""Which losses of the soak are nobody's."""

import numpy as np

from bench.soak import unexplained

SENT = np.arange(0, 600 * 250, dtype=np.int64) * 4_000_000
MINUTES = 10.0
FAULT = [(5.0, 5.1)]  # minutes


def test_a_steady_loss_is_counted():
    recorded = SENT[np.arange(len(SENT)) % 250 >= 4]
    assert 4 * 560 < unexplained(SENT, recorded, 0, FAULT, MINUTES) < 4 * 600


def test_a_loss_within_a_fault_is_its_own():
    recorded = SENT[(SENT < 300e9) | (SENT > 312e9)]
    assert unexplained(SENT, recorded, 0, FAULT, MINUTES) == 0
    assert unexplained(SENT, recorded, 0, [], MINUTES) == len(SENT) - len(recorded)


def test_a_packet_on_the_other_side_of_an_edge_is_not_lost():
    recorded = SENT.copy()
    recorded[250 * 100] -= 8_000_000
    assert unexplained(SENT, recorded, 0, FAULT, MINUTES) == 0
