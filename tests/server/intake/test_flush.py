import pytest
from support import servers
from triquad_format.wire.messages import FlushReply, FlushRequest
from triquad_server.intake import source_ledger
from triquad_server.intake.source_ledger import ARRIVAL_GRACE_S, SourceLedger


@pytest.fixture
def ledger():
    return SourceLedger()


@pytest.fixture
def flush(ledger):
    return lambda request, publish_soon=lambda: None: ledger.answer(
        request, publish_soon, lambda _: ()
    )


def asks(sequence=0, **changes):
    return FlushRequest(
        **({"source": "lidar", "session": 7, "waited_s": ARRIVAL_GRACE_S} | changes),
        sequence=sequence,
    )


def none_arrived(scans):
    """The reply about a session of which the server never heard."""
    why = (
        "source 'lidar': none of this client's scans arrived: access control does not let it "
        "publish as this source (a role names its sources), or the server was started again since"
    )
    return FlushReply(True, 0, 0, scans, None, (why,))


def test_a_scan_that_may_still_arrive_is_not_done_and_lost_later(flush, ledger):
    ledger.arrive(servers.scan(0))
    ledger.take(servers.scan(0))
    ledger.publish()
    assert flush(asks(1, waited_s=0.0)) == FlushReply(False, 1, 0, 0, None)
    assert flush(asks(1)) == FlushReply(True, 1, 0, 1, None)
    assert ledger.lost() == {}, "it may still come"


def test_an_epoch_is_asked_for_once_the_scan_is_in_the_map(flush, ledger):
    asked = []
    ledger.arrive(servers.scan(0))
    assert not flush(asks(), lambda: asked.append(1)).done
    assert not asked
    ledger.take(servers.scan(0))
    assert not flush(asks(), lambda: asked.append(1)).done
    assert asked
    ledger.publish()
    assert flush(asks()) == FlushReply(True, 1, 0, 0, None)


def test_questions_about_strangers_push_nobody_out(flush, ledger, monkeypatch):
    monkeypatch.setattr(source_ledger, "MAX_SESSIONS", 2)
    ledger.arrive(servers.scan(0))
    for session in range(100, 110):
        assert flush(asks(4, session=session)) == none_arrived(5)
    ledger.take(servers.scan(0))
    assert ledger.is_settled("lidar", 7, 0)
    assert ledger.lost() == {}
