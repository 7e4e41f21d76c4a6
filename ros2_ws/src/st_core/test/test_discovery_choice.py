"""When a gain is believed: what healthy runs gain, and whether the runs agree in it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from st_core.discovery import manoeuvres
from st_core.discovery.choice import (
    AGREED,
    BUILT_IN,
    LITTLE,
    LITTLE_MORE,
    LITTLE_SLOWER,
    MOMENTARY,
    MUCH_FASTER,
    SLOWER,
    SLOWER_BUILT_IN,
    TAIL,
    TAIL_AGREED,
    by_chance,
    null_of,
)
from st_core.discovery.floor import precisions, restless_of
from st_core.discovery.quadratic import Quadratic
from st_core.discovery.result import FoundEffect
from st_core.discovery.several import SHARE_TOGETHER, TOGETHER, excess, incomplete
from st_core.effects import EFFECTS

SUSPECT, HEALTHY = np.array([0.9, 1.4, 1.0]), np.array([-0.3, 0.2, 0.1, 0.4])


class Space:
    """Two effects of one parameter each."""

    def __len__(self) -> int:
        return 2

    def indices(self, *names: str) -> np.ndarray:
        return np.array([i for i, name in enumerate("ab") if name in names], int)


def saying(values: np.ndarray, weight: float, fitted: float = 0.0, blocks: int = 3) -> tuple[Quadratic, np.ndarray]:
    """Runs of some blocks, each of which says its value of the first parameter with a weight; as seen from `fitted`."""
    run = np.repeat(np.arange(len(values)), blocks)
    hessian = np.tile(np.diag([weight, 1.0]) / blocks, (len(run), 1, 1))
    gradient = np.stack([(values - fitted)[run] * weight / blocks, np.zeros(len(run))], axis=1)
    return Quadratic(cost=np.zeros(len(run)), gradient=gradient, hessian=hessian, windows=np.full(len(run), 5)), run


def studied(weight: float, inflation: float = 1.0, fitted: float = 1.0):
    """A fit of the first effect at `fitted` and the study it is of."""
    q, run = saying(SUSPECT, weight, fitted)
    healthy, healthy_run = saying(HEALTHY, weight)
    floor = SimpleNamespace(inflation=inflation, quadratic=healthy, run=healthy_run)
    study = SimpleNamespace(space=Space(), floor=floor, deviation=lambda fit: np.array([fitted, 0.3]),
                            windows=SimpleNamespace(block=np.arange(len(run)), run=run))
    return SimpleNamespace(names=("a",), quadratic=q), study


@pytest.mark.parametrize("fitted", [1.0, -0.4])
def test_runs_that_scatter_are_compared_as_student_does(fitted):
    """Where windows are sure of each run's value, only the scatter of the runs counts; from wherever it is seen."""
    wanted = stats.ttest_ind(SUSPECT, HEALTHY, equal_var=True).pvalue
    assert by_chance(*studied(1e7, fitted=fitted)) == pytest.approx(wanted, rel=1e-5)


def test_runs_that_agree_within_noise_are_compared_by_the_noise():
    weight, inflation = 2.0, 1.5
    error = np.sqrt(inflation / weight * (1 / len(SUSPECT) + 1 / len(HEALTHY)))
    z = (SUSPECT.mean() - HEALTHY.mean()) / error
    wanted = 2.0 * stats.t.sf(z, len(SUSPECT) + len(HEALTHY) - 2)
    assert by_chance(*studied(weight, inflation)) == pytest.approx(wanted, rel=1e-9)


def null(values: np.ndarray):
    q, run = saying(values, 50.0)
    spread = 0.04 * np.eye(2)
    floor = SimpleNamespace(spread=spread, inflation=1.0,
                            restless=restless_of(q, run, 1.0, precisions(spread, [np.array([0]), np.array([1])])))
    return null_of(q, run, floor, Space(), "ab", 9, np.random.default_rng(0))


def test_gains_fall_off_more_slowly_where_healthy_runs_differ():
    same, changing = null(np.array([0.01, -0.01, 0.02])), null(np.array([1.0, -1.2, 0.4]))
    assert same.fall == pytest.approx(TAIL_AGREED)
    assert changing.fall == pytest.approx(TAIL_AGREED * SLOWER)
    assert changing.middle > same.middle
    assert (same.built_in, changing.built_in) == (1.0, pytest.approx(SLOWER / SLOWER_BUILT_IN))
    assert null(np.array([0.5])).fall == TAIL  # one run says nothing of others


