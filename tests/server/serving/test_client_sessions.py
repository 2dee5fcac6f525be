"""A request is of a linked session where its name says so, and of one of all others where not."""

import time

import zenoh
from support.servers import WAIT_S, free_endpoint, raw_session
from triquad_format.wire import codec
from triquad_format.wire.messages import RequestOrigin
from triquad_server.serving.request_queue import ClientSessions


class Query:
    """One whose attachment names a client."""

    def __init__(self, name):
        self.attachment = zenoh.ZBytes(codec.encode(RequestOrigin(name, 1.0)))


def group(sessions, name):
    return sessions.source(Query(name), longest_s=60.0).owner.group


def test_who_is_linked_has_turns_of_its_own_until_it_leaves():
    endpoint = free_endpoint()
    with raw_session("peer", listen=endpoint) as session:
        sessions = ClientSessions(session)
        with raw_session(connect=endpoint) as client:
            name = str(client.info.zid())
            assert group(sessions, name) == name
            assert group(sessions, "invented") == ""
            owner = sessions.source(Query(name), longest_s=60.0).owner
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
