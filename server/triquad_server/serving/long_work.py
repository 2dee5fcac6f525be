"""Work that takes seconds, and minutes on a busy machine, such as writing a checkpoint.

A client that waited for its end could not tell it from a server that is stuck. So work goes on in a
thread of its own, and a client that asks is told after a moment that it does.
"""

import dataclasses
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as WaitedTooLongError  # Python 3.10 has its own
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, TypeVar

from triquad_format.errors import RefusedError
from triquad_map.compiled.team import lower_priority

_TOLD_AFTER_S = 0.2  # that work is under way; less than any client waits for a reply
_MOST_PENDING = 64
_MOST_KEPT = 64  # results that were not fetched: their clients have left


class Ticketed(Protocol):
    """A request for work that takes long."""

    @property
    def ticket(self) -> int:
        """What tells the work from other work of its kind; 0: it is asked for once."""
        ...


RequestT = TypeVar("RequestT", bound=Ticketed)
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class _Task:
    result: Future[object]
    begun_s: float = field(default_factory=time.monotonic)


class LongWork:
    """Does one thing after the other."""

    def __init__(self, niceness: int) -> None:
        """Make the thread, of that ``niceness``, once it is needed."""
        self._thread = ThreadPoolExecutor(1, "long-work", lower_priority, (niceness,))
        self._lock = threading.Lock()
        self._tasks: dict[tuple[type, int], _Task] = {}  # by kind and ticket, the oldest first

    def close(self) -> None:
        """Finish what has begun; what has not is refused."""
        self._thread.shutdown(cancel_futures=True)

    def answer(self, work: Callable[[RequestT], ResultT], request: RequestT) -> ResultT:
        """Return what ``work`` returns for the request, once it is done.

        Raises:
            RefusedError: ``under_way``: it is not; ``busy``: it will not be done. And as ``work``.
        """
        with self._lock:
            task = self._tasks.get((type(request), request.ticket)) or self._waiting(request)
            task = task or self._begin(work, request)
            if request.ticket:
                self._tasks[type(request), request.ticket] = task
        try:
            result = task.result.result(_TOLD_AFTER_S if request.ticket else None)
        except WaitedTooLongError:
            if task.result.done():  # the work itself had no time left
                raise
            waited_s = time.monotonic() - task.begun_s
            raise RefusedError(
                "under_way", f"the server has been at it for {waited_s:.0f} s"
            ) from None
        except CancelledError:
            raise RefusedError("busy", "the server is stopping") from None
        return result  # type: ignore[return-value]

    def _waiting(self, request: Ticketed) -> _Task | None:
        """Return work that has not begun, and that answers the request as well.

        That is a request that says nothing but its ticket, such as to write a checkpoint: else a
        client that gives up and asks again, time after time, would keep all others waiting.
        """
        if len(dataclasses.fields(request)) > 1:  # type: ignore[arg-type]
            return None
        for (kind, _), task in self._tasks.items():
            if kind is type(request) and not (task.result.running() or task.result.done()):
                return task
        return None

    def _begin(self, work: Callable[[RequestT], ResultT], request: RequestT) -> _Task:
        pending = len({task for task in self._tasks.values() if not task.result.done()})
        if pending >= _MOST_PENDING:
            raise RefusedError("busy", f"{pending} tasks wait already; try later")
        try:
            task = _Task(self._thread.submit(partial(work, request)))
        except RuntimeError as error:  # it has been shut down
            raise RefusedError("busy", "the server is stopping") from error
        done = [key for key, task in self._tasks.items() if task.result.done()]
        for key in done[:-_MOST_KEPT]:
            del self._tasks[key]
        return task
