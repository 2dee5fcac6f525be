"""Files of points in every form of each format, written."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]

PLY_NAMES = {"f4": "float", "f8": "double", "u4": "uint", "i2": "short", "u1": "uchar"}
PLY_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
PCD_FORMATS = ("ascii", "binary", "binary_compressed")


def columns(points: NDArray[Any], **others: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The coordinates of points [N, 3], and what else each point has."""
    return {**dict(zip("xyz", np.asarray(points).T, strict=True)), **others}


def write_ply(path: Path, values: Columns, form: str = "binary_little_endian") -> Path:
    order = ">" if form == "binary_big_endian" else "<"
    count = len(values["x"]) if "x" in values else len(next(iter(values.values())))
    header = ["ply", f"format {form} 1.0", "comment made by hand", f"element vertex {count}"]
    header += [f"property {PLY_NAMES[v.dtype.str[1:]]} {name}" for name, v in values.items()]
    header += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    if form == "ascii":
        rows = zip(*values.values(), strict=True)
        lines = (" ".join(repr(number.item()) for number in row) for row in rows)
        body = "".join(f"{line}\n" for line in lines).encode()
    else:
        table = np.zeros(count, [(name, order + v.dtype.str[1:]) for name, v in values.items()])
        for name, value in values.items():
            table[name] = value
        body = table.tobytes()
    path.write_bytes("\n".join(header).encode() + b"\n" + body)
    return path


def write_pcd(path: Path, values: Columns, form: str = "binary") -> Path:
    from pypcd4 import Encoding, PointCloud

    arrays = list(values.values())
    cloud = PointCloud.from_points(arrays, tuple(values), tuple(array.dtype for array in arrays))
    cloud.save(path, encoding=Encoding(form))
    return path


def write_las(path: Path, points: NDArray[Any], point_format: int = 3) -> Path:
    """``path`` says by its suffix whether it is compressed. Coordinates are whole millimetres."""
    import laspy

    header = laspy.LasHeader(point_format=point_format)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(points, np.float64).reshape(-1, 3).T
    las.write(str(path))
    return path
