"""Which messages of several publishers are accepted, by their numbers; over DDS in test_publishers.py."""

import pytest
from st_predictor.nodes._inputs import SILENCE_TIMEOUT, PublisherLock

OURS, OTHER = "/oxts_bridge", "/intruder"


def running(count=1000):
    """(a lock after `count` messages of one publisher, 10 ms apart; time of the newest)."""
    one = PublisherLock()
    one.update([OURS])
    for k in range(1, count + 1):
        assert one.accept(k, 0.01 * k)
    assert one.describe_competition(0.01 * count) == ""
    return one, 0.01 * count


def test_a_single_publisher_is_accepted_with_any_numbers():
    one = PublisherLock()
    one.update([OURS])
    assert [one.accept(number, 0.0) for number in (5, 9, 1, None)] == [True] * 4


def test_a_second_publisher_is_named_at_once_and_rejected():
    one, now = running()
    one.update([OURS, OTHER])
    assert OTHER in one.describe_competition(now) and "only the first one" in one.describe_competition(now)
    for k in range(1, 101):
        assert one.accept(1000 + k, now)
        assert not one.accept(k, now)
    assert one.rejected == 100
    one.update([OURS])
    assert one.describe_competition(now) == "" and one.accept(1101, now)


def test_two_publishers_from_the_start_are_both_rejected():
    one = PublisherLock()
    one.update([OURS, OTHER])
    assert not one.accept(7, 0.0) and not one.accept(900, 0.0)
    assert "none is used" in one.describe_competition(0.0)


@pytest.mark.parametrize("ahead", [-999, -3, 2, 40])
def test_a_second_chain_of_near_numbers_is_distinguished(ahead):
    one, now = running()
    one.update([OURS, OTHER])
    for k in range(1001, 1101):
        assert not one.accept(k + ahead, now)
        assert one.accept(k, now)
    assert "only the first one" in one.describe_competition(now)


def test_chains_that_meet_are_both_rejected_until_one_publisher_remains():
    """The other publisher sends twice as often and reaches the same numbers."""
    one, now = running()
    one.update([OURS, OTHER])
    used = [(number, one.accept(number, now)) for k in range(1, 21) for number in (989 + 2 * k, 990 + 2 * k, 1000 + k)]
    assert [number for number, ours in used if ours] == list(range(1001, 1009))
    assert "cannot be distinguished" in one.describe_competition(now)
    one.update([OTHER])
    assert one.accept(1031, now)


def test_two_candidates_after_a_loss_are_both_rejected():
    one, now = running()
    one.update([OURS, OTHER])
    later = now + 1.1 * SILENCE_TIMEOUT
    assert not one.accept(1300, later - 0.2 * SILENCE_TIMEOUT)
    assert not one.accept(1110, later) and not one.accept(1301, later)


def test_a_restarted_publisher_is_accepted_while_the_killed_one_is_in_the_graph():
    one, now = running()
    one.update([OURS, OURS])
    later = now + 1.1 * SILENCE_TIMEOUT
    assert one.accept(1, later) and one.accept(2, later)
    assert one.describe_competition(later) == ""


def test_a_second_publisher_of_the_same_name_is_rejected_and_named():
    one, now = running()
    one.update([OURS, OURS])
    assert not one.accept(1, now) and one.accept(1001, now)
    assert one.describe_competition(now).startswith("published by 2 nodes: /oxts_bridge, /oxts_bridge")


def test_another_name_is_not_accepted_when_the_first_is_silent():
    one, now = running()
    one.update([OURS, OTHER])
    later = now + 2.0 * SILENCE_TIMEOUT
    assert not one.accept(1, later) and not one.accept(2, later)
    assert one.accept(1005, later)  # ours, after a loss


@pytest.mark.parametrize("number", [None, 0])
def test_without_numbers_two_publishers_are_rejected(number):
    one, now = running()
    one.update([OURS, OTHER])
    assert not one.accept(number, now)
