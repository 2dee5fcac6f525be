"""The operations that a server answers: each has a key, and is answered in a lane.

What is in one lane waits in one queue, and the same threads work at it.
"""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any

import zenoh
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import asked_from
from triquad_format.wire.metrics_messages import QueueMetrics
from triquad_map.compiled.team import THREADS, lower_priority

from triquad_server.errors import NO_MEMORY, MapperStoppedError
from triquad_server.process.threads import NICENESS, submit
from triquad_server.serving.long_work import LongWork
from triquad_server.serving.request import (
    ClientSessions,
    OperationCounts,
    Request,
    payload_size,
)
from triquad_server.serving.request_queue import MOST_SENDING, RequestQueue
from triquad_server.settings import ServiceSettings

_log = logging.getLogger(__name__)

_QUEUE_BYTES = 64_000_000  # of the requests of all clients that wait in a lane
_PLAIN_BYTES = 16_384  # of a request that holds neither points nor tiles
_LARGE_BYTES = 65_536  # of a request whose refusal the network's own thread sends
_REFUSING_THREADS = 2
_STOPPING = "the server is stopping"

_LONG_BYTES = 32_768
"""A question of more bytes is long: some 2,700 points, which take a server 10 ms."""


class Lane(Enum):
    """The operations that share a queue and its workers."""

    QUESTIONS = "questions"
    LONG_QUESTIONS = "long_questions"
    """The lane of questions about many places, which take a tenth of a second: short ones, such as
    a planner's, do not wait for them, and mapping is not slowed down."""

    ADMINISTRATION = "administration"
    """The lane of what takes no time: it is answered however many queries wait."""

    MESH = "mesh"
    """The lane of the mesh: requests come one after the other, and all cores make their tiles."""

    FILES = "files"
    """The lane of checkpoints and map files, which take long, one after the other: its workers
    wait for what :class:`LongWork` does."""


@dataclass(frozen=True)
class _Workers:
    threads: int  # for questions, one for each core
    niceness: int = 0  # that of mapping where the work is long
    gives_way_s: float | None = None
    """The seconds for which scans of a source that is about to lose some have to wait before these
    workers give way: a planner does not wait for a source that floods, a long question does.
    ``None``: they never do."""


_WORKERS = {
    Lane.QUESTIONS: _Workers(max(2, THREADS), gives_way_s=1.0),
    Lane.LONG_QUESTIONS: _Workers(max(2, THREADS), NICENESS, gives_way_s=0.0),
    Lane.ADMINISTRATION: _Workers(2),
    Lane.MESH: _Workers(1, NICENESS),
    Lane.FILES: _Workers(2),
}


def _lane_of(lane: Lane, nbytes: int) -> Lane:
    """Return the lane of a request of some bytes, for an operation of this lane."""
    is_long = lane is Lane.QUESTIONS and nbytes > _LONG_BYTES
    return Lane.LONG_QUESTIONS if is_long else lane


@dataclass(frozen=True)
class _Operation:
    answer: Callable[[Request], None]  # or it raises RefusedError
    counts: OperationCounts
    lane: Lane
    max_bytes: int


