"""Lines for people: the tools print and log everything through these functions."""

import logging
import sys
from typing import TextIO

from triquad_format.printable import printable, printable_lines


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


def start_log(name: str) -> None:
    """Log messages, each line with the ``name`` of the part that logs it."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Lines(f"%(asctime)s %(levelname)s {name}: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class _Lines(logging.Formatter):
    """Lines in which names from the network cannot look like other lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the line of a message."""
        record.message = printable(record.message)
        return super().formatMessage(record)
