"""What a reference teaches: how a run looks that was not learnt from."""

from types import SimpleNamespace

import numpy as np
from st_core.discovery import DiscoverySettings
from st_core.discovery.floor import CHANGING, MORE, SAME, SURROUNDINGS, drifts, least, of_a_new_run, restless_of
from st_core.discovery.quadratic import Quadratic, quadratic, whitening
from st_core.discovery.space import Space
from st_core.discovery.windows import CONDITIONS

WINDOWS = 8  # of a block


def made(block_run: np.ndarray, rows: np.ndarray, infinite: bool = False):
    """Windows with these errors and one parameter that moves them all alike, and what they cost as fitted."""
    run = np.repeat(block_run, WINDOWS)
    windows = SimpleNamespace(
        run=run, block=np.arange(len(run)) // WINDOWS, condition=np.zeros(len(run), int), time=np.ones(1),
        scored=np.ones((CONDITIONS, rows.shape[1]), bool), columns=("yaw_rate",) * rows.shape[1],
        settings=SimpleNamespace(noise=None))
    slopes = np.ones((1, *rows.shape))
    if infinite:
        slopes[0, 0, 0] = np.inf
    how = whitening(rows, windows.condition, least(windows), windows.scored)
    return windows, slopes, quadratic(rows, slopes, windows, how)


def as_new(windows, rows, slopes, own):
    space = SimpleNamespace(scale=np.ones(1), low=np.full(1, -50.0), high=np.full(1, 50.0))
    return of_a_new_run(windows, space, np.zeros(1), rows, slopes, own, windows.run[::WINDOWS], 1.0, np.zeros(1),
                        np.full(1, 1e3))


def errors(block_run: np.ndarray) -> np.ndarray:
    """Run r is off by r - 1."""
    rng = np.random.default_rng(0)
    return (np.repeat(block_run, WINDOWS) - 1.0 + 0.3 * rng.standard_normal(len(block_run) * WINDOWS))[:, None]


def test_a_run_costs_more_when_the_floor_was_not_learnt_from_it():
    block_run = np.repeat([0, 1, 2], 5)
    rows = errors(block_run)
    windows, slopes, own = made(block_run, rows)
    new = as_new(windows, rows, slopes, own)
    for run in (0, 2):
        mine = block_run == run
        assert abs(new.gradient[mine].sum()) > 1.1 * abs(own.gradient[mine].sum())
        assert new.cost[mine].sum() > own.cost[mine].sum()
    assert np.array_equal(new.windows, own.windows)
    assert (np.linalg.eigvalsh(new.hessian) >= 0.0).all()


def test_a_stub_of_a_run_does_not_judge_the_others():
    block_run = np.repeat([0, 1], [30, 1])
    rng = np.random.default_rng(0)
    rows = 0.1 * rng.standard_normal((31 * WINDOWS, 24)) @ rng.standard_normal((24, 24))
    windows, slopes, own = made(block_run, rows)
    assert np.median(as_new(windows, rows, slopes, own).cost) < 1.3 * np.median(own.cost)


def test_a_slope_that_is_infinite_counts_as_none():
    block_run = np.repeat([0, 1, 2], 5)
    rows = errors(block_run)
    windows, slopes, own = made(block_run, rows, infinite=True)
    assert np.isfinite(as_new(windows, rows, slopes, own).cost).all()


def test_a_restless_car_may_differ_by_more():
    space = Space("nonlinear", DiscoverySettings())
    same, changing = (drifts(space, 0.03, True, restless) for restless in (0.0, 1.0))
    assert np.allclose(changing, MORE * same)
    assert np.allclose(same[space.indices("mass")], SURROUNDINGS["mass"])
    assert np.allclose(same[space.indices("steering_ratio")], 0.03)


def test_runs_are_restless_as_far_as_each_gains_as_a_new_one():
    """One parameter of weight 1 held at 0 by the floor: freed, a run of gradient g and hessian 1 gains g^2 / 2."""
    weights = np.array([[[1.0]], [[1e-9]]])

    def told(gain: float) -> float:
        g = np.full((4, 1), np.sqrt(2.0 * gain))
        q = Quadratic(np.zeros(4), g * np.array([[1.0], [-1.0], [1.0], [-1.0]]), np.ones((4, 1, 1)), np.ones(4))
        return restless_of(q, np.arange(4), 1.0, weights)
    assert told(0.9 * SAME) == 0.0
    assert abs(told(0.5 * (SAME + CHANGING)) - 0.5) < 1e-6
    assert told(1.1 * CHANGING) == 1.0
