"""Triangles as a PLY file, binary little endian."""

import numpy as np
from numpy.typing import NDArray

_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])


def ply_bytes(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> bytes:
    """A PLY file of ``vertices`` [V, 3], kept in double precision, and ``faces`` [F, 3]."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment triquad, metres\n"
        f"element vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), _FACE)
    rows["count"] = 3
    rows["indices"] = faces
    return header.encode("ascii") + vertices.astype("<f8").tobytes() + rows.tobytes()
