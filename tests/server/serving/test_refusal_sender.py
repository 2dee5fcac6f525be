"""What is refused while other clients do not read their refusals."""

import threading

from support.servers import WAIT_S
from triquad_server.serving import operations as module
from triquad_server.serving.operations import RefusalSender


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
