"""Each operation has a lane: what is long keeps nobody waiting whose question is short.

What keeps a server from answering is told to who waits.
"""

import threading
from contextlib import closing

import numpy as np
import pytest
from support.servers import MAP, WAIT_S, RawPeer, free_endpoint, raw_session
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply, SdfReply, SdfRequest
from triquad_server.errors import MapperStoppedError
from triquad_server.serving.operations import Operations
from triquad_server.settings import ServiceSettings

LONG, SHORT = 4_000, 100

ORIGIN = np.zeros(3)
ALONE = (lambda _: None, lambda: ORIGIN)  # there is nothing to give way to


def question(count: int) -> bytes:
    points = np.zeros((count, 3), np.float32)
    return codec.encode(SdfRequest(np.zeros(3), points, False, 0))


def answer(count: int) -> SdfReply:
    return SdfReply(
        epoch=1, sdf=np.zeros(count, np.float32), status=np.zeros(count, np.uint8), gradient=None
    )


def test_short_questions_are_answered_while_any_number_of_long_ones_are_worked_at() -> None:
    endpoint, key = free_endpoint(), keys.operation_key(MAP, keys.SDF)
    begun, end = threading.Semaphore(0), threading.Event()

    def work(request: SdfRequest) -> SdfReply:
        if len(request.points) == LONG:
            begun.release()
            end.wait(WAIT_S)
        return answer(len(request.points))

    with (
        raw_session("peer", listen=endpoint) as session,
        closing(Operations(session, MAP, ServiceSettings(), *ALONE)) as operations,
        raw_session(connect=endpoint) as client,
    ):
        operations.serve(SdfRequest, work, max_bytes=10**6)
        waiting = [client.get(key, payload=question(LONG), timeout=WAIT_S) for _ in range(8)]
        assert begun.acquire(timeout=WAIT_S)
        (reply,) = client.get(key, payload=question(SHORT), timeout=WAIT_S)
        assert reply.ok is not None
        assert not end.is_set()
        end.set()
        assert all(reply.ok is not None for replies in waiting for reply in replies)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (MapperStoppedError("the mapper has stopped"), "busy", "the mapper has stopped"),
        (MemoryError("4 MiB"), "busy", "the system gives no more memory: 4 MiB"),
        (ZeroDivisionError("a defect"), "internal", "a defect"),
    ],
)
def test_who_is_not_answered_is_told_why_and_defects_alone_leave_a_traceback(
    caplog: pytest.LogCaptureFixture, error: Exception, code: str, text: str
) -> None:
    def fail(_: SdfRequest) -> SdfReply:
        raise error

    endpoint = free_endpoint()
    with (
        raw_session("peer", listen=endpoint) as session,
        closing(Operations(session, MAP, ServiceSettings(), *ALONE)) as operations,
        raw_session(connect=endpoint) as client,
    ):
        operations.serve(SdfRequest, fail)
        refusal = RawPeer(client).ask(keys.SDF, question(SHORT))
    assert isinstance(refusal, ErrorReply)
    assert refusal.code == code
    assert text in refusal.message
    assert ("Traceback" in caplog.text) == (code == "internal")


def test_large_requests_that_are_refused_do_not_pile_up() -> None:
    """More of them than there are threads that refuse: all senders get their answer."""
    endpoint = free_endpoint()
    with (
        raw_session("peer", listen=endpoint) as session,
        closing(Operations(session, MAP, ServiceSettings(), *ALONE)) as operations,
        raw_session(connect=endpoint) as client,
    ):
        operations.serve(SdfRequest, lambda _: answer(0))
        refusals = [RawPeer(client).refusal(keys.SDF, bytes(size)) for size in (20_000, 10**6) * 8]
    assert refusals == ["too_large"] * 16
