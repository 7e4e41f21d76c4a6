"""Messages of several publishers accepted by their sequence numbers; over DDS in test_publishers.py."""

import pytest
from st_predictor.nodes._inputs import SILENCE_TIMEOUT, PublisherLock
from st_ros.polling import UNRESOLVED_NODE

OURS, OTHER = "/oxts_bridge", "/intruder"


def make_lock_in_use(count=1000):
    """A lock after `count` messages of one publisher at intervals of 10 ms, and the time of the newest [s]."""
    lock = PublisherLock()
    lock.update([OURS])
    for k in range(1, count + 1):
        assert lock.accept(k, 0.01 * k)
    assert lock.describe_conflict(0.01 * count) == ""
    return lock, 0.01 * count


def test_single_publisher_is_accepted_with_any_numbers():
    lock = PublisherLock()
    lock.update([OURS])
    assert [lock.accept(number, 0.0) for number in (5, 9, 1, None)] == [True] * 4


def test_second_publisher_is_reported_immediately_and_rejected():
    lock, now = make_lock_in_use()
    lock.update([OURS, OTHER])
    assert OTHER in lock.describe_conflict(now) and "first publisher" in lock.describe_conflict(now)
    for k in range(1, 101):
        assert lock.accept(1000 + k, now)
        assert not lock.accept(k, now)
    assert lock.rejected_count == 100
    lock.update([OURS])
    assert lock.describe_conflict(now) == "" and lock.accept(1101, now)


def test_two_publishers_from_the_start_are_both_rejected():
    lock = PublisherLock()
    lock.update([OURS, OTHER])
    assert not lock.accept(7, 0.0) and not lock.accept(900, 0.0)
    assert "none is used" in lock.describe_conflict(0.0)


def test_restarted_publisher_is_accepted_although_the_killed_one_was_never_received():
    lock = PublisherLock()
    lock.update([OURS, OURS])
    assert [lock.accept(number, 0.01 * number) for number in (1, 2, 4)] == [True, True, False]
    assert lock.accept(5, 0.04 + 1.1 * SILENCE_TIMEOUT)


def test_two_publishers_with_unknown_names_are_both_rejected():
    lock = PublisherLock()
    lock.update([UNRESOLVED_NODE, UNRESOLVED_NODE])
    assert not lock.accept(1, 0.0) and not lock.accept(7, 0.0)


@pytest.mark.parametrize("ahead", [-999, -3, 2, 40])
def test_second_sequence_of_similar_numbers_is_distinguished(ahead):
    lock, now = make_lock_in_use()
    lock.update([OURS, OTHER])
    for k in range(1001, 1101):
        assert not lock.accept(k + ahead, now)
        assert lock.accept(k, now)
    assert "first publisher" in lock.describe_conflict(now)


def test_sequences_that_coincide_are_rejected_until_one_publisher_remains():
    """The other publisher sends twice as often and reaches the same numbers."""
    lock, now = make_lock_in_use()
    lock.update([OURS, OTHER])
    used = [(number, lock.accept(number, now)) for k in range(1, 21) for number in (989 + 2 * k, 990 + 2 * k, 1000 + k)]
    assert [number for number, accepted in used if accepted] == list(range(1001, 1009))
    assert "cannot be distinguished" in lock.describe_conflict(now)
    lock.update([OTHER])
    assert lock.accept(1031, now)


def test_two_candidates_after_a_loss_are_both_rejected():
    lock, now = make_lock_in_use()
    lock.update([OURS, OTHER])
    later = now + 1.1 * SILENCE_TIMEOUT
    assert not lock.accept(1300, later - 0.2 * SILENCE_TIMEOUT)
    assert not lock.accept(1110, later) and not lock.accept(1301, later)


def test_restarted_publisher_is_accepted_while_the_killed_one_is_in_the_graph():
    lock, now = make_lock_in_use()
    lock.update([OURS, OURS])
    later = now + 1.1 * SILENCE_TIMEOUT
    assert lock.accept(1, later) and lock.accept(2, later)
    assert lock.describe_conflict(later) == ""


def test_second_publisher_of_the_same_name_is_rejected_and_reported():
    lock, now = make_lock_in_use()
    lock.update([OURS, OURS])
    assert not lock.accept(1, now) and lock.accept(1001, now)
    assert lock.describe_conflict(now).startswith("published by 2 nodes (/oxts_bridge, /oxts_bridge)")


@pytest.mark.parametrize("name", [OURS, OTHER])
@pytest.mark.parametrize("ahead", [-3000, -40, 40, 3000])
@pytest.mark.parametrize("lost", [{1300}, range(1300, 1600)])
def test_messages_of_two_live_publishers_are_not_mixed_after_a_loss(name, ahead, lost):
    lock, now = make_lock_in_use(count=5000)
    lock.update([OURS, name])
    accepted = []
    for k in range(1, 3000):
        sent = [(5000 + ahead + k, 0.005), *([(5000 + k, 0.0)] if k not in lost else [])]
        accepted += [number - 5000 - k for number, delay in sent if lock.accept(number, now + 0.01 * k + delay)]
    reached_lost_number = "none is used" in lock.describe_conflict(now + 30.0)
    assert {*accepted} == {0} and reached_lost_number == (ahead == -40)
    assert len(accepted) > (1000 if reached_lost_number else 2500)


def test_other_publisher_of_the_same_name_is_not_accepted_after_it_lost_messages():
    lock, now = make_lock_in_use()
    lock.update([OURS, OURS])
    assert lock.accept(1001, now) and not lock.accept(9000, now)
    assert not any(lock.accept(9000 + k, now + 0.01 * k) for k in range(1, 500) if k != 90)


def test_restarted_publisher_is_accepted_while_another_of_the_same_name_sends():
    lock, now = make_lock_in_use()
    lock.update([OURS, OURS])
    assert not lock.accept(9000, now - 0.001) and lock.accept(1001, now)
    lock.update([OURS, OURS, OURS])
    assert not any(lock.accept(9000 + k, now + 0.01 * k) for k in range(1, 150))
    assert [lock.accept(number, now + 1.5) for number in (1, 9150, 2, 9151, 3)] == [True, False, True, False, True]


def test_other_publisher_is_not_accepted_while_the_first_is_silent():
    lock, now = make_lock_in_use()
    lock.update([OURS, OTHER])
    later = now + 2.0 * SILENCE_TIMEOUT
    assert not lock.accept(1, later) and not lock.accept(2, later)
    assert lock.accept(1005, later)  # the first publisher after lost messages


@pytest.mark.parametrize("name", [OURS, OTHER])
@pytest.mark.parametrize("number", [None, 0])
def test_without_numbers_two_publishers_are_rejected(number, name):
    lock, now = make_lock_in_use()
    lock.update([OURS, name])
    assert not lock.accept(number, now) and not lock.accept(number, now + 2.0 * SILENCE_TIMEOUT)
