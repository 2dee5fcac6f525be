from triquad_server.fair_queue import FairQueue, Owner, first_to_go

A, B = Owner("a"), Owner("b")


def filled(queue, owner, items, nbytes=1):
    for item in items:
        queue.put(owner, item, nbytes)


def drained(queue):
    taken = []
    while (item := queue.take()) is not None:
        taken.append(item)
    return taken


def test_owners_take_turns_however_much_one_of_them_sends():
    queue = FairQueue(100, 100)
    filled(queue, A, "abcde")
    filled(queue, B, "XY")
    assert drained(queue) == list("aXbYcde")
    assert (len(queue), queue.nbytes) == (0, 0)


def test_names_of_one_group_share_its_turn():
    queue = FairQueue(100, 100)
    for name in "123":
        filled(queue, Owner("group", name), [f"{name}-", f"{name}+"])
    filled(queue, A, "abcd")
    assert drained(queue) == ["1-", "a", "2-", "b", "3-", "c", "1+", "d", "2+", "3+"]


def test_an_owner_who_asks_again_and_again_does_not_come_first():
    queue = FairQueue(100, 100)
    filled(queue, A, "ab")
    filled(queue, B, "XY")
    assert queue.take() == "a"
    filled(queue, A, "c")
    assert drained(queue) == list("XbYc")


def test_what_may_not_be_taken_is_passed_over():
    queue = FairQueue(100, 100)
    filled(queue, A, "ab")
    filled(queue, B, "X")
    assert queue.take(str.isupper) == "X"
    assert queue.take(str.isupper) is None
    assert drained(queue) == list("ab")


def test_who_has_most_loses_the_newest_or_the_oldest():
    for newest, left in ((True, "aXbcd"), (False, "bXcde")):
        queue = FairQueue(5, 100)
        filled(queue, A, "abcde")
        filled(queue, B, "X")
        assert queue.excess(newest=newest) == [("e" if newest else "a")]
        assert drained(queue) == list(left)


def test_where_bytes_are_too_many_who_has_most_of_them_loses():
    queue = FairQueue(100, 1000)
    filled(queue, A, "abcde", nbytes=1)
    filled(queue, B, "XY", nbytes=600)
    assert queue.excess(newest=True) == ["Y"]
    assert queue.nbytes == 605


def test_a_single_item_may_be_larger_than_the_limit():
    queue = FairQueue(100, 10)
    filled(queue, A, "a", nbytes=50)
    assert queue.excess(newest=True) == []
    filled(queue, B, "X")
    assert queue.excess(newest=True) == ["a"]


def test_many_invented_names_lose_to_one_owner():
    queue = FairQueue(4, 100)
    filled(queue, A, "a")
    for number in range(50):
        filled(queue, Owner("", str(number)), [number])
        queue.excess(newest=True)
    filled(queue, A, "b")
    assert len(queue.excess(newest=True)) == 1
    assert {"a", "b"} <= set(drained(queue))


def test_the_newest_of_whoever_has_most_goes_first():
    many, few, invented = Owner("greedy"), Owner("honest"), Owner("greedy", "another")
    assert first_to_go([(many, 1), (invented, 1), (many, 1), (few, 1)]) == 2
    assert first_to_go([(many, 1), (few, 1)]) == 1
    assert first_to_go([(many, 5), (few, 1), (few, 1)]) == 0
