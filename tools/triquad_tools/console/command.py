"""What commands print and how they end: a status, and one line for what went wrong."""

import argparse
import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TextIO

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    InvalidInputError,
    NoCompiledCodeError,
    TriquadError,
)
from triquad_format.printable import printable_lines

INTERRUPTED = 130  # the exit status of shells: 128 and the number of SIGINT
OK, FAILED, BAD_INPUT = 0, 1, 2
NOBODY_READS = 141  # the status of shells: 128 and the number of SIGPIPE
_kept: list[KeyboardInterrupt] = []
"""The interrupts, with their frames: what a compiler has half done may not be cleaned up."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise ``KeyboardInterrupt``, and the second one end the process.

    Imports, finalisers and callbacks of the compiler may swallow the first one, or fail for a
    reason of their own: whatever fails after it was interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed = threading.Event()

    def interrupt(*_: object) -> None:
        if pressed.is_set():
            os._exit(INTERRUPTED)
        pressed.set()
        raise KeyboardInterrupt

    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    for each, handler in handlers.items():
        if handler is not signal.SIG_IGN:  # as for what a shell runs in the background
            signal.signal(each, interrupt)
    try:
        yield
    except Exception as error:
        if pressed.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)


def print_line(text: str = "") -> None:
    """Print to standard output; what would steer a terminal is shown as what it is."""
    _write(sys.stdout, text)


def print_remark(text: str) -> None:
    """Print to standard error, as :func:`print_line`."""
    _write(sys.stderr, text)


def _write(stream: TextIO, text: str) -> None:
    line = printable_lines(text) + "\n"
    encoding = stream.encoding or "utf-8"
    # Where the terminal does not know a letter, an escape is better than no line.
    stream.write(line.encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()


class ToolError(TriquadError):
    """An error of the tools, or of their use: it names the file, the place and the value.

    Any function of the tools may raise it, as the errors of files, formats and servers, and says so
    where that is what its caller needs to know: :func:`run` ends the command with its text.
    """


_OF_INPUT = ToolError, FormatError, NoCompiledCodeError, InvalidInputError


def run(command: str, work: Callable[[], int], *, interrupted: str = "interrupted") -> int:
    """Return the exit status of ``work``; what it raises becomes a status and one line.

    The same error has the same status in all commands: ``BAD_INPUT`` where usage or input is to
    blame, ``FAILED`` where a map file is damaged, or a server or a result fails.

    Args:
        command: its name, with which the line begins.
        work: all that the command does; returns its exit status.
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
    except OSError as error:
        return complain(command, _in_words(error), BAD_INPUT)
    except TriquadError as error:
        is_damage = isinstance(error, DamagedMapFileError)
        blames_input = isinstance(error, _OF_INPUT) and not is_damage
        return complain(command, error, BAD_INPUT if blames_input else FAILED)
    except KeyboardInterrupt as interrupt:
        _kept.append(interrupt)
        return complain(command, interrupted, INTERRUPTED)


def run_work(
    module: str,
    parser: Callable[[], argparse.ArgumentParser],
    argv: Sequence[str] | None = None,
    *,
    intermixed: bool = False,
    interrupted: str = "interrupted",
) -> int:
    """Return the exit status of a command with arguments, those of the process by default.

    Its work, as of :func:`run`, is the function ``work`` of a module of ``triquad_tools.work``. It
    is imported once the arguments are right: nobody waits a second for it who asks for help. With
    ``intermixed``, options may stand between names.
    """
    made, arguments = parser(), sys.argv[1:] if argv is None else list(argv)
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what could come next
        import argcomplete

        argcomplete.autocomplete(made)
    options = (made.parse_intermixed_args if intermixed else made.parse_args)(arguments)
    options.arguments = arguments
    work = importlib.import_module(f"triquad_tools.work.{module}").work
    return run(made.prog, partial(work, options), interrupted=interrupted)


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
