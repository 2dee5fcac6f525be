"""Records of the log as lines: as text for people, or as JSON for what collects logs.

Run as a program, it turns each line of its standard input into such a JSON line on its standard
error. Needs the standard library alone, so that it starts at once.
"""

import json
import logging
import signal
import sys
import traceback
from datetime import datetime, timezone
from types import FrameType

_LINE_BYTES = 3_000
"""What is longer and not ours becomes several lines. A pipe takes up to 4096 bytes at once: so no
line of the server's own comes in between."""

_INDENT = "    "


def one_line(text: str) -> str:
    """A text without line breaks, escape sequences of terminals or other control characters.

    They are shown as Python writes them: names from the network must not forge lines of the log.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class TextLines(logging.Formatter):
    """Time, level and message; the lines of an exception follow, each indented."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """The line, and what follows it."""
        record.message = one_line(_message(record))
        record.asctime = self.formatTime(record)
        lines = [self.formatMessage(record)]
        lines += [_INDENT + one_line(line) for line in _exception(record).splitlines()]
        return "\n".join(lines)


class JsonLines(logging.Formatter):
    """An object with ``time`` (RFC 3339, UTC), ``level``, ``logger``, ``message``, ``thread`` and,
    where there is one, ``exception``, in one line of ASCII."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        fields: dict[str, str | None] = {
            "time": _rfc3339(record.created),
            "level": record.levelname,
            "logger": record.name,
            "message": _message(record),
            "thread": record.threadName,
        }
        if exception := _exception(record):
            fields["exception"] = exception
        return json.dumps({key: _encodable(text) for key, text in fields.items()})


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage().rstrip("\n")
    except Exception as error:  # whatever stands in the log, it must be heard of
        return f"{record.msg!r} with {record.args!r} is no message: {error}"


def _exception(record: logging.LogRecord) -> str:
    """The traceback and the stack that belong to a record; "" where it has none."""
    parts = []
    if record.exc_info and record.exc_info[0] is not None:
        parts.append("".join(traceback.format_exception(*record.exc_info)))
    if record.stack_info:
        parts.append(record.stack_info)
    return "\n".join(parts).rstrip("\n")


def _rfc3339(seconds: float) -> str:
    time = datetime.fromtimestamp(seconds, timezone.utc)
    return time.isoformat(timespec="microseconds").replace("+00:00", "Z")


def _encodable(text: str | None) -> str | None:
    """Halves of surrogate pairs are no text for most readers of JSON."""
    return None if text is None else text.encode("utf-8", "backslashreplace").decode("utf-8")


def _relay() -> None:
    """Each line of standard input as a JSON line, until the one who writes there has ended."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGABRT):
        signal.signal(number, _go_on)  # sent to the server's whole group; its last lines count
    lines = JsonLines()
    while line := sys.stdin.buffer.readline(_LINE_BYTES):
        text = line.decode("utf-8", "backslashreplace").rstrip("\r\n")
        record = logging.LogRecord("stderr", logging.WARNING, "", 0, text, None, None)
        record.threadName = None  # nobody knows
        sys.stderr.write(lines.format(record) + "\n")


def _go_on(_number: int, _frame: FrameType | None) -> None:
    pass


if __name__ == "__main__":
    _relay()
