import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
import zenoh
from support.servers import WAIT_S, free_endpoint, raw_session
from triquad_format.wire import codec
from triquad_format.wire.origin import RequestOrigin
from triquad_server.fair_queue import Owner
from triquad_server.net import askers as module
from triquad_server.net.askers import Asker, Askers

A, B = (Asker(Owner(name), deadline_s=0.0) for name in "ab")


@pytest.fixture
def askers():
    with raw_session("peer") as session, closing(Askers(session)) as askers:
        yield askers


def test_one_who_asks_again_and_again_is_alone(askers):
    askers.hear_of(A)  # after nobody, which may count as another
    time.sleep(module._LATELY_S)
    askers.hear_of(A)
    assert not askers.are_several


def test_whoever_asked_much_is_not_forgotten_while_it_is_worked_at(askers):
    askers.hear_of(A)  # whose requests wait from now on
    askers.hear_of(B)
    time.sleep(module._LATELY_S)
    askers.hear_of(B)
    assert not askers.are_several
    askers.hear_of(A)  # a slice of them begins
    assert askers.are_several


class Query:
    """One whose attachment names somebody."""

    def __init__(self, name):
        self.attachment = zenoh.ZBytes(codec.encode(RequestOrigin(name, 1.0)))


def test_what_the_server_asks_itself_has_turns_that_nobody_else_can_take(askers):
    own = askers.asker(Query(askers.own_name), longest_s=60.0).owner
    assert own.group == askers.own_name
    assert askers.asker(Query("invented"), longest_s=60.0).owner.group == ""


def test_one_who_asks_before_the_link_was_heard_of_is_known():
    endpoint = free_endpoint()
    with raw_session("peer", listen=endpoint) as session:
        askers = Askers(session)
        askers.close()  # from now on, it hears of no link
        with raw_session(connect=endpoint) as client, ThreadPoolExecutor(1) as receiver:
            name = str(client.info.zid())
            asked = receiver.submit(askers.asker, Query(name), 60.0)
            assert asked.result(WAIT_S).owner.group == name
            assert askers.asker(Query("invented"), longest_s=60.0).owner.group == ""
