"""Files of one cloud each: PLY, PCD, LAS and LAZ, read by the libraries of these formats, and BIN.

The ``.bin`` of KITTI has ``float32`` x, y, z and intensity of each point, and nothing else.
"""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.sensors.point_times import time_fields

_BIN_BYTES = 16  # of a point


class FilePoints(NamedTuple):
    """The content of a file of points."""

    points: Doubles  # [N, 3] metres, as the file has them: some may not be finite
    times: NDArray[Any] | None = None  # [N] when each was measured, in the driver's own unit


class _Table(NamedTuple):
    """The columns of a file by their names, and how many rows its header announces."""

    columns: Mapping[str, NDArray[Any]]
    rows: int


def read_points(path: Path) -> FilePoints:
    """Return the points of a file with a suffix of :data:`POINT_SUFFIXES`.

    Raises:
        ToolError: it is no such file, is damaged or truncated, or has no x, y and z.
    """
    try:
        columns, rows = _READERS[path.suffix.lower()](path)
    except (OSError, KeyboardInterrupt, ModuleNotFoundError):
        raise
    except BaseException as error:  # a damaged file leads the libraries anywhere, to panics too
        reason = " ".join(str(error).split())
        remedy = "write it with x, y and z, or copy it again"
        raise ToolError(f"{path}: cannot be read: {reason:.200}; {remedy}") from error
    missing = [name for name in "xyz" if name not in columns]
    if missing and rows:
        raise ToolError(
            f"{path}: has no {', '.join(missing)} for its points, only "
            f"{', '.join(columns) or 'nothing'}: write them as x, y and z"
        )
    if not rows:
        return FilePoints(np.empty((0, 3)))
    points = np.stack([np.asarray(columns[name], np.float64).ravel() for name in "xyz"], axis=1)
    if len(points) < rows:
        raise ToolError(
            f"{path}: is truncated: it holds {len(points):,} of {rows:,} points; copy it again"
        )
    time = next(iter(time_fields(columns)), None)
    return FilePoints(points, None if time is None else np.asarray(columns[time]).ravel())


def check_points(path: Path) -> int:
    """Return how many points a file holds, once it is known that they can be read.

    Raises:
        ToolError: as :func:`read_points`.
    """
    size = path.stat().st_size
    # Nothing but its size can be wrong with such a file.
    if path.suffix.lower() == ".bin" and size % _BIN_BYTES == 0:
        return size // _BIN_BYTES
    return len(read_points(path).points)


def _bin(path: Path) -> _Table:
    size = path.stat().st_size
    if size % _BIN_BYTES:
        raise ValueError(f"{size} bytes are not whole points of {_BIN_BYTES}")
    table = np.fromfile(path, "<f4").reshape(-1, 4)
    return _Table({"x": table[:, 0], "y": table[:, 1], "z": table[:, 2]}, len(table))


def _ply(path: Path) -> _Table:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    if "_ply_raw" not in loaded.metadata:  # of a file without points
        return _Table({}, 0)
    vertices = loaded.metadata["_ply_raw"]["vertex"]
    return _Table(_by_name(vertices["data"]), vertices["length"])


def _pcd(path: Path) -> _Table:
    from pypcd4.pypcd4 import PointCloud

    cloud = PointCloud.from_path(path)
    return _Table(_by_name(cloud.pc_data), cloud.metadata.points)


def _las(path: Path) -> _Table:
    import laspy

    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it says errors on standard error, too
    las = laspy.read(path)
    return _Table({"x": las.x, "y": las.y, "z": las.z}, las.header.point_count)


def _by_name(table: Any) -> Mapping[str, NDArray[Any]]:
    """Return the columns of a table, which may be a structured array."""
    return table if isinstance(table, dict) else {name: table[name] for name in table.dtype.names}


_READERS: dict[str, Callable[[Path], _Table]] = {
    ".ply": _ply,
    ".pcd": _pcd,
    ".las": _las,
    ".laz": _las,
    ".bin": _bin,
}

POINT_SUFFIXES = tuple(_READERS)
