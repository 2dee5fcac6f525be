"""What is refused while other clients do not read their refusals."""

import threading
from contextlib import closing

from support.servers import WAIT_S, raw_session
from triquad_server.net import request_handlers as module
from triquad_server.net.askers import Askers
from triquad_server.net.byte_budget import ByteBudget
from triquad_server.net.long_work import LongWork
from triquad_server.net.request_handlers import RequestHandlers, RequestLimits


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
    limits = RequestLimits(waiting=1, waiting_bytes=1, max_bytes=1, longest_s=1.0)
    with raw_session("peer") as session, closing(Askers(session)) as askers:
        handlers = RequestHandlers(
            session, {}, askers, LongWork(), ByteBudget(1, small=1), workers=1, limits=limits
        )
        stuck = [Request(100, reads) for _ in range(module._REFUSALS)]
        large = [Request(module._REFUSED_BYTES // 2, at_once) for _ in range(10)]
        for request in (*stuck, *large):
            handlers._refuse_aside(request, "too_large", "")
        assert sum(request.refused_by is None for request in large) == 1
        assert large[-1].refused_by is threading.current_thread()
        reads.set()
        handlers.close()
    assert all(request.refused_by for request in (*stuck, *large))