class Operations:
    """Receives the requests of one map, and has them handled: each is answered exactly once."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        settings: ServiceSettings,
        give_way: Callable[[float], None],
        origin: Callable[[], Doubles],
    ) -> None:
        """Begin; ``give_way`` returns when a query may begin, as far as other work is concerned.

        ``origin`` returns from where the map counts, [3] of its user's coordinates.
        """
        self._session = session
        self._map_name = map_name
        self._give_way = give_way
        self._origin = origin
        self._sessions = ClientSessions(session)
        self._refusals = ThreadPoolExecutor(_REFUSING_THREADS, "refusals")
        self._long_work = LongWork(NICENESS)
        self._operations: dict[str, _Operation] = {}  # by key
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._pools: list[ThreadPoolExecutor] = []
        self._queues = {lane: self._queue(lane, settings.request_queue) for lane in Lane}
        self.is_stopping = self._closed = False  # all requests are refused from then on
        self.counts: dict[str, OperationCounts] = {}  # by operation, such as "query/sdf"

    @property
    def queue_metrics(self) -> dict[str, QueueMetrics]:
        """The state of each queue, by its name."""
        return {lane.value: queue.metrics for lane, queue in self._queues.items()}

    @property
    def longest_question_s(self) -> float:
        """The seconds for which a worker has been at the same question."""
        lanes = (Lane.QUESTIONS, Lane.LONG_QUESTIONS)
        return max(self._queues[lane].longest_work_s for lane in lanes)

    def serve(
        self,
        kind: type[codec.Request[codec.ReplyT]],
        answer: Callable[[Any], codec.ReplyT],
        lane: Lane = Lane.QUESTIONS,
        max_bytes: int = _PLAIN_BYTES,
    ) -> None:
        """Answer requests of a kind from now on; ``answer`` returns the reply, or refuses.

        Requests larger than ``max_bytes`` are refused.
        """
        if lane is Lane.FILES:
            answer = partial(self._long_work.answer, answer)
        key = keys.operation_key(self._map_name, kind.operation)
        counts = self.counts[kind.operation] = OperationCounts()
        self._operations[key] = _Operation(
            lambda request: request.answer(self._answered(request, kind, answer)),
            counts,
            lane,
            max_bytes,
        )
        # This runs in the network's own threads, so it only queues requests.
        receive = zenoh.handlers.Callback(partial(self._receive, key), indirect=False)
        self._queryables.append(self._session.declare_queryable(key, receive, complete=True))

    def stop(self) -> None:
        """Refuse all waiting and new requests."""
        self.is_stopping = True
        for queue in self._queues.values():
            for request in queue.clear():
                self._refuse(request, "busy", _STOPPING)

    def close(self) -> None:
        """Do as :meth:`stop`; return once all work is answered. Closing twice does no harm."""
        if self._closed:
            return
        self._closed = True
        self.stop()
        for queryable in self._queryables:
            queryable.undeclare()
        self.stop()  # requests may have arrived meanwhile
        self._long_work.close()
        for pool in self._pools:
            pool.shutdown()
        self._refusals.shutdown()

    def _answered(
        self,
        request: Request,
        kind: type[codec.Request[codec.ReplyT]],
        answer: Callable[[Any], codec.ReplyT],
    ) -> codec.ReplyT:
        """Return the reply of a map that counts from its origin, in the client's coordinates."""
        question = request.read(kind)
        if request.local:
            return answer(question)
        while True:
            origin = self._origin()
            reply = asked_from(origin, answer, question)
            if self._origin() is origin:
                return reply  # else the map's first scan came meanwhile

    def _queue(self, lane: Lane, requests_each: int) -> RequestQueue:
        """Return a queue with workers, whose threads are started when they are needed."""
        workers = _WORKERS[lane]
        pool = ThreadPoolExecutor(
            workers.threads + MOST_SENDING, lane.value, lower_priority, (workers.niceness,)
        )
        self._pools.append(pool)
        return RequestQueue(
            lambda request: submit(pool, self._work, lane, request),
            workers=workers.threads,
            requests_each=requests_each,
            nbytes=_QUEUE_BYTES,
        )

    def _receive(self, key: str, query: zenoh.Query) -> None:
        if str(query.key_expr) != key:
            query.drop()  # unanswered: a client that means it names it
            return
        try:
            self._take(key, query)
        except MemoryError:
            _log.error("a request on %s could not be received: there is no memory", key)
        except Exception:  # the next one may be answered
            _log.exception("a request on %s could not be received", key)

    def _take(self, key: str, query: zenoh.Query) -> None:
        operation = self._operations[key]
        source = self._sessions.source(query)
        queue = self._queues[_lane_of(operation.lane, payload_size(query))]
        request = Request(query, key, operation.counts, source, queue.send)
        if request.size > operation.max_bytes:
            text = f"{request.size} bytes exceed the limit of {operation.max_bytes}: split it"
            self._refuse(request, "too_large", text)
        elif self.is_stopping:
            self._refuse(request, "busy", _STOPPING)
        else:
            for excess in queue.put(request, request.size):
                text = "too many requests wait already, most of them of this client; try later"
                self._refuse(excess, "busy", text)

    def _refuse(self, request: Request, code: str, text: str) -> None:
        """Refuse a request, in a thread for that: a client may delay the reply for seconds.

        A large one is refused at once, so that its sender waits for it and it takes no memory.
        """
        if request.size > _LARGE_BYTES:
            request.refuse(code, text)
        else:
            submit(self._refusals, request.refuse, code, text)

    def _work(self, lane: Lane, request: Request) -> None:
        try:
            request.begin()
            waited_s = _WORKERS[lane].gives_way_s
            if waited_s is not None:
                self._give_way(waited_s)
            self._check(request)
            self._operations[request.key].answer(request)
        except RefusedError as error:
            request.refuse(error.code, error.message)
        except MapperStoppedError as error:
            request.refuse("busy", f"the server is stopping: {error}")
        except MemoryError as error:
            request.refuse("busy", f"{NO_MEMORY}: {error}")
        except Exception as error:
            request.fail(error)
        finally:
            self._queues[lane].finish(request)

    def _check(self, request: Request) -> None:
        """Refuse a request whose client no longer waits."""
        if self.is_stopping:
            raise RefusedError("busy", _STOPPING)
        if self._sessions.have_left(request.owner):
            raise RefusedError("timeout", "the client has left")
        if time.monotonic() > request.deadline_s:
            raise RefusedError("timeout", "there was no time to answer: ask for less at once")
