"""Meshes in files, PLY, GLB, OBJ and STL."""

from pathlib import Path
from typing import Any

import numpy as np
from triquad_client import Mesh

from triquad_tools.console.arguments import MESH_SUFFIXES
from triquad_tools.console.command import ToolError

# glTF has y up; maps have z up.
_GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def read_mesh(path: Path) -> Mesh:
    """Return the mesh of a file, vertices as float64 in a frame with z up.

    A PLY file without faces gives a mesh without faces: a reference cloud.

    Raises:
        ToolError: there is no such file, or it cannot be read as a mesh.
    """
    import trimesh  # slow to import

    if path.suffix not in MESH_SUFFIXES:
        names = ", ".join(MESH_SUFFIXES)
        raise ToolError(
            f"{path}: meshes are read from {names}, not {path.suffix!r}; triquad-pack makes one of "
            "a map"
        )
    if not path.is_file():
        raise ToolError(f"{path}: no such file")
    try:
        loaded: Any = trimesh.load(path, process=False)
        geometry: Any = loaded.to_geometry() if isinstance(loaded, trimesh.Scene) else loaded
        vertices = np.array(geometry.vertices, np.float64).reshape(-1, 3)
        faces = np.array(getattr(geometry, "faces", ()), np.int32).reshape(-1, 3)
    except Exception as error:  # trimesh raises any error of its parsers
        raise ToolError(f"{path}: cannot be read as a mesh: {error}") from error
    if path.suffix == ".glb":
        vertices = vertices @ _GLTF_FROM_MAP
    return Mesh(vertices, faces)
