"""Which messages of several publishers are used, by their numbers; over DDS in test_trouble.py."""

import pytest
from st_predictor.one_publisher import PATIENCE, OnePublisher

OURS, OTHER = "/oxts_bridge", "/intruder"


def running(count=1000):
    """One that has been alone for so many messages, 10 ms apart; (it, the time of the newest)."""
    one = OnePublisher()
    one.look([OURS])
    for k in range(1, count + 1):
        assert one.use(k, 0.01 * k)
    assert one.says(0.01 * count) == ""
    return one, 0.01 * count


def test_alone_it_is_used_whatever_its_numbers():
    one = OnePublisher()
    one.look([OURS])
    assert [one.use(number, 0.0) for number in (5, 9, 1, None)] == [True] * 4


def test_another_is_named_at_once_and_not_used():
    one, now = running()
    one.look([OURS, OTHER])
    assert OTHER in one.says(now) and "only the one that was there" in one.says(now)
    for k in range(1, 101):
        assert one.use(1000 + k, now)
        assert not one.use(k, now)
    assert one.unused == 100
    one.look([OURS])
    assert one.says(now) == "" and one.use(1101, now)


def test_two_that_were_there_from_the_start_are_both_left_aside():
    one = OnePublisher()
    one.look([OURS, OTHER])
    assert not one.use(7, 0.0) and not one.use(900, 0.0)
    assert "none is used" in one.says(0.0)


@pytest.mark.parametrize("ahead", [-999, -3, 2, 40])
def test_another_that_counts_near_ours_is_told_apart(ahead):
    one, now = running()
    one.look([OURS, OTHER])
    for k in range(1001, 1101):
        assert not one.use(k + ahead, now)
        assert one.use(k, now)
    assert "only the one that was there" in one.says(now)


def test_chains_that_meet_stop_both_until_one_is_left():
    """The other sends twice as often and catches up."""
    one, now = running()
    one.look([OURS, OTHER])
    used = [(number, one.use(number, now)) for k in range(1, 21) for number in (989 + 2 * k, 990 + 2 * k, 1000 + k)]
    assert [number for number, ours in used if ours] == list(range(1001, 1009))
    assert "cannot be told apart" in one.says(now)
    one.look([OTHER])
    assert one.use(1031, now)


def test_two_that_may_be_ours_after_a_loss_are_both_left_aside():
    one, now = running()
    one.look([OURS, OTHER])
    later = now + 1.1 * PATIENCE
    assert not one.use(1300, later - 0.2 * PATIENCE)
    assert not one.use(1110, later) and not one.use(1301, later)


def test_started_again_it_is_taken_while_the_dead_one_is_still_in_the_graph():
    one, now = running()
    one.look([OURS, OURS])
    later = now + 1.1 * PATIENCE
    assert one.use(1, later) and one.use(2, later)
    assert one.says(later) == ""


def test_a_second_of_the_same_name_is_left_aside_and_told():
    one, now = running()
    one.look([OURS, OURS])
    assert not one.use(1, now) and one.use(1001, now)
    assert one.says(now).startswith("published by 2 nodes: /oxts_bridge, /oxts_bridge")


def test_another_name_is_not_taken_when_ours_falls_silent():
    one, now = running()
    one.look([OURS, OTHER])
    later = now + 2.0 * PATIENCE
    assert not one.use(1, later) and not one.use(2, later)
    assert one.use(1005, later)  # ours, after a loss


@pytest.mark.parametrize("number", [None, 0])
def test_without_numbers_two_cannot_be_told_apart(number):
    one, now = running()
    one.look([OURS, OTHER])
    assert not one.use(number, now)
