"""Meshes from PLY and GLB files; :meth:`triquad_client.Mesh.save` writes them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_tools.console.errors import MeshFileError

# glTF has y up; maps have z up.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh; one without faces is a point cloud."""

    vertices: NDArray[np.floating]  # [V, 3] metres, map frame
    faces: NDArray[np.integer]  # [F, 3] rows of vertices, counter-clockwise seen from outside


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
