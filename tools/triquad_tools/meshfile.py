"""Meshes as PLY and GLB files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_tools.errors import MeshFileError

_PLY_TYPES = {"<f4": "float", "<f8": "double"}

# glTF has y up; maps have z up.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; one without faces is a point cloud."""

    vertices: NDArray[np.floating]  # [V, 3] metres, map frame
    faces: NDArray[np.integer]  # [F, 3] rows of vertices, counter-clockwise seen from outside


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh in the format that the suffix names: ``.ply`` or ``.glb``."""
    if path.suffix == ".ply":
        path.write_bytes(ply_bytes(mesh))
    elif path.suffix == ".glb":
        path.write_bytes(_glb_bytes(mesh))
    else:
        raise MeshFileError(f"{path}: meshes are written as .ply or .glb, not {path.suffix!r}")


def read_mesh(path: Path) -> Mesh:
    """The mesh of a ``.ply`` or ``.glb`` file, vertices as float64 in a frame with z up.

    A PLY file without faces gives a mesh without faces: a reference cloud.
    """
    import trimesh  # slow to import

    if path.suffix not in (".ply", ".glb"):
        raise MeshFileError(f"{path}: meshes are read from .ply or .glb, not {path.suffix!r}")
    if not path.is_file():
        raise MeshFileError(f"{path}: no such file")
    try:
        loaded: Any = trimesh.load(path, process=False)
        geometry: Any = loaded.to_geometry() if isinstance(loaded, trimesh.Scene) else loaded
        vertices = np.array(geometry.vertices, np.float64).reshape(-1, 3)
        faces = np.array(getattr(geometry, "faces", ()), np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever its parsers stumble on
        raise MeshFileError(f"{path}: cannot be read as a mesh: {error}") from error
    if path.suffix == ".glb":
        vertices = vertices @ _GLTF_FROM_MAP
    return Mesh(vertices, faces)


def ply_bytes(mesh: Mesh) -> bytes:
    """A mesh as a binary little-endian PLY file; float64 vertices stay float64."""
    little = np.ascontiguousarray(mesh.vertices)
    little = little.astype(little.dtype.newbyteorder("<"), copy=False)
    if little.dtype.str not in _PLY_TYPES:
        raise MeshFileError(f"vertices are float32 or float64, not {little.dtype}")
    kind = _PLY_TYPES[little.dtype.str]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment triquad",
        f"element vertex {len(little)}",
        *(f"property {kind} {axis}" for axis in "xyz"),
    ]
    corners = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("rows", "<i4", 3)]))
    corners["count"] = 3
    corners["rows"] = mesh.faces
    if len(mesh.faces):
        header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    header += ["end_header", ""]
    return "\n".join(header).encode() + little.tobytes() + corners.tobytes()


def _glb_bytes(mesh: Mesh) -> bytes:
    import trimesh  # slow to import

    if not len(mesh.faces):
        raise MeshFileError("a mesh without faces cannot be written as .glb; use .ply")
    turned = mesh.vertices @ _GLTF_FROM_MAP.T
    data: Any = trimesh.Trimesh(turned, mesh.faces, process=False).export(file_type="glb")
    return bytes(data)
