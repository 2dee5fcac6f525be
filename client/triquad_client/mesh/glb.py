"""Triangles as a binary glTF 2.0 file."""

import json
import struct

import numpy as np
from numpy.typing import NDArray

_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def glb_bytes(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> bytes:
    """A GLB file of ``vertices`` [V, 3] (map frame, z upwards) and ``faces`` [F, 3].

    Positions are single precision, relative to the middle of the mesh; the node's matrix puts
    them back, and turns z upwards into glTF's y upwards.
    """
    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "triquad"},
        "scene": 0,
        "scenes": [{"nodes": []}],
    }
    binary = b""
    if len(faces):
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        local = (vertices - middle).astype("<f4")
        binary = local.tobytes() + faces.astype("<u4").tobytes()
        document |= _mesh_nodes(local, faces, middle)
    return _container(json.dumps(document).encode(), binary)


def _mesh_nodes(
    local: NDArray[np.float32],
    faces: NDArray[np.int32],
    middle: NDArray[np.float64],
) -> dict[str, object]:
    x, y, z = middle.tolist()
    views = [
        {"buffer": 0, "byteLength": local.nbytes, "target": _ARRAY_BUFFER},
        {
            "buffer": 0,
            "byteOffset": local.nbytes,
            "byteLength": faces.size * 4,
            "target": _ELEMENT_ARRAY_BUFFER,
        },
    ]
    position = {
        "bufferView": 0,
        "componentType": _FLOAT,
        "count": len(local),
        "type": "VEC3",
        "min": local.min(axis=0).tolist(),
        "max": local.max(axis=0).tolist(),
    }
    index = {"bufferView": 1, "componentType": _UINT32, "count": faces.size, "type": "SCALAR"}
    columns = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]
    return {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": columns}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [position, index],
        "bufferViews": views,
        "buffers": [{"byteLength": local.nbytes + faces.size * 4}],
    }


def _container(document: bytes, binary: bytes) -> bytes:
    """Header, JSON chunk and, where there are bytes, BIN chunk; each a multiple of 4 long."""
    document += b" " * (-len(document) % 4)
    chunks = struct.pack("<II", len(document), 0x4E4F534A) + document
    if binary:
        chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
