"""Meshes in files: PLY, GLB, OBJ and STL.

trimesh reads all of them, and writes OBJ and STL. The client writes PLY and GLB: it keeps
double precision, and places the vertices of a GLB relative to their middle: trimesh rounds both to
single precision in the map frame, centimetres off some 100 km from its origin.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from triquad_client.mesh.glb import glb_bytes
from triquad_client.mesh.ply import ply_bytes

from triquad_tools.console.command import ToolError

MESH_SUFFIXES = (".ply", ".glb", ".obj", ".stl")

# glTF has y up; maps have z up.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class MeshFileError(ToolError):
    """A mesh file that cannot be read."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; one without faces is a point cloud."""

    vertices: NDArray[np.floating]  # [V, 3] metres, map frame
    faces: NDArray[np.integer]  # [F, 3] rows of vertices, counter-clockwise seen from outside


def read_mesh(path: Path) -> Mesh:
    """The mesh of a file, vertices as float64 in a frame with z up.

    A PLY file without faces gives a mesh without faces: a reference cloud.
    """
    if path.suffix not in MESH_SUFFIXES:
        names = ", ".join(MESH_SUFFIXES)
        raise MeshFileError(f"{path}: meshes are read from {names}, not {path.suffix!r}")
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


def mesh_bytes(mesh: Mesh, suffix: str) -> bytes:
    """A mesh as a file whose name ends in ``suffix``, one of :data:`MESH_SUFFIXES`; metres.

    A ``.glb`` has y upwards, as glTF wants; the others are in the map frame.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    if suffix == ".ply":
        return ply_bytes(vertices, faces)
    if suffix == ".glb":
        return glb_bytes(vertices, faces)
    made: Any = trimesh.Trimesh(vertices, faces, process=False)
    exported: str | bytes = made.export(file_type=suffix.removeprefix("."))
    return exported.encode() if isinstance(exported, str) else exported
