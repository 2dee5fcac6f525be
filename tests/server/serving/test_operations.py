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
from triquad_server.serving import refusals as module
from triquad_server.serving.operations import Operations
from triquad_server.serving.refusals import RefusalSender
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


class Request:
    """Is refused once its client reads."""

    def __init__(self, size, reads):
        self.size = size
        self.refused_by = None
        self._reads = reads

    def refuse(self, code, text):
        self._reads.wait(WAIT_S)
        self.refused_by = threading.current_thread()


def test_large_requests_that_are_refused_do_not_pile_up_behind_who_reads_nothing():
    reads, at_once = threading.Event(), threading.Event()
    at_once.set()
    sender = RefusalSender()
    stuck = [Request(100, reads) for _ in range(module._REFUSING_THREADS)]
    large = [Request(module._REFUSED_BYTES // 2 + 1, at_once) for _ in range(10)]
    for request in (*stuck, *large):
        sender.send(request, "too_large", "")
    assert sum(request.refused_by is None for request in large) == 1
    assert large[-1].refused_by is threading.current_thread()
    reads.set()
    sender.close()
    assert all(request.refused_by for request in (*stuck, *large))
