import math
import threading
from contextlib import closing

import pytest
from support import servers
from support.requests import PendingRequest
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import FlushReply, FlushRequest
from triquad_server.intake import flush, source_ledger
from triquad_server.intake.flush import FlushHandler
from triquad_server.intake.source_ledger import SourceLedger


@pytest.fixture
def ledger():
    return SourceLedger()


@pytest.fixture
def handler(ledger, monkeypatch):
    monkeypatch.setattr(flush, "ARRIVAL_GRACE_S", 0.0)
    with closing(FlushHandler(ledger, lambda: None, 8)) as handler:
        yield handler


def asks(sequence=0, **changes):
    return FlushRequest(
        **({"source": "lidar", "session": 7, "timeout_s": 60.0} | changes), sequence=sequence
    )


def none_arrived(scans):
    """The reply about a session of which the server never heard."""
    why = (
        "source 'lidar': none of this client's scans arrived: access control does not let it "
        "publish as this source (a role names its sources), or the server was started again since"
    )
    return FlushReply(0, 0, scans, None, why)


@pytest.mark.parametrize(
    "request_",
    [
        asks(-1),
        asks(source_ledger.MAX_SEQUENCE),
        asks(2**63 - 1),
        asks(source=""),
        asks(source="a/b"),
        asks(source="a" * 65),
        asks(timeout_s=math.nan),
        asks(timeout_s=math.inf),
        asks(timeout_s=-1.0),
    ],
)
def test_requests_out_of_range_are_refused_and_others_are_answered(handler, request_):
    with pytest.raises(RefusedError) as caught:
        handler.add(PendingRequest(request_))
    assert caught.value.code == "bad_request"
    good = PendingRequest(asks(2))
    handler.add(good)
    assert good.reply == none_arrived(3)


def test_an_internal_error_ends_one_request_and_no_other(handler):
    bad, good = PendingRequest(asks(), defect=RuntimeError("a defect")), PendingRequest(asks())
    handler.add(bad)
    assert bad.reply == "internal"
    handler.add(good)
    assert good.reply == none_arrived(1)


def test_a_scan_that_stays_out_of_the_map_ends_in_a_timeout(handler, ledger):
    ledger.arrive(servers.scan(0))
    request = PendingRequest(asks(timeout_s=0.01))
    handler.add(request)
    assert request.reply == "timeout"


def test_an_epoch_is_asked_for_once_the_scan_is_in_the_map(ledger):
    asked = threading.Event()
    with closing(FlushHandler(ledger, asked.set, 8)) as handler:
        request = PendingRequest(asks())
        ledger.arrive(servers.scan(0))
        handler.add(request)
        ledger.take(servers.scan(0))
        assert asked.wait(servers.WAIT_S)
        ledger.publish()
        assert request.reply == FlushReply(1, 0, 0, None)


def test_who_flushes_too_much_is_refused_and_no_other(ledger):
    ledger.arrive(servers.scan(0))
    with closing(FlushHandler(ledger, lambda: None, limit=8)) as handler:
        greedy = [PendingRequest(asks(), owner="greedy") for _ in range(8)]
        honest = PendingRequest(asks(), owner="honest")
        for request in (*greedy, honest):
            handler.add(request)
        assert greedy[-1].reply == "busy"
        ledger.take(servers.scan(0))
        ledger.publish()
        assert honest.reply == FlushReply(1, 0, 0, None)


def test_a_client_that_does_not_read_its_reply_holds_up_no_other(ledger, monkeypatch):
    monkeypatch.setattr(flush, "ARRIVAL_GRACE_S", 0.0)
    reads = threading.Event()
    stuck, other = PendingRequest(asks()), PendingRequest(asks(1))
    stuck.answer = lambda _: reads.wait(servers.WAIT_S)
    with closing(FlushHandler(ledger, lambda: None, limit=8)) as handler:
        for request in (stuck, other):
            handler.add(request)
        lost = other.reply.lost
        reads.set()
    assert lost == 2


def test_pending_requests_are_refused_when_the_server_stops(ledger):
    request = PendingRequest(asks())
    with closing(FlushHandler(ledger, lambda: None, 8)) as handler:
        ledger.arrive(servers.scan(0))
        handler.add(request)
    assert request.reply == "timeout"


def test_questions_about_strangers_push_nobody_out(handler, ledger, monkeypatch):
    monkeypatch.setattr(source_ledger, "MAX_SESSIONS", 2)
    ledger.arrive(servers.scan(0))
    for session in range(100, 110):
        stranger = PendingRequest(asks(4, session=session))
        handler.add(stranger)
        assert stranger.reply == none_arrived(5)
    ledger.take(servers.scan(0))
    assert ledger.is_settled("lidar", 7, 0)
    assert ledger.lost() == {}
