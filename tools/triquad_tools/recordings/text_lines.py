"""Text files of numbers, line by line: errors name their place."""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import is_rotation, orthonormal, rotation_error

from triquad_tools.console.command import ToolError

NS_OF_DIGITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
"""Whole numbers with as many digits are times since 1970, from 2001 to 2286, in a unit of
nanoseconds: seconds, milliseconds, microseconds or nanoseconds."""


class Line(NamedTuple):
    """A line that is neither blank nor a comment."""

    place: str  # file and number of the line, for messages
    text: str

    @property
    def words(self) -> list[str]:
        """The words between blanks, commas or semicolons."""
        return self.text.replace(",", " ").replace(";", " ").split()

    @property
    def is_comment(self) -> bool:
        """Whether it begins with ``#``, or with ``%`` as those of ``rostopic echo -p``."""
        return self.text.startswith(("#", "%"))


def all_lines(path: Path) -> list[Line]:
    """Return the lines of a file that are not blank, without the mark of its encoding."""
    lines = enumerate(path.read_text("utf-8-sig", errors="replace").splitlines(), start=1)
    return [Line(f"{path}:{number}", line.strip()) for number, line in lines if line.strip()]


def read_lines(path: Path) -> list[Line]:
    """Return the lines of a file that are neither blank nor comments."""
    return [line for line in all_lines(path) if not line.is_comment]


def parse_number(place: str, word: str) -> float:
    """Return the number that a word is, which need not be finite; else raise a ToolError."""
    try:
        return float(word)
    except ValueError:
        raise ToolError(f"{place}: {word!r} is not a number") from None


def unit_ns(line: Line, word: str) -> int:
    """Return the nanoseconds of the unit of a time, by its size: seconds if it is small.

    Raises:
        ToolError: it is no number, or has another number of digits.
    """
    digits = len(str(parse_time(line, word, 1)))
    unit = 10**9 if digits < 10 else NS_OF_DIGITS.get(digits)
    if unit is None:
        raise ToolError(
            f"{line.place}: {word} is out of range: times are seconds, from 0 on, or whole "
            "milliseconds, microseconds or nanoseconds since 1970"
        )
    return unit


def parse_time(line: Line, word: str, unit: int) -> int:
    """Return nanoseconds, exactly: as a float they would be off by 100.

    Raises:
        ToolError: it is not a number, or out of range.
    """
    try:
        stamp = int(Decimal(word) * unit)
    except (ArithmeticError, ValueError):  # those of decimal numbers among them
        raise ToolError(f"{line.place}: {word!r} is not a number of seconds") from None
    if not 0 <= stamp < 2**63:
        raise ToolError(f"{line.place}: {word} s is out of range: times are seconds, from 0 on")
    return stamp


def parse_stamps(lines: Sequence[Line]) -> list[int]:
    """Return the times with which lines begin, nanoseconds.

    Raises:
        ToolError: a line begins with no time, or with one before that of the line above.
    """
    stamps = [0]
    unit = unit_ns(lines[0], lines[0].words[0]) if lines else 1
    for line in lines:
        word = line.words[0]
        stamps.append(parse_time(line, word, unit))
        if stamps[-1] < stamps[-2]:
            told = "is before the line above: sort the lines by time"
            raise ToolError(f"{line.place}: {word} {told}")
    return stamps[1:]


def rigid(place: str, numbers: Sequence[float] | Doubles) -> Doubles:
    """Return the pose ``[4, 4]`` of 12 or 16 numbers, row by row, its rotation made orthonormal."""
    if len(numbers) not in (12, 16):
        raise ToolError(f"{place}: {len(numbers)} numbers where a pose has 12 or 16")
    pose = np.eye(4)
    pose.reshape(-1)[: len(numbers)] = numbers
    if pose[3].tolist() != [0, 0, 0, 1]:
        raise ToolError(f"{place}: {pose[3].tolist()} where a pose ends with 0 0 0 1")
    if not (is_rotation(pose) and np.isfinite(pose).all()):
        raise ToolError(
            f"{place}: not a rotation: off orthonormal by {rotation_error(pose):.3g}, "
            f"determinant {np.linalg.det(pose[:3, :3]):.3g}"
        )
    return orthonormal(pose)
