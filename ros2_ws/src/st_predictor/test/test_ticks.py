"""Tick counts of the predictor."""

from hypothesis import given
from hypothesis import strategies as st
from st_predictor.nodes.predictor import TickCounter

PERIOD = 100_000_000


def test_no_tick_is_due_before_the_inputs_are_known() -> None:
    counter = TickCounter()
    for _ in range(5):
        counter.count(0, "stale")
    assert counter.as_dict()["due"] == 0
    counter.count(3, None)
    assert counter.as_dict() == {
        "due": 1, "predicted": 1, "skipped_stale": 0, "skipped_overrun": 0, "skipped_slow": 0}


def test_ticks_of_a_slow_car_are_due() -> None:
    counter = TickCounter()
    counter.count(0, "slow")
    counter.count(0, "stale")
    assert counter.as_dict() == {
        "due": 2, "predicted": 0, "skipped_stale": 1, "skipped_overrun": 0, "skipped_slow": 1}


def test_clock_jitter_is_no_overrun() -> None:
    counter = TickCounter()
    for k, jitter in enumerate((0, 30_000_000, -40_000_000, 5)):
        assert counter.count_missed(k * PERIOD + jitter, PERIOD) == 0


def test_clock_jumps_are_no_overruns() -> None:
    counter = TickCounter()
    for due_ns in (10**18, 10**18 - 5 * 10**9, 10**18 + 3600 * 10**9):
        assert counter.count_missed(due_ns, PERIOD) == 0


@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from([None, "stale", "slow"])), min_size=1, max_size=50))
def test_every_tick_of_the_grid_is_counted_once(ticks: list[tuple[int, str | None]]) -> None:
    """Executed and dropped ticks together are the time grid since the first tick with inputs."""
    counter, due_ns, first = TickCounter(), 0, None
    for skipped_before, result in ticks:
        due_ns += (1 + skipped_before) * PERIOD
        counter.count(counter.count_missed(due_ns, PERIOD), result)
        if first is None and result != "stale":
            first = due_ns
    expected = 0 if first is None else (due_ns - first) // PERIOD + 1
    counts = counter.as_dict()
    assert counts["due"] == expected
    assert counts["predicted"] <= sum(result is None for _, result in ticks)
    assert counter.count_new_overruns() == counts["skipped_overrun"]
    assert counter.count_new_overruns() == 0
