"""The end of every command: an exit status, and one line for what went wrong."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from triquad_format.errors import FormatError, NoCompiledCodeError, TriquadError

from triquad_tools.console.lines import print_remark

INTERRUPTED = 130
"""The exit status of shells: 128 and the number of SIGINT."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise ``KeyboardInterrupt``, and end the process where it is pressed again.

    Imports, finalisers and callbacks of the compiler may swallow the first one, or fail for a
    reason of their own: whatever fails after it was interrupted.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    pressed = threading.Event()

    def interrupt(*_: object) -> None:
        if pressed.is_set():
            os._exit(INTERRUPTED)
        pressed.set()
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except Exception as error:
        if pressed.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, as SIGINT does: then servers are stopped, too."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


OK, FAILED, BAD_INPUT = 0, 1, 2
NOBODY_READS = 141
"""The status of shells: 128 and the number of SIGPIPE."""

_kept: list[KeyboardInterrupt] = []
"""The interrupts, with their frames: what a compiler has half done may not be cleaned up."""


class ToolError(TriquadError):
    """An error of the tools, or of their use: it names the file, the place and the value."""


def run(
    command: str,
    work: Callable[[], int],
    *,
    failures: tuple[type[Exception], ...] = (),
    interrupted: str = "interrupted",
) -> int:
    """Return the exit status of ``work``; what it raises becomes a status and one line.

    Args:
        command: its name, with which the line begins.
        work: all that the command does; returns its exit status.
        failures: errors that say that something failed; others blame the usage or the input.
        interrupted: what the line says after Ctrl-C.
    """
    try:
        with interruptible():
            status = work()
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # As in `... | head`. Python would complain when it flushes the rest at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    except failures as error:
        return complain(command, error, FAILED)
    except OSError as error:
        return complain(command, _in_words(error), BAD_INPUT)
    except (ToolError, FormatError, NoCompiledCodeError) as error:
        return complain(command, error, BAD_INPUT)
    except TriquadError as error:
        # What the client refuses to send is a ValueError, too; all else is the server's failure.
        return complain(command, error, BAD_INPUT if isinstance(error, ValueError) else FAILED)
    except KeyboardInterrupt as interrupt:
        _kept.append(interrupt)
        return complain(command, interrupted, INTERRUPTED)


def _in_words(error: OSError) -> str:
    """Return a system error's text without its number, such as ``map.triquad: no such file``."""
    if error.filename is None or error.strerror is None:
        return str(error)
    return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}"


def complain(command: str, message: object, status: int) -> int:
    """Print a line on standard error, or several of which it begins one; return ``status``."""
    # Indented: a name with a line break in it cannot look like another message.
    print_remark(f"{command}: {message}".replace("\n", "\n  "))
    return status


def refuse(problems: Mapping[str, object]) -> None:
    """Raise the first problem that is there as a :class:`ToolError`."""
    for problem, there in problems.items():
        if there:
            raise ToolError(problem)
