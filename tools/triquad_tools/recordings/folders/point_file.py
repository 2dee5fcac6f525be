"""Files of one cloud each: PLY, PCD, LAS and LAZ, read by the libraries of these formats, and BIN.

A ``.bin`` has ``float32`` numbers and no header: in KITTI x, y, z and intensity of each point.
"""

import io
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.sensors.point_times import time_fields

KITTI_COLUMNS = ("x", "y", "z", "intensity")  # those of a .bin of which nothing else is said
_OTHER_COLUMNS = {3: "xyz", 5: "xyzir", 6: "xyzirt"}  # as data sets have them
_FILES, _SAMPLE, _ENOUGH = 4, 240_000, 1_000  # files, and numbers of each and of all, to tell them
_CLEARLY, _AT_LEAST = 1.1, 0.01  # times more than other numbers of columns explain, and how much
_HALF = 0.85  # of what twice as many columns explain: they are two points
_FARTHEST_M = 1e8  # numbers of another type, read as float32, have all sizes

_HEADER_END = re.compile(rb"^(DATA|end_header)\b[^\n]*\n", re.MULTILINE)
_HEADER_BYTES = 65_536  # at most
_COMMENTS = ("#", "comment", "obj_info")


class FilePoints(NamedTuple):
    """The content of a file of points."""

    points: Doubles  # [N, 3] metres, as the file has them: some may not be finite
    times: NDArray[Any] | None = None  # [N] when each was measured, in the driver's own unit


class _Table(NamedTuple):
    """The columns of a file by their names, and how many rows its header announces."""

    columns: Mapping[str, NDArray[Any]]
    rows: int


