"""The log of the server's process: where its lines go, and what else becomes a line of it."""

import faulthandler
import logging
import os
import subprocess
import sys
import threading
from types import TracebackType
from typing import IO

from triquad_server.process import log_lines
from triquad_server.process.log_lines import JsonLines, TextLines

_log = logging.getLogger("triquad_server")

LOG_FORMATS = TEXT, JSON = "text", "json"


def start_log(log_format: str) -> None:
    """Have the log of this process on standard error, as one of :data:`LOG_FORMATS`.

    Warnings of Python and exceptions that nobody handles are told there, too. In JSON nothing else
    comes there any more: what libraries write past the log becomes lines of it, whose logger is
    ``stderr``. That is left to a process of its own, which has the last words of this one, too.
    """
    if sys.stderr is None:  # it was closed by whoever started this process
        return
    handler = _json_handler() if log_format == JSON else _handler(sys.stderr, TextLines())
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    for name in ("numba", "torch"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.captureWarnings(True)
    sys.excepthook = _tell_exception
    threading.excepthook = _tell_exception_of_thread
    sys.unraisablehook = _tell_unraisable
    faulthandler.enable()  # where it crashes, or its service manager gives it up


def _handler(stream: IO[str], lines: logging.Formatter) -> logging.Handler:
    handler = logging.StreamHandler(stream)
    handler.setFormatter(lines)
    return handler


def _json_handler() -> logging.Handler:
    """A handler that has standard error for itself."""
    stderr = sys.stderr.fileno()
    own = os.fdopen(os.dup(stderr), "w", encoding="ascii", buffering=1)
    relay = subprocess.Popen(
        [sys.executable, "-I", "-S", log_lines.__file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is not for it
    )
    assert relay.stdin is not None
    os.dup2(relay.stdin.fileno(), stderr)
    relay.stdin.close()  # what is left of it is standard error, which ends with this process
    relay.returncode = 0  # nobody waits for it
    return _handler(own, JsonLines())


def _tell_exception(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    _log.critical("an exception ended the server", exc_info=(kind, error, trace))


def _tell_exception_of_thread(args: threading.ExceptHookArgs) -> None:
    if args.exc_type is SystemExit:
        return
    error = args.exc_value if args.exc_value is not None else args.exc_type()
    name = args.thread.name if args.thread is not None else "that is gone"
    _log.error("an exception ended thread %s", name, exc_info=error)


def _tell_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    what = unraisable.err_msg or "an exception was ignored in"
    _log.error("%s: %r", what, unraisable.object, exc_info=unraisable.exc_value)
