"""PCD, the format of the Point Cloud Library: ascii, binary and binary_compressed."""

import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_files.file_points import (
    FilePoints,
    check_bytes,
    check_lines,
    points_of_table,
    points_of_text,
    wanted_fields,
)

if TYPE_CHECKING:
    from pypcd4.pypcd4 import MetaData

_MAX_HEADER_LINES = 100
_MAX_LINE_BYTES = 65536
_MAX_NUMBERS = 10_000  # of a point; descriptors have some hundred
_SIZES = struct.Struct("<II")  # compressed and not, before what is compressed
_MAX_GROWTH = 100  # LZF makes at most 264 bytes of 3


def check_pcd(path: Path) -> int:
    """Return how many points a file announces, and has by its length.

    Raises:
        ToolError: it is no PCD file with x, y and z, or is truncated.
    """
    with path.open("rb") as file:
        header = _read_header(path, file)
        wanted_fields(path, _columns(header))
        if header.data.value == "ascii":
            check_lines(path, file, header.points)
        elif header.points:
            check_bytes(path, header.points, file.tell() + _length(path, file, header))
    return header.points


def read_pcd(path: Path) -> FilePoints:
    """Return the points of a file.

    Raises:
        ToolError: it cannot be read.
    """
    from pypcd4.pypcd4 import PointCloud

    check_pcd(path)
    with path.open("rb") as file:
        header = _read_header(path, file)
        # The library takes ascii with just one blank between numbers.
        if header.data.value == "ascii":
            return points_of_text(path, file, _columns(header), header.points)
        file.seek(0)
        try:
            table = PointCloud.from_fileobj(file).pc_data
        except Exception as error:  # any error of the library and its codec
            raise ToolError(f"{path}: cannot be read as PCD: {error}; write it again") from error
    return points_of_table(table, wanted_fields(path, _columns(header)))


def _read_header(path: Path, file: BinaryIO) -> "MetaData":
    from pypcd4.pypcd4 import MetaData

    lines: list[str] = []
    while len(lines) < _MAX_HEADER_LINES and not (lines and lines[-1].startswith("DATA")):
        line = file.readline(_MAX_LINE_BYTES)
        if not line:
            break
        lines.append(line.decode("ascii", "replace").strip())
    try:
        header = MetaData.parse_header(lines)
        if sum(header.count) > _MAX_NUMBERS:
            raise ValueError(f"{sum(header.count):,} numbers a point")
        header.build_dtype()
    except (ValueError, KeyError, IndexError) as error:
        raise ToolError(
            f"{path}: is no PCD file, or its header is not valid (FIELDS, SIZE, TYPE, COUNT, "
            "WIDTH, HEIGHT, POINTS and DATA, one each); write it again"
        ) from error
    return header


def _columns(header: "MetaData") -> list[str]:
    """Return names of the numbers of a point; those of a field that has several are numbered."""
    return list(header.build_dtype().names or ())


def _length(path: Path, file: BinaryIO, header: "MetaData") -> int:
    """Return the bytes that follow the header, at the end of which the file's position is."""
    row_bytes = header.build_dtype().itemsize
    whole_bytes = header.points * row_bytes
    if header.data.value == "binary":
        return whole_bytes
    sizes = file.read(_SIZES.size)
    file.seek(-len(sizes), os.SEEK_CUR)
    if len(sizes) < _SIZES.size:
        return _SIZES.size
    compressed_bytes, announced_bytes = _SIZES.unpack(sizes)
    if announced_bytes != whole_bytes or whole_bytes > compressed_bytes * _MAX_GROWTH:
        raise ToolError(
            f"{path}: {compressed_bytes:,} bytes, {announced_bytes:,} uncompressed, cannot be "
            f"{header.points:,} points of {row_bytes}; write it again"
        )
    return _SIZES.size + int(compressed_bytes)
