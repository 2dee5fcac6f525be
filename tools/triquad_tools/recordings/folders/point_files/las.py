"""LAS and LAZ, the formats of surveyors."""

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_files.file_points import FilePoints, check_bytes

_RECORD_COUNTS = {100: 54, 243: 60}
"""The place of the header's count of records or points, and the bytes of the smallest one."""
_COUNT = struct.Struct("<I")
_MAX_POINTS_PER_BYTE = 1000  # of LAZ; what is scanned takes a byte a point or more
_CHUNK_TABLE_AT = struct.Struct("<q")
_CHUNK_TABLE = struct.Struct("<II")  # version, and how many chunks


def check_las(path: Path) -> int:
    """Return how many points a file announces, and has by its length and its index.

    Raises:
        ToolError: it is no LAS or LAZ file, or is truncated.
    """
    import laspy

    with path.open("rb") as file, _one_error(path):
        _check_records(path, file)
        header: Any = laspy.open(file, closefd=False).header
        points = int(header.point_count)
        needed = int(header.offset_to_point_data)
        if header.are_points_compressed and points:
            _check_index(path, file, header)
            file.seek(0)
            # One core: several would decompress far more than the one point that is asked for.
            backend = laspy.LazBackend.Lazrs
            laspy.open(file, closefd=False, laz_backend=backend).read_points(1)
        elif not header.are_points_compressed:
            needed += points * int(header.point_format.size)
        check_bytes(path, points, needed)
    return points


def read_las(path: Path) -> FilePoints:
    """Return the points of a file.

    Raises:
        ToolError: it cannot be read.
    """
    import laspy

    check_las(path)
    with path.open("rb") as file, _one_error(path):
        return FilePoints(np.array(laspy.read(file).xyz, np.float64))


def _check_records(path: Path, file: BinaryIO) -> None:
    """Check that a file has room for its records; the library reads as many as it says."""
    start = file.read(375)  # the header of the newest version
    file.seek(0)
    size = path.stat().st_size
    newest = start[24:26] >= bytes((1, 4))
    for place, record_bytes in _RECORD_COUNTS.items():
        if len(start) < place + _COUNT.size or (place > 227 and not newest):
            break
        (records,) = _COUNT.unpack_from(start, place)
        if records * record_bytes > size:
            raise ToolError(
                f"{path}: {size:,} bytes cannot hold {records:,} records; copy it again"
            )


def _check_index(path: Path, file: BinaryIO, header: Any) -> None:
    """Check that LAZ has an index of its chunks; the library trusts any value there."""
    size = path.stat().st_size
    file.seek(header.offset_to_point_data)
    (table,) = _CHUNK_TABLE_AT.unpack(file.read(_CHUNK_TABLE_AT.size))
    if table == -1:  # of a file that was written as a stream: it stands at the end
        file.seek(size - _CHUNK_TABLE_AT.size)
        (table,) = _CHUNK_TABLE_AT.unpack(file.read(_CHUNK_TABLE_AT.size))
    if not header.offset_to_point_data < table <= size - _CHUNK_TABLE.size:
        raise ToolError(f"{path}: is truncated: the index of its chunks is missing; copy it again")
    file.seek(table)
    _, chunks = _CHUNK_TABLE.unpack(file.read(_CHUNK_TABLE.size))
    # The first point of each chunk is not compressed.
    if chunks * header.point_format.size > size or header.point_count > size * _MAX_POINTS_PER_BYTE:
        raise ToolError(
            f"{path}: {size:,} bytes cannot be {header.point_count:,} points in {chunks:,} chunks; "
            "copy it again"
        )


@contextmanager
def _one_error(path: Path) -> Iterator[None]:
    """Make a ToolError of any error of the library and its codec."""
    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it says errors on standard error, too
    try:
        yield
    except (ToolError, KeyboardInterrupt):
        raise
    except BaseException as error:  # the codec's panics are no ordinary exceptions
        raise ToolError(f"{path}: cannot be read as LAS or LAZ: {error}; copy it again") from error