def check_columns(paths: Sequence[Path]) -> None:
    """Check that some ``.bin`` have the columns of KITTI.

    Columns differ in what they hold, such as heights and intensities; read with a wrong number of
    columns, all hold a mixture of everything.

    Raises:
        ToolError: they have others, or hold no such numbers.
    """
    some = [paths[len(paths) * index // _FILES] for index in range(min(_FILES, len(paths)))]
    flats = [np.fromfile(path, "<f4", _SAMPLE) for path in dict.fromkeys(some)]
    if sum(map(len, flats)) < _ENOUGH:
        return
    sizes = np.abs(np.concatenate(flats))
    sizes = sizes[(sizes != 0) & np.isfinite(sizes)]
    if not len(sizes) or np.mean(sizes > _FARTHEST_M) > _AT_LEAST:
        raise ToolError(
            f"{some[0]}: its numbers are no metres, read as float32: are they float64, or whole "
            "numbers? Write them as float32"
        )
    share = {count: _explained(flats, count) for count in (4, *_OTHER_COLUMNS)}
    best = max(_OTHER_COLUMNS, key=lambda count: share[count])
    if share[4] < max(_AT_LEAST, _CLEARLY * share[best]):
        best = 3 if best == 6 and share[3] > _HALF * share[6] else best
        raise ToolError(
            f"{some[0]}: does not look like points of 4 numbers, x y z intensity as KITTI has "
            f"them, but rather of {best}: say what they are, such as --columns "
            f"{_OTHER_COLUMNS[best]}"
        )


def _explained(flats: Sequence[NDArray[np.float32]], count: int) -> float:
    """Return which share of the variance of numbers is between their columns."""
    tables = [flat[: len(flat) // count * count].reshape(-1, count) for flat in flats]
    values = np.arcsinh(np.nan_to_num(np.concatenate(tables), posinf=0.0, neginf=0.0))
    both = (values, np.abs(values))
    return max(float(each.mean(axis=0).var() / max(each.var(), 1e-12)) for each in both)


def read_points(path: Path, columns: Sequence[str] = KITTI_COLUMNS) -> FilePoints:
    """Return the points of a file with a suffix of :data:`POINT_SUFFIXES`.

    Args:
        path: of the file.
        columns: the names of those of a ``.bin``.

    Raises:
        ToolError: it is no such file, is damaged or truncated, or has no x, y and z.
    """
    try:
        is_bin = path.suffix.lower() == ".bin"
        table = _bin(path, columns) if is_bin else _READERS[path.suffix.lower()](path)
    except (OSError, KeyboardInterrupt, ModuleNotFoundError):
        raise
    except BaseException as error:  # a damaged file leads the libraries anywhere, to panics too
        reason = " ".join(str(error).split())
        remedy = "write it with x, y and z, or copy it again"
        raise ToolError(f"{path}: cannot be read: {reason:.200}; {remedy}") from error
    found, rows = table
    missing = [name for name in "xyz" if name not in found]
    if missing and rows:
        raise ToolError(
            f"{path}: has no {', '.join(missing)} for its points, only "
            f"{', '.join(found) or 'nothing'}: write them as x, y and z"
        )
    if not rows:
        return FilePoints(np.empty((0, 3)))
    points = np.stack([np.asarray(found[name], np.float64).ravel() for name in "xyz"], axis=1)
    if len(points) < rows:
        raise ToolError(
            f"{path}: is truncated: it holds {len(points):,} of {rows:,} points; copy it again"
        )
    time = next(iter(time_fields(found)), None)
    return FilePoints(points, None if time is None else np.asarray(found[time]).ravel())


def check_points(path: Path, columns: Sequence[str] = KITTI_COLUMNS) -> int:
    """Return how many points a file holds, once it is known that they can be read.

    Raises:
        ToolError: as :func:`read_points`.
    """
    size = path.stat().st_size
    # Nothing but its size can be wrong with such a file.
    if path.suffix.lower() == ".bin" and size % (4 * len(columns)) == 0:
        return size // (4 * len(columns))
    return len(read_points(path, columns).points)


def _bin(path: Path, columns: Sequence[str]) -> _Table:
    size, width = path.stat().st_size, 4 * len(columns)
    if size % width:
        raise ValueError(
            f"{size} bytes are not whole points of {width} ({' '.join(columns)}); --columns says "
            "which others"
        )
    table = np.fromfile(path, "<f4").reshape(-1, len(columns))
    return _Table(dict(zip(columns, table.T, strict=True)), len(table))


def read_header(path: Path) -> list[list[str]]:
    """Return the words of each line in the header of a PLY or PCD, without its comments.

    Raises:
        ValueError: it has none.
    """
    with path.open("rb") as file:
        return _parse_header(file.read(_HEADER_BYTES))[0]


def _parse_header(content: bytes) -> tuple[list[list[str]], int]:
    """Return a header as :func:`read_header`, and how many bytes it has."""
    end = _HEADER_END.search(content, 0, _HEADER_BYTES)
    if end is None:
        raise ValueError("it does not begin with the header of such a file")
    lines = map(str.split, content[: end.end()].decode(errors="replace").splitlines())
    return [line for line in lines if line and line[0] not in _COMMENTS], end.end()


def _mended(path: Path) -> io.BufferedReader:
    """Return the content of a PLY or PCD as the libraries want it: x y z, no fields of COUNT 0."""
    content = path.read_bytes()
    header, size = _parse_header(content)
    fields = next((len(line) - 1 for line in header if line[0] == "FIELDS"), 0)
    if fields and not any(line[0] == "COUNT" for line in header):
        header.insert(0, ["COUNT", *["1"] * fields])
    counts = next((line[1:] for line in header if line[0] == "COUNT"), [])
    for line in header:
        if line[0] in ("FIELDS", "SIZE", "TYPE", "COUNT"):
            line[1:] = [word for word, n in zip(line[1:], counts, strict=True) if n != "0"]
        if line[0] in ("FIELDS", "property"):
            line[1:] = [word.lower() if word in ("X", "Y", "Z") else word for word in line[1:]]
    lines = "".join(" ".join(line) + "\n" for line in header)
    return io.BufferedReader(io.BytesIO(lines.encode() + content[size:]))


def _ply(path: Path) -> _Table:
    import trimesh

    loaded: Any = trimesh.load(_mended(path), file_type="ply", process=False)
    if "_ply_raw" not in loaded.metadata:  # of a file without points
        return _Table({}, 0)
    vertices = loaded.metadata["_ply_raw"]["vertex"]
    return _Table(_by_name(vertices["data"]), vertices["length"])


def _pcd(path: Path) -> _Table:
    from pypcd4.pypcd4 import PointCloud

    cloud = PointCloud.from_fileobj(_mended(path))
    return _Table(_by_name(cloud.pc_data), cloud.metadata.points)


def _las(path: Path) -> _Table:
    import laspy

    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it says errors on standard error, too
    las = laspy.read(path)
    return _Table({"x": las.x, "y": las.y, "z": las.z}, las.header.point_count)


def _by_name(table: Any) -> Mapping[str, NDArray[Any]]:
    return table if isinstance(table, dict) else {name: table[name] for name in table.dtype.names}


_READERS = {".ply": _ply, ".pcd": _pcd, ".las": _las, ".laz": _las}

POINT_SUFFIXES = (*_READERS, ".bin")
