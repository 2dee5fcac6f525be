"""PLY: the points of a cloud or a mesh.

Read here, not with trimesh: its import takes longer than a recording takes to be
checked, and it gives neither errors from the header alone nor the times of points.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_files.file_points import (
    FilePoints,
    check_bytes,
    check_lines,
    points_of_table,
    points_of_text,
    wanted_fields,
)

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_LINES = 1000
_MAX_LINE_BYTES = 4096


@dataclass(frozen=True)
class _Header:
    encoding: str
    points: int
    row: np.dtype[np.void]  # of one point

    @property
    def columns(self) -> list[str]:
        return list(self.row.names or ())


def check_ply(path: Path) -> int:
    """Return how many points a file announces, and has by its length.

    Raises:
        ToolError: it is no PLY file with x, y and z, or is truncated.
    """
    with path.open("rb") as file:
        header = _read_header(path, file)
        wanted_fields(path, header.columns)
        if header.encoding == "ascii":
            check_lines(path, file, header.points)
        else:
            check_bytes(path, header.points, file.tell() + header.points * header.row.itemsize)
    return header.points


def read_ply(path: Path) -> FilePoints:
    """Return the points of a file.

    Raises:
        ToolError: it cannot be read.
    """
    check_ply(path)
    with path.open("rb") as file:
        header = _read_header(path, file)
        if header.encoding == "ascii":
            return points_of_text(path, file, header.columns, header.points)
        table = np.fromfile(file, header.row, header.points)
    return points_of_table(table, wanted_fields(path, header.columns))


def _read_header(path: Path, file: BinaryIO) -> _Header:
    if file.readline(_MAX_LINE_BYTES).strip() != b"ply":
        raise ToolError(f"{path}: is no PLY file: it does not begin with 'ply'")
    encoding, points, elements = "", 0, 0
    row: dict[str, str] = {}
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(_MAX_LINE_BYTES).decode("ascii", "replace").strip()
        match line.split():
            case ["end_header"]:
                if encoding not in _ORDERS or not elements:
                    raise ToolError(f"{path}: the header of PLY names no format or no vertices")
                types = [(name, _ORDERS[encoding] + code) for name, code in row.items()]
                return _Header(encoding, points, np.dtype(types))
            case ["format", encoding, _]:
                pass
            case ["element", name, count]:
                elements += 1
                if (name == "vertex") != (elements == 1) or not count.isdigit():
                    raise _not_understood(path, line)
                points = int(count) if elements == 1 else points
            case ["property", code, name] if elements == 1 and code in _TYPES and name not in row:
                row[name] = _TYPES[code]
            case ["property", *_] if elements == 1:
                raise _not_understood(path, line)
    raise ToolError(f"{path}: the header of PLY has no end; copy the file again")


def _not_understood(path: Path, line: str) -> ToolError:
    return ToolError(
        f"{path}: {line!r} in the header of PLY is not understood: vertices come first, with one "
        "number a property; save it as a plain cloud of points"
    )
