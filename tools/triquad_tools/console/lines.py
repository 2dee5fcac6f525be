"""Lines for people: the tools print everything through these functions."""

import sys
from typing import TextIO

from triquad_format.printable import printable_lines


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
