"""How every command ends: with an exit status, and one line for what went wrong."""

import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from triquad_format.errors import FormatError, TriquadError

OK, FAILED, BAD_INPUT = 0, 1, 2
INTERRUPTED = 130
"""As shells have it: 128 and the number of SIGINT."""


class ToolError(TriquadError):
    """What the tools refuse, or what failed in them: names the file, the place and the value."""


def run(
    command: str,
    work: Callable[[], int],
    *,
    failures: tuple[type[Exception], ...] = (),
    interrupted: str = "interrupted",
) -> int:
    """The exit status of ``work``; what it raises becomes a status and one line.

    Args:
        command: its name, with which the line begins.
        work: all that the command does; returns its exit status.
        failures: errors that say that something failed; others blame the usage or the input.
        interrupted: what the line says after Ctrl-C.
    """
    try:
        return work()
    except failures as error:
        return complain(command, error, FAILED)
    except (ToolError, FormatError, OSError) as error:
        return complain(command, error, BAD_INPUT)
    except TriquadError as error:
        # What the client refuses to send is a ValueError, too; all else is the server's failure.
        return complain(command, error, BAD_INPUT if isinstance(error, ValueError) else FAILED)
    except KeyboardInterrupt:
        return complain(command, interrupted, INTERRUPTED)


def complain(command: str, message: object, status: int) -> int:
    """Print a line on standard error; returns ``status``."""
    print(f"{command}: {message}", file=sys.stderr, flush=True)
    return status


def refuse(problems: Mapping[str, object]) -> None:
    """Raise the first problem that is there as a :class:`ToolError`."""
    for problem, there in problems.items():
        if there:
            raise ToolError(problem)


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, as SIGINT does: then servers are stopped, too."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
