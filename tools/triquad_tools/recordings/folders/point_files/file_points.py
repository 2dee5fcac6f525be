"""The points of a file, whichever format it has."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.sensors.point_times import TIME_FIELDS


class FilePoints(NamedTuple):
    """The content of a file of points."""

    points: Doubles  # [N, 3] metres, as the file has them: some may not be finite
    times: NDArray[Any] | None = None  # [N] when each was measured, in the driver's own unit


def wanted_fields(path: Path, names: Sequence[str]) -> list[str]:
    """Return a file's fields x, y, z, and that of times if it has one.

    Raises:
        ToolError: there is no x, y or z.
    """
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise ToolError(
            f"{path}: has no {', '.join(missing)} for its points, only "
            f"{', '.join(names) or 'nothing'}: write them as x, y and z"
        )
    return [*"xyz", *[name for name in TIME_FIELDS if name in names][:1]]


def points_of_table(table: NDArray[Any], fields: Sequence[str]) -> FilePoints:
    """Return the points of a table with named columns, of which ``fields`` are wanted."""
    points = np.stack([table[name] for name in "xyz"], axis=1).astype(np.float64)
    return FilePoints(points, table[fields[3]] if len(fields) > 3 else None)


def points_of_text(path: Path, file: BinaryIO, columns: Sequence[str], count: int) -> FilePoints:
    """Return the points of the next ``count`` lines of numbers in a file.

    Raises:
        ToolError: they are no numbers.
    """
    fields = wanted_fields(path, columns)
    used = [columns.index(name) for name in fields]
    if count == 0:
        return FilePoints(np.empty((0, 3)))
    lines = islice((line for line in file if line.strip()), count)
    try:
        values = np.loadtxt(lines, usecols=used, ndmin=2)
    except ValueError as error:
        raise ToolError(f"{path}: the points cannot be read: {error}") from error
    return FilePoints(values[:, :3], values[:, 3] if len(fields) > 3 else None)


def check_lines(path: Path, file: BinaryIO, points: int) -> None:
    """Check that a file holds a line for each of ``points`` from its position on.

    Raises:
        ToolError: it is truncated.
    """
    lines = sum(1 for line in file if line.strip())
    if lines < points:
        raise _truncated(path, points, f"{lines:,} lines")


def check_bytes(path: Path, points: int, needed: int) -> None:
    """Check that a file has the bytes that ``points`` need.

    Raises:
        ToolError: it is truncated.
    """
    size = path.stat().st_size
    if size < needed:
        raise _truncated(path, points, f"{size:,} of {needed:,} bytes")


def _truncated(path: Path, points: int, detail: str) -> ToolError:
    """Return the error of a file that ends before the last of the points that it announces."""
    return ToolError(f"{path}: is truncated: {detail} for {points:,} points; copy it again")
