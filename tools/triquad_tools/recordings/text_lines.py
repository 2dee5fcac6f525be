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
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            raise ToolError(f"{place}: {word!r} is not a number") from None
        if not math.isfinite(numbers[-1]):
            raise ToolError(f"{place}: {word!r} is not finite")
    return numbers


def parse_stamps(lines: Sequence[Line]) -> list[int]:
    """Return the times with which lines begin, nanoseconds: as floats they would be off by 100 ns.

    Raises:
        ToolError: a line begins with no number of seconds, or with one before that of the line
            above.
    """
    stamps = [0]
    for line in lines:
        word = line.words[0]
        try:
            stamps.append(int(Decimal(word) * 10**9))
        except (ArithmeticError, ValueError):  # those of decimal numbers among them
            raise ToolError(f"{line.place}: {word!r} is not a number of seconds") from None
        if not 0 <= stamps[-1] < 2**63:
            raise ToolError(f"{line.place}: {word} s is out of range: times are seconds, from 0 on")
        if stamps[-1] < stamps[-2]:
            raise ToolError(
                f"{line.place}: {word} s is before the line above: sort the lines by time"
            )
    return stamps[1:]


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
