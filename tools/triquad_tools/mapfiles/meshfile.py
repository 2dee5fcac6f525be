"""Meshes in files, PLY, GLB, OBJ and STL: read, and written of a map."""

from pathlib import Path
from typing import Any

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.durable_file import replacing
from triquad_format.records.region import MapRecord

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box, NothingLeftError

MESH_SUFFIXES = (".ply", ".glb", ".obj", ".stl")

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
        raise ToolError(f"{path}: meshes are read from {names}, not {path.suffix!r}")
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


def meshed(record: MapRecord, box: Box | None, cell_m: float | None, fill_m: float = 0.0) -> Mesh:
    """Return the mesh of a map, with cells of side ``cell_m``, half a leaf where that is not given.

    Given a box, it has the faces whose centroids lie in it. Surface is continued up to ``fill_m``
    into unknown space.

    Raises:
        InvalidInputError: the mesh is too large, or a library is missing.
    """
    bounds = None if box is None else (box[0].tolist(), box[1].tolist())
    with OfflineMap(record) as opened, progress("meshing", 1.0) as report:
        return opened.mesh(
            bounds, cell_m, lambda done, of: report(done / of, f"{done} blocks"), fill_m
        )


def export_mesh(
    record: MapRecord, box: Box | None, cell_m: float | None, path: Path, fill_m: float = 0.0
) -> str:
    """Write the mesh of a map, see :func:`meshed`; return what was written.

    Raises:
        InvalidInputError: the mesh is too large, or a library is missing.
        NothingLeftError: no surface was seen in the box.
        OSError: the file cannot be written.
    """
    mesh = meshed(record, box, cell_m, fill_m)
    if box is not None and len(mesh.faces) == 0:
        raise NothingLeftError(f"{path} is not written: no surface was seen in the box of --crop")
    packed = mesh.file_bytes(path.suffix)
    with replacing(path) as stream:
        stream.write(packed)
    written = f"{len(packed):,} bytes, {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    return written if mesh.filled is None else f"{written}, {mesh.filled.sum():,} of them filled"
