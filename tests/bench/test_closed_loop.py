"""The closed loop: two live drives of one road are compared over the starts that both were scored at."""

import numpy as np
import pytest
from support import ROOT


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    import closed_loop
    return closed_loop


def test_a_stretch_that_one_drive_misses_is_not_compared(bench):
    time = np.arange(3.0, 45.0, 0.1)
    hard = (time > 20.0) & (time < 26.0)  # where the road is difficult, and the second drive lost its measurements
    whole = bench.Scored(time, {"linear": np.where(hard, 3.0, 0.3), "augmented": np.where(hard, 1.0, 0.1)})
    kept = ~((time > 20.0) & (time < 25.0))
    part = bench.Scored(time[kept] + 0.04, {"linear": whole.lateral["linear"][kept]})
    first, second = bench.compared(whole, part)
    assert first["starts"] == second["starts"] == kept.sum() < len(time)
    assert first["lateral"]["linear"] == second["lateral"]["linear"]
    expected = np.sqrt(np.mean(np.square(whole.lateral["augmented"][kept])))
    assert first["lateral"]["augmented"] == pytest.approx(expected)
    assert bench.compared(part, whole) == [second, first]


def test_one_drive_alone_is_told_as_it_is(bench):
    errors = np.array([0.3, -0.4])
    alone, = bench.compared(bench.Scored(np.array([3.0, 3.1]), {"linear": errors}))
    assert alone == {"starts": 2, "lateral": {"linear": pytest.approx(np.sqrt(0.125))}}
