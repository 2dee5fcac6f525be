"""A mesh with colours as GLB, drawn as it is coloured: without lights, which cost most of all.

Specification: glTF 2.0, and KHR_materials_unlit.
"""

import json
import struct
from typing import Any, NamedTuple

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
    document = _document(triangles, [len(array) for array in arrays], opacity)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(arrays)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)
    head = _HEADER.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON") + text
    return head + _CHUNK.pack(len(binary), b"BIN\0") + binary


def _document(triangles: Triangles, lengths: list[int], opacity: float) -> dict[str, Any]:
    """What the binary part holds: positions, colours and faces of so many bytes each."""
    vertices, faces = triangles
    starts = [sum(lengths[:number]) for number in range(len(lengths))]
    floats = {"componentType": _FLOAT, "count": len(vertices), "type": "VEC3"}
    lows, highs = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [_material(opacity)],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, **floats, "min": lows, "max": highs},
            {"bufferView": 1, **floats},
            {"bufferView": 2, "componentType": _UINT32, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": length}
            for start, length in zip(starts, lengths, strict=True)
        ],
        "buffers": [{"byteLength": sum(lengths)}],
    }


def _material(opacity: float) -> dict[str, Any]:
    return {
        "extensions": {"KHR_materials_unlit": {}},
        "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, opacity]},
        "alphaMode": "OPAQUE" if opacity == 1.0 else "BLEND",
        "doubleSided": opacity != 1.0,
    }
