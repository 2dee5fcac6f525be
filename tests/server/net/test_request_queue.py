import threading

import pytest
from support.servers import WAIT_S
from triquad_server.fair_queue import Owner
from triquad_server.net import request_queue
from triquad_server.net.request_queue import MOST_LONG, MOST_SHORT, RequestQueue, SetAsideError

A, B, C = Owner("a"), Owner("b"), Owner("c")


class Work:
    """Has requests begin, which the test then works at by hand."""

    def __init__(self, workers=2, limit=10, several=True):
        self.begun = {}
        self.several = several
        self.queue = RequestQueue(
            lambda job: self.begun.__setitem__(job.request, job),
            lambda: self.several,
            workers=workers,
            limit=limit,
            limit_bytes=100,
        )

    def put(self, owner, *requests):
        excess = []
        for each in requests:
            placed = self.queue.put(owner, each, 1)
            excess += placed.excess
            if placed.begun is not None:
                self.begun[placed.begun.request] = placed.begun
        return excess

    def pause(self, request):
        """Pause in a thread; returns an event that tells when it goes on."""
        goes_on = threading.Event()

        def pause():
            self.queue.pause(self.begun[request])
            goes_on.set()

        threading.Thread(target=pause, daemon=True).start()
        return goes_on


def test_while_several_ask_one_request_of_each_is_worked_at():
    work = Work()
    work.put(A, "a1", "a2")
    work.put(B, "b1")
    assert set(work.begun) == {"a1", "b1"}
    work.queue.finish(work.begun["b1"])
    assert set(work.begun) == {"a1", "b1"}
    work.queue.finish(work.begun["a1"])
    assert set(work.begun) == {"a1", "b1", "a2"}


def test_one_who_asks_alone_has_all_workers():
    work = Work(several=False)
    work.put(A, "a1", "a2", "a3")
    assert set(work.begun) == {"a1", "a2"}


def test_a_request_that_pauses_lets_others_begin_and_goes_on_after_them():
    work = Work(workers=1)
    work.put(A, "long")
    work.put(B, "b1")
    work.put(C, "c1")
    goes_on = work.pause("long")
    while "b1" not in work.begun:
        pass
    work.queue.send(work.begun["b1"])
    assert "c1" in work.begun
    assert not goes_on.is_set()
    work.queue.send(work.begun["c1"])
    assert goes_on.wait(WAIT_S)


def test_a_request_that_rests_leaves_its_worker_to_others_and_goes_on_by_itself():
    work = Work(workers=1)
    work.put(A, "long")
    work.put(B, "b1")
    rests = threading.Thread(target=work.queue.rest, args=(work.begun["long"], 0.05))
    rests.start()
    while "b1" not in work.begun:
        pass
    rests.join(0.1)
    assert rests.is_alive(), "it went on while all workers were at work"
    work.queue.finish(work.begun["b1"])
    rests.join(WAIT_S)
    assert not rests.is_alive()
    work.put(C, "c1")
    assert "c1" not in work.begun, "the one worker is at work again"


def test_a_short_request_begins_however_many_long_ones_there_are():
    work = Work(workers=MOST_LONG + 1, limit=100)
    greedy = [Owner(f"greedy-{number}") for number in range(2 * MOST_SHORT)]
    for owner in greedy:
        work.put(owner, owner)
        job = work.begun[owner]
        if owner in greedy[:MOST_LONG]:
            work.queue.rest(job, 0.0)
            continue
        with pytest.raises(SetAsideError):
            work.queue.rest(job, 0.0)
        work.queue.put_back(job)
        work.queue.finish(job)
    work.put(A, "short")
    assert "short" in work.begun
    first, again = greedy[0], greedy[MOST_LONG]
    before = work.begun[again]
    work.queue.finish(work.begun[first])
    assert work.begun[again] is not before, "there is a place for one that was set aside"


def test_a_request_that_was_set_aside_is_the_next_of_its_owner():
    work = Work(workers=MOST_LONG + 1)
    for number in range(MOST_LONG + 1):
        work.put(Owner(str(number)), number)
    for number in range(MOST_LONG):
        work.queue.rest(work.begun[number], 0.0)
    last = Owner(str(MOST_LONG))
    work.put(last, "later")
    set_aside = work.begun[MOST_LONG]
    work.queue.put_back(set_aside)
    work.queue.finish(set_aside)
    assert "later" not in work.begun
    assert list(work.queue.clear()) == [MOST_LONG, "later"]


def test_where_nobody_waits_a_pause_is_none():
    work = Work(workers=1)
    work.put(A, "long", "another")
    work.queue.pause(work.begun["long"])
    assert set(work.begun) == {"long"}


def test_a_paused_request_is_overtaken_by_a_few_only():
    work = Work(workers=1, limit=100)
    work.put(A, "long")
    work.put(B, *range(50))
    goes_on = work.pause("long")
    done = 0
    while not goes_on.is_set():
        if done in work.begun:
            work.queue.finish(work.begun[done])
            done += 1
    assert done <= request_queue._MOST_OVERTAKING + 1


def test_who_takes_no_replies_is_answered_no_more_and_holds_up_nobody():
    work = Work(workers=1)
    work.put(A, "a1", "a2", "a3")
    work.queue.send(work.begun["a1"])  # and never arrives
    work.queue.send(work.begun["a2"])
    assert "a3" not in work.begun
    work.put(B, "b1")
    assert "b1" in work.begun
    work.queue.finish(work.begun["b1"])
    work.queue.finish(work.begun["a1"])  # the link is closed
    assert "a3" in work.begun


def test_the_one_with_most_requests_is_refused():
    work = Work(workers=1, limit=3)
    work.put(A, "a0")
    assert work.put(A, "a1", "a2", "a3", "a4") == ["a4"]
    assert work.put(B, "b1") == ["a3"]
    assert work.queue.metrics.waiting == 3
    assert set(work.queue.clear()) == {"a1", "a2", "b1"}


@pytest.mark.parametrize("times", [1, 3])
def test_a_reply_on_its_way_frees_one_worker_however_often_it_is_told(times):
    work = Work(workers=1)
    work.put(A, "a1")
    work.put(B, "b1")
    work.put(C, "c1")
    for _ in range(times):
        work.queue.send(work.begun["a1"])
    assert set(work.begun) == {"a1", "b1"}


def test_all_who_give_no_trustworthy_name_are_worked_at_one_by_one():
    work = Work()
    work.put(Owner("", "invented"), "i1")
    work.put(Owner("", "another"), "i2")
    work.put(A, "a1")
    assert set(work.begun) == {"i1", "a1"}
