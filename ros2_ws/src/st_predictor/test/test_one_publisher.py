"""Which messages of several publishers are used, by their numbers; over DDS in test_trouble.py."""

import pytest
from st_predictor.one_publisher import NEAR, PATIENCE, OnePublisher

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


def test_counts_too_near_each_other_stop_both_until_one_is_left():
    one, now = running()
    one.look([OURS, OTHER])
    assert not one.use(1000 - NEAR, now)
    assert not one.use(1001, now)
    assert "cannot be told apart" in one.says(now)
    one.look([OTHER])
    assert one.use(1002, now)


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
