"""Text files of numbers, line by line: errors name their place."""

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import is_rotation, orthonormal, rotation_error

from triquad_tools.console.command import ToolError


class Line(NamedTuple):
    """A line that is neither blank nor a comment."""

    place: str  # file and number of the line, for messages
    text: str

    @property
    def words(self) -> list[str]:
        """The words between blanks or commas."""
        return self.text.replace(",", " ").split()


def read_lines(path: Path) -> list[Line]:
    """Return the lines of a file that are neither blank nor comments, which begin with ``#``."""
    lines = path.read_text(errors="replace").splitlines()
    return [
        Line(f"{path}:{number}", line.strip())
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def parse_numbers(place: str, words: Sequence[str]) -> list[float]:
    """Return the finite numbers that the words are.

    Raises:
        ToolError: a word is none.
    """
    return [_parse_number(place, word) for word in words]


def _parse_number(place: str, word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        raise ToolError(f"{place}: {word!r} is not a number") from None
    if not math.isfinite(number):
        raise ToolError(f"{place}: {word!r} is not finite")
    return number


def parse_stamp(place: str, word: str, earliest_ns: int) -> int:
    """Convert decimal seconds to nanoseconds: a float of seconds since 1970 is off by 100 ns.

    Raises:
        ToolError: the word is no number of seconds, or before ``earliest_ns``, the time of the
            line above.
    """
    try:
        stamp_ns = int(Decimal(word) * 10**9)
    except (ArithmeticError, ValueError):  # those of decimal numbers among them
        raise ToolError(f"{place}: {word!r} is not a number of seconds") from None
    if not 0 <= stamp_ns < 2**63:
        raise ToolError(f"{place}: {word} s is out of range: times are seconds, from 0 on")
    if stamp_ns < earliest_ns:
        raise ToolError(f"{place}: {word} s is before the line above: sort the lines by time")
    return stamp_ns


def parse_rigid(place: str, words: Sequence[str]) -> Doubles:
    """Return the pose ``[4, 4]`` of 12 numbers, row-major 3 x 4, its rotation made orthonormal.

    Raises:
        ToolError: they are no rotation and translation.
    """
    if len(words) != 12:
        raise ToolError(f"{place}: {len(words)} numbers where a pose has 12")
    pose = np.eye(4)
    pose[:3] = np.reshape(parse_numbers(place, words), (3, 4))
    if not is_rotation(pose):
        raise ToolError(
            f"{place}: not a rotation: off orthonormal by {rotation_error(pose):.3g}, "
            f"determinant {np.linalg.det(pose[:3, :3]):.3g}"
        )
    return orthonormal(pose)