def test_a_gain_counts_less_where_runs_disagree_and_more_for_what_is_built_in():
    changing = null(np.array([1.0, -1.2, 0.4]))
    gain, built_in = changing.middle + 30.0, sorted(BUILT_IN)[:1]
    in_all = changing.comparable(gain, ["a"], AGREED)
    assert in_all == changing.comparable(gain, ["a"], 0.1 * AGREED) == pytest.approx(gain)
    assert changing.comparable(gain, ["a"], 0.5) < changing.comparable(gain, ["a"], 0.05) < in_all
    assert changing.comparable(gain, built_in, AGREED) == pytest.approx(changing.middle + 60.0)
    assert changing.comparable(gain, [*built_in, "a"], AGREED) == in_all
    assert set(EFFECTS) >= BUILT_IN | MOMENTARY
    assert changing.probability(changing.threshold(0.01)) == pytest.approx(0.01)


def test_more_must_be_gained_where_an_effect_explains_little_alone():
    same, changing = null(np.array([0.01, -0.01, 0.02])), null(np.array([1.0, -1.2, 0.4]))
    gain, explained = same.middle + 30.0, np.array([9.0, 1.25, 1.0, 0.5, 0.3, 0.1]) * LITTLE
    over = [same.comparable(gain, ["a"], AGREED, e) - same.middle for e in explained]
    assert over == pytest.approx([30.0 / MUCH_FASTER, 37.5, 30.0, 15.0, 9.0, 30.0 / LITTLE_SLOWER])
    assert same.comparable(gain, ["a"], AGREED, -1.0) == same.comparable(gain, ["a"], AGREED, 0.0)
    # Not asked of what acts in moments only; and what gains less than half of the healthy does is not helped by it.
    assert same.comparable(gain, sorted(MOMENTARY), AGREED, 0.0) == pytest.approx(gain)
    assert same.comparable(same.middle - 1.0, ["a"], AGREED, 0.0) == pytest.approx(same.middle - 1.0)
    # Where gains fall off slowly anyway hardly more is asked for.
    gain = changing.middle + 30.0
    assert changing.comparable(gain, ["a"], AGREED, 0.0) == pytest.approx(changing.middle + 30.0 / LITTLE_MORE)
    assert changing.comparable(gain, sorted(BUILT_IN)[:1], AGREED, 0.0) == pytest.approx(
        changing.middle + 30.0 * SLOWER / LITTLE_SLOWER)


def test_a_gap_in_few_blocks_shows_in_the_mean():
    q, _ = saying(np.zeros(10), 1.0, blocks=1)
    cost = np.where(np.arange(10) < 2, 40.0, 5.0)  # of 5 windows each
    fit = SimpleNamespace(quadratic=Quadratic(cost, q.gradient, q.hessian, q.windows), cost=float(cost.sum()) / 2.0)
    study = SimpleNamespace(floor=SimpleNamespace(inflation=2.0, level=np.ones(7)))
    assert excess(study, fit) == pytest.approx(1.0)
    assert excess(study, fit, np.mean) == pytest.approx((2 * 8.0 + 8 * 1.0) / 10)


@pytest.mark.parametrize("slower", [1.0, 6.0])
def test_an_answer_is_incomplete_where_all_effects_together_explain_much_more(slower):
    answer = SimpleNamespace(cost=500.0)  # of 1500
    most = TOGETHER * slower + SHARE_TOGETHER * 1000.0

    def told(left: float) -> bool:
        study = SimpleNamespace(base=SimpleNamespace(cost=1500.0), space=SimpleNamespace(hypotheses=("a", "b")),
                                promise=lambda names, fits, near: left if names == ("a", "b") else np.nan)
        return incomplete(study, answer, {}, slower)
    assert told(500.0 - most - 1.0)
    assert not told(500.0 - most + 1.0)


@pytest.mark.parametrize(("speed", "looked_at"), [
    (4.0, {"S1"}), (12.0, {"step", "ramp_to_limit", "lane_change", "brake_in_turn"}), (30.0, set())])
def test_drives_are_asked_for_at_speeds_like_those_driven(monkeypatch, speed, looked_at):
    seen = set()
    monkeypatch.setattr(manoeuvres, "_strengths", lambda study, manoeuvre, *others: seen.add(manoeuvre.name) or {})
    study = SimpleNamespace(windows=SimpleNamespace(speeds=np.array([[speed, np.nan], [speed, speed]])))
    effect = FoundEffect("a", {}, ("b",), 0.5)
    assert manoeuvres.following(study, [effect], {"a": None, "b": None}) is None
    assert seen == looked_at
