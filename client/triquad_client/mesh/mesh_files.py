"""Meshes as bytes of files: PLY and GLB, written with numpy alone.

Specifications: the PLY of Stanford; glTF 2.0 and its extension KHR_materials_unlit.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles

_PLY_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])
_PLY_MARKED_FACE = np.dtype([*_PLY_FACE.descr, ("filled", "u1")])

_FLOAT, _UINT32 = 5126, 5125  # types of the numbers of a glTF accessor
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_NOT_MOVED = np.eye(4)


def ply_bytes(vertices: Doubles, faces: NDArray[np.integer], filled: Bools | None = None) -> bytes:
    """Return a binary PLY file in double precision.

    Args:
        vertices: [V, 3] metres.
        faces: [F, 3] rows of vertices.
        filled: [F] values of the property ``filled`` of the faces; ``None``: they have none.
    """
    marked = filled is not None
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment triquad, metres\n"
        f"element vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\n"
        "property list uchar int vertex_indices\n"
        f"{'property uchar filled' + chr(10) if marked else ''}end_header\n"
    )
    rows = np.empty(len(faces), _PLY_MARKED_FACE if marked else _PLY_FACE)
    rows["count"] = 3
    rows["indices"] = faces
    if marked:
        rows["filled"] = filled
    return header.encode("ascii") + vertices.astype("<f8").tobytes() + rows.tobytes()


@dataclass(frozen=True)
class GlbMesh:
    """One mesh of a GLB file; it has one face at least."""

    name: str
    vertices: NDArray[np.floating]  # [V, 3] metres, stored in single precision
    faces: NDArray[np.integer]  # [F, 3] counter-clockwise seen from outside
    # [V, 3] linear, also beyond [0, 1]: the mesh is drawn in them as they are, without any light;
    # None: it has no colours, and the viewer lights it
    colours: NDArray[np.floating] | None = None


def glb_bytes(meshes: Sequence[GlbMesh], placed: Doubles = _NOT_MOVED) -> bytes:
    """Return a GLB file of meshes, which a matrix [4, 4] takes to where they are in the scene."""
    file = _GlbFile()
    matrix = placed.T.ravel().tolist()  # glTF has columns one after the other
    nodes = [{"mesh": file.add(mesh), "name": mesh.name, "matrix": matrix} for mesh in meshes]
    document = {
        "asset": {"version": "2.0", "generator": "triquad"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))} if nodes else {}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "nodes": nodes,
        "meshes": file.meshes,
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{"byteLength": file.size}] if file.size else [],
    }
    filled_in = {key: value for key, value in document.items() if value != []}  # none may be empty
    text = json.dumps(filled_in, separators=(",", ":")).encode()
    chunks = [(text + b" " * (-len(text) % 4), b"JSON"), (b"".join(file.arrays), b"BIN\0")]
    packed = b"".join(_CHUNK.pack(len(data), kind) + data for data, kind in chunks if data)
    return _HEADER.pack(b"glTF", 2, _HEADER.size + len(packed)) + packed


class _GlbFile:
    """The arrays of a GLB file, and what its document says of them."""

    def __init__(self) -> None:
        self.arrays: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []

    def add(self, mesh: GlbMesh) -> int:
        """Add a mesh; returns its number."""
        vertices = np.asarray(mesh.vertices, "<f4")
        low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
        attributes = {"POSITION": self._array(vertices, min=low, max=high)}
        primitive: dict[str, Any] = {"attributes": attributes}
        if mesh.colours is not None:
            attributes["COLOR_0"] = self._array(np.asarray(mesh.colours, "<f4"))
            primitive["material"] = 0
        primitive["indices"] = self._array(np.asarray(mesh.faces, "<u4").ravel())
        self.meshes.append({"name": mesh.name, "primitives": [primitive]})
        return len(self.meshes) - 1

    def _array(self, values: NDArray[Any], **limits: list[float]) -> int:
        """Add vectors [N, 3] or whole numbers [N]; returns the number of their accessor."""
        data = values.tobytes()
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data)})
        kind = (_FLOAT, "VEC3") if values.ndim == 2 else (_UINT32, "SCALAR")
        accessor = {"componentType": kind[0], "type": kind[1], "count": len(values), **limits}
        self.accessors.append({"bufferView": len(self.views) - 1, **accessor})
        self.arrays.append(data)
        self.size += len(data)
        return len(self.accessors) - 1
