"""Client sessions take turns at the workers, and none takes what is another's."""

import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
import zenoh
from support.servers import WAIT_S, free_endpoint, raw_session, until
from triquad_format.wire import codec
from triquad_format.wire.messages import RequestOrigin
from triquad_server.fair_queue import Owner
from triquad_server.serving.request import ClientSessions
from triquad_server.serving.request_queue import (
    _REPLY_BYTES,
    _SENDING_EACH,
    _SMALL_REPLY_BYTES,
    MOST_SENDING,
    RequestQueue,
)

A, B = "a", "b"


@dataclass(frozen=True)
class Request:
    owner: Owner
    number: int


class Work:
    """Has requests begin, which the test then works at by hand."""

    def __init__(self, workers=2, each=10, nbytes=1000):
        self.begun = []
        self.queue = RequestQueue(
            self.begun.append, workers=workers, requests_each=each, nbytes=nbytes
        )

    def put(self, group, *numbers, name="", nbytes=1):
        """Returns the numbers of those that are refused."""
        requests = [Request(Owner(group, name), number) for number in numbers]
        return [one.number for each in requests for one in self.queue.put(each, nbytes)]

    @property
    def numbers(self):
        return [request.number for request in self.begun]

    def send(self, number, nbytes=1):
        return self.queue.send(self._of(number), nbytes)

    def finish(self, number):
        self.queue.finish(self._of(number))

    def _of(self, number):
        return self.begun[self.numbers.index(number)]


@pytest.mark.parametrize(("workers", "begun"), [(1, 1), (2, 1), (4, 2)])
def test_a_session_has_half_of_the_workers_and_the_next_begins_at_once(workers, begun):
    work = Work(workers)
    work.put(A, *range(10))
    assert len(work.begun) == begun
    work.put(B, 100)
    assert (100 in work.numbers) == (workers > 1)


def test_all_clients_without_a_link_of_their_own_share_a_turn_and_take_turns_in_it():
    work = Work(workers=2)
    work.put("", 0, 1, 2, name="greedy")
    work.put("", 3, name="invented")
    work.put(A, 10)
    for number in (0, 1, 3):
        assert work.numbers[-1] == (10 if number == 0 else number)
        work.finish(number)
    assert work.numbers == [0, 10, 1, 3, 2]


def test_a_client_that_takes_no_replies_holds_up_nobody_and_is_answered_no_more():
    work = Work(workers=1)
    work.put(A, 0, 1, 2)
    for number in range(_SENDING_EACH):
        assert work.send(number)  # and never arrives
    work.put(B, 10)
    assert work.numbers == [0, 1, 10]
    work.finish(10)
    work.finish(0)  # the link is closed
    assert work.numbers == [0, 1, 10, 2]


def test_many_clients_that_take_no_replies_leave_room_for_those_of_others():
    work = Work(workers=1)
    for number in range(MOST_SENDING):
        work.put("", number, name=str(number))
        if number in work.numbers:
            work.send(number)
    assert len(work.begun) == MOST_SENDING // 2
    work.put(A, 100)
    assert 100 in work.numbers


def test_large_replies_share_the_memory_and_small_ones_always_go():
    work = Work(workers=8)
    for number in range(4):
        work.put(str(number), number)
    assert work.send(0, 2 * _REPLY_BYTES), "a single one may be larger"
    assert not work.send(1, _SMALL_REPLY_BYTES + 1)
    assert work.send(2, _SMALL_REPLY_BYTES)
    work.finish(0)
    assert work.send(1, _SMALL_REPLY_BYTES + 1)
    assert not work.send(3, _REPLY_BYTES)


def test_a_session_with_too_many_requests_is_refused_its_newest():
    work = Work(workers=1, each=2)
    assert work.put(A, 0, 1, 2, 3) == [3]
    assert work.put(B, 10) == []
    assert work.queue.metrics.waiting == 3
    assert {request.number for request in work.queue.clear()} == {1, 2, 10}


def test_where_all_have_too_many_bytes_the_one_with_most_is_refused():
    work = Work(workers=1, nbytes=100)
    work.put(A, 0)
    assert work.put(A, 1, 2, nbytes=45) == []
    assert work.put(B, 10, nbytes=20) == [2]


def test_a_single_request_may_be_larger_than_all_may_be_together():
    work = Work(workers=1, nbytes=100)
    work.put(A, 0)
    assert work.put(A, 1, nbytes=500) == []
    assert work.put(B, 10) == [1]


@pytest.mark.parametrize("seed", range(3))
def test_every_request_ends_once_whatever_happens(seed):
    chance = random.Random(seed)
    lock, ended, pool = threading.Lock(), [], ThreadPoolExecutor(50)

    def end(request):
        with lock:
            ended.append(request)

    def answer(request):
        if request.number % 7:
            queue.send(request, request.number)
            time.sleep(0.001 * (request.number % 3))
            queue.send(request, 0)  # twice does no harm
        end(request)
        queue.finish(request)

    def ask(client):
        for number in range(200):
            owner = Owner(chance.choice(["", client]), client)
            for excess in queue.put(Request(owner, number), number):
                end(excess)
            time.sleep(0.001 * chance.random())

    queue = RequestQueue(
        lambda request: pool.submit(answer, request),
        workers=chance.choice([1, 4]),
        requests_each=chance.choice([5, 100]),
        nbytes=10**6,
    )
    clients = [threading.Thread(target=ask, args=(f"client-{n}",)) for n in range(4)]
    for client in clients:
        client.start()
    for client in clients:
        client.join()
    until(lambda: len(ended) >= 800)
    pool.shutdown()
    assert len({id(request) for request in ended}) == len(ended) == 800
    assert queue.metrics.waiting == 0


class Query:
    """One whose attachment names a client."""

    def __init__(self, name):
        self.attachment = zenoh.ZBytes(codec.encode(RequestOrigin(name, 1.0)))


def group(sessions, name):
    return sessions.source(Query(name)).owner.group


def test_who_is_linked_has_turns_of_its_own_until_it_leaves():
    endpoint = free_endpoint()
    with raw_session("peer", listen=endpoint) as session:
        sessions = ClientSessions(session)
        with raw_session(connect=endpoint) as client:
            name = str(client.info.zid())
            assert group(sessions, name) == name
            assert group(sessions, "invented") == ""
            owner = sessions.source(Query(name)).owner
            assert not sessions.have_left(owner)
        until_s = time.monotonic() + WAIT_S
        while not sessions.have_left(owner):
            assert time.monotonic() < until_s, "its link is not known to be gone"
            time.sleep(0.01)
        assert group(sessions, name) == ""


def test_one_who_asks_before_its_link_is_known_has_turns_of_its_own():
    endpoint = free_endpoint()
    with raw_session("peer", listen=endpoint) as session:
        sessions = ClientSessions(session)
        assert group(sessions, "invented") == ""  # the links were read just now
        with raw_session(connect=endpoint) as client:
            name = str(client.info.zid())
            assert group(sessions, name) == name
