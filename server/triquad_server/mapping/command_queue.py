"""Commands for the thread that owns the live map, and the results that callers wait for."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

from triquad_server.errors import MapperStoppedError
from triquad_server.mapping.mapper import Mapper

ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class Command:
    """A command to be run, and the future that its caller waits for."""

    run: Callable[[Mapper], Any]
    result: Future[Any]


class CommandQueue:
    """Queues commands in the order in which they came, until it is closed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._commands: deque[Command] = deque()
        self.ended: str | None = None  # why no more are taken

    def add(self, run: Callable[[Mapper], ResultT]) -> Future[ResultT]:
        """Add a command; what it returns, or raises, is the future's result.

        Raises:
            MapperStoppedError: no more are taken.
        """
        result: Future[ResultT] = Future()
        with self._lock:
            if self.ended is not None:
                raise MapperStoppedError(self.ended)
            self._commands.append(Command(run, result))
        return result

    def take(self) -> Command | None:
        """Remove and return the oldest command; None where there is none."""
        with self._lock:
            return self._commands.popleft() if self._commands else None

    def __bool__(self) -> bool:
        """Whether any command waits."""
        return bool(self._commands)

    def end(self, why: str) -> None:
        """Take no more commands; those that wait fail with :class:`MapperStoppedError`."""
        with self._lock:
            self.ended = why
            pending, self._commands = self._commands, deque()
        for command in pending:
            command.result.set_exception(MapperStoppedError(why))
