"""A mesh with colours as GLB, drawn as it is coloured: without lights, which cost most of all.

Specification: glTF 2.0, and KHR_materials_unlit.
"""

import json
import struct
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Ints

from triquad_tools.viewer.page.tone_mapping import untoned

_FLOAT, _UINT32 = 5126, 5125
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")


class Triangles(NamedTuple):
    """A mesh."""

    vertices: Floats  # [V, 3] metres, relative to where it is drawn
    faces: Ints  # [F, 3] rows of vertices, counter-clockwise seen from outside or free space


def unlit_glb(triangles: Triangles, colours: Doubles, opacity: float = 1.0) -> bytes:
    """A GLB file.

    Args:
        triangles: the mesh, of one vertex at least.
        colours: [V, 3] of the vertices, linear in [0, 1], as the screen shall show them.
        opacity: below 1, what is behind shines through, and faces are seen from both sides.
    """
    vertices, faces = triangles
    arrays = (
        np.ascontiguousarray(vertices, "<f4").tobytes(),
        untoned(np.clip(colours, 0.0, 1.0)).astype("<f4").tobytes(),
        np.ascontiguousarray(faces, "<u4").tobytes(),
    )
    starts = [0, len(arrays[0]), len(arrays[0]) + len(arrays[1])]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [
            {
                "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, opacity]},
                "alphaMode": "OPAQUE" if opacity == 1.0 else "BLEND",
                "doubleSided": opacity != 1.0,
            }
        ],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": _FLOAT,
                "count": len(vertices),
                "type": "VEC3",
            },
            {"bufferView": 2, "componentType": _UINT32, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(array)}
            for start, array in zip(starts, arrays, strict=True)
        ],
        "buffers": [{"byteLength": sum(map(len, arrays))}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(arrays)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)
    head = _HEADER.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON") + text
    return head + _CHUNK.pack(len(binary), b"BIN\0") + binary
