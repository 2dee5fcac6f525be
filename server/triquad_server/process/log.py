"""The log of the server's process, on standard error: text for people, or lines of JSON."""

import faulthandler
import json
import logging
import sys
import threading
from datetime import datetime, timezone
from types import TracebackType

from triquad_format.printable import printable

_log = logging.getLogger("triquad_server")

LOG_FORMATS = TEXT, JSON = "text", "json"


class TextLines(logging.Formatter):
    """Formats time, level and message in a line; an exception's lines follow, each indented.

    Control characters are escaped: names from the network must not forge lines of the log.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, and what follows it."""
        message = printable(record.getMessage().rstrip("\n"))
        lines = [f"{self.formatTime(record)} {record.levelname} {message}"]
        lines += [f"    {printable(line)}" for line in _exception(self, record).splitlines()]
        return "\n".join(lines)


class JsonLines(logging.Formatter):
    """An object with ``time`` (RFC 3339, UTC), ``level``, ``logger``, ``message``, ``thread`` and,
    where there is one, ``exception``, in one line of ASCII."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        time = datetime.fromtimestamp(record.created, timezone.utc)
        fields = {
            "time": time.isoformat(timespec="microseconds").replace("+00:00", "Z"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage().rstrip("\n"),
            "thread": str(record.threadName),
        }
        if exception := _exception(self, record):
            fields["exception"] = exception
        return json.dumps({name: _encodable(text) for name, text in fields.items()})


def start_log(log_format: str) -> None:
    """Write the log of this process to standard error, as one of :data:`LOG_FORMATS`.

    Warnings of Python and exceptions that nothing handles become records of the log. What libraries
    in C or Rust write to standard error, and the last words of a crash, stay text.
    """
    if sys.stderr is None:  # closed by the program that started this process
        return
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if log_format == JSON else TextLines())
    logging.basicConfig(handlers=[handler], level=logging.INFO)
    for name in ("numba", "torch"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.captureWarnings(True)
    sys.excepthook = _log_exception
    threading.excepthook = _log_exception_of_thread
    sys.unraisablehook = _log_unraisable
    faulthandler.enable()  # writes the stacks of all threads where the process is aborted


def _exception(formatter: logging.Formatter, record: logging.LogRecord) -> str:
    """Return the traceback and the stack of a record; "" where it has none."""
    has_exception = record.exc_info and record.exc_info[0] is not None
    traceback = formatter.formatException(record.exc_info) if has_exception else ""  # type: ignore[arg-type]
    return "\n".join(filter(None, (traceback, record.stack_info)))


def _encodable(text: str) -> str:
    """Replace halves of surrogate pairs, which most readers of JSON refuse, by escapes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _log_exception(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    _log.critical("an exception ended the server", exc_info=(kind, error, trace))


def _log_exception_of_thread(args: threading.ExceptHookArgs) -> None:
    if args.exc_type is not SystemExit:
        name = args.thread.name if args.thread is not None else "that has ended"
        error = args.exc_value if args.exc_value is not None else args.exc_type()
        _log.error("an exception ended thread %s", name, exc_info=error)


def _log_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    what = unraisable.err_msg or "an exception was ignored in"
    _log.error("%s: %r", what, unraisable.object, exc_info=unraisable.exc_value)
