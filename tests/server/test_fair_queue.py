import pytest
from triquad_server.fair_queue import FairQueue, Owner

A, B = Owner("a"), Owner("b")


def queue_of(limit=100, limit_bytes=1000, each=100, newest_go=True):
    return FairQueue(limit, limit_bytes, each, newest_go=newest_go)


def filled(queue, owner, items, nbytes=1):
    """Returns what is removed for the items."""
    return [removed for item in items for removed in queue.put(owner, item, nbytes)]


def test_an_owner_who_asks_again_and_again_does_not_come_first():
    queue = queue_of()
    filled(queue, A, "ab")
    filled(queue, B, "XY")
    assert queue.take() == "a"
    filled(queue, A, "c")
    assert queue.clear() == list("XbYc")


@pytest.mark.parametrize(("newest_go", "left"), [(True, "aXbcd"), (False, "bXcde")])
@pytest.mark.parametrize(("limit", "each"), [(5, 100), (100, 4)])
def test_who_has_most_or_too_many_loses_the_newest_or_the_oldest(newest_go, left, limit, each):
    queue = queue_of(limit, each=each, newest_go=newest_go)
    assert filled(queue, B, "X") == []
    assert filled(queue, A, "abcde") == [("e" if newest_go else "a")]
    assert sorted(queue.clear()) == sorted(left)
    assert len(queue) == 0


def test_a_single_item_may_be_larger_than_the_limit():
    queue = queue_of(limit_bytes=10)
    assert filled(queue, A, "a", nbytes=50) == []
    assert filled(queue, B, "X") == ["a"]
