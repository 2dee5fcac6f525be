"""Commands to the thread that owns the map, and what they return."""

import queue
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

from triquad_format.errors import TriquadError

from triquad_server.errors import MapperStoppedError
from triquad_server.mapping.mapper import Mapper

ResultT = TypeVar("ResultT")


class _Command(NamedTuple):
    run: Callable[[Mapper], Any]
    result: Future[Any]
    changes: bool  # the map


class Commands:
    """Hands commands to the thread, in turn."""

    def __init__(self, came: Callable[[], object]) -> None:
        """Begin; each time that a command ``came``, this is called."""
        self._came = came
        self._queue: queue.SimpleQueue[_Command] = queue.SimpleQueue()
        self.ended: str | None = None  # why no more are carried out

    @property
    def is_empty(self) -> bool:
        """Whether no command waits."""
        return self._queue.empty()

    def carried_out(self, command: Callable[[Mapper], ResultT], *, changes: bool) -> ResultT:
        """Have a command carried out by the thread, and return its result.

        One that ``changes`` the map returns once an epoch shows what it did.

        Raises:
            MapperStoppedError: the thread has ended, or ends before it comes to the command.
            TriquadError: the command refused; any other exception of it ends the thread as well.
        """
        result: Future[ResultT] = Future()
        self._queue.put(_Command(command, result, changes))
        self._came()
        if self.ended is not None:  # it may have come after the last one that was carried out
            self.end(self.ended)
        return result.result()

    def run_next(self, mapper: Mapper, show: Callable[[], None]) -> bool:
        """Carry out the oldest command; return False if it refused.

        ``show`` is called once it has changed the map.
        """
        command = self._queue.get()
        try:
            returned = command.run(mapper)
            if command.changes:
                show()
            command.result.set_result(returned)
        except TriquadError as error:
            command.result.set_exception(error)
            return False
        except BaseException as error:
            command.result.set_exception(error)
            raise
        return True

    def end(self, why: str) -> None:
        """Take no more commands; those that wait fail with :class:`MapperStoppedError`."""
        self.ended = why
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait().result.set_exception(MapperStoppedError(why))
