"""A surface as triangles, and how it is written to files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Doubles
from triquad_map.triangles import Triangles

from triquad_client.mesh.mesh_files import GlbMesh, glb_bytes, ply_bytes

if TYPE_CHECKING:
    import open3d
    import trimesh

_Y_UP = np.array([(1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1.0)])
"""The map's axes, of which z points upwards, as those of a glTF scene."""


@dataclass(frozen=True, repr=False)
class Mesh(Triangles):
    """Triangles of the map frame.

    Attributes:
        vertices: [V, 3] metres, map frame.
        faces: [F, 3] rows of vertices, counter-clockwise seen from free space.
        filled: [F] whether no ray has met the surface there: it is continued from what was seen,
            and the status there is ``UNKNOWN``; ``None`` where no holes were to be filled.
        epoch: number of the published state of the map that it shows; 0: of none.
    """

    epoch: int = 0

    def __repr__(self) -> str:
        filled = 0 if self.filled is None else int(self.filled.sum())
        told = f"{len(self.vertices)} vertices, {len(self.faces)} faces"
        return f"Mesh({told}{f', {filled} of them filled' if filled else ''}; epoch {self.epoch})"

    @classmethod
    def of(cls, triangles: Triangles, epoch: int) -> Mesh:
        """Return the triangles, which show the ``epoch``."""
        return cls(triangles.vertices, triangles.faces, triangles.filled, epoch)

    def save(self, path: str | Path) -> None:
        """Write the mesh to a file: ``.ply`` or ``.glb``, or ``.obj`` or ``.stl`` with trimesh.

        A ``.ply`` is exact (double precision), an ``.obj`` has eight decimals, an ``.stl`` is of
        single precision: half a metre where coordinates are as large as UTM northings. So are
        the positions in a ``.glb``, but relative to the middle of the mesh: its node moves them
        back, and turns the map's z axis to the y axis that points upwards in a glTF scene.

        Where holes were filled, a ``.ply`` marks the faces by their property ``filled``, 1 or 0;
        a ``.glb`` and an ``.obj`` have two meshes, ``seen`` and ``filled``.

        Raises:
            InvalidInputError: the name ends otherwise, trimesh is not installed, or holes were
                filled, which an ``.stl`` cannot say.
            OSError: the file cannot be written.
        """
        Path(path).write_bytes(self.file_bytes(Path(path).suffix))

    def file_bytes(self, suffix: str) -> bytes:
        """Return what :meth:`save` writes to a file whose name ends in ``suffix``, as ``".ply"``.

        Raises:
            InvalidInputError: there is no such format, or trimesh is not installed.
        """
        encode = _FORMATS.get(suffix.lower())
        if encode is None:
            raise InvalidInputError(f"suffix = {suffix!r}: use one of {', '.join(_FORMATS)}")
        return encode(self)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return a copy for the library trimesh.

        Raises:
            InvalidInputError: trimesh is not installed.
        """
        try:
            import trimesh
        except ImportError as error:
            raise InvalidInputError("trimesh is missing: pip install 'triquad[mesh]'") from error
        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)

    def to_open3d(self) -> open3d.geometry.TriangleMesh:
        """Return a copy for the library Open3D, with normals of its vertices.

        Raises:
            InvalidInputError: Open3D is not installed.
        """
        try:
            import open3d
        except ImportError as error:
            told = f"open3d is missing ({error}): pip install 'triquad[open3d]'"
            raise InvalidInputError(told) from error
        vectors = open3d.utility
        corners, faces = vectors.Vector3dVector(self.vertices), vectors.Vector3iVector(self.faces)
        return open3d.geometry.TriangleMesh(corners, faces).compute_vertex_normals()


def compacted(vertices: Doubles, faces: NDArray[np.integer]) -> Mesh:
    """Return the mesh without vertices that no face uses."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return Mesh(vertices[used], number.take(faces).reshape(-1, 3))


def _ply(mesh: Mesh) -> bytes:
    return ply_bytes(mesh.vertices, mesh.faces, mesh.filled)


def _glb(mesh: Mesh) -> bytes:
    """Return a mesh relative to its middle, where single precision is fine enough."""
    if not len(mesh.faces):
        return glb_bytes([])
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    back = _Y_UP.copy()
    back[:3, 3] = _Y_UP[:3, :3] @ middle
    parts = _parts(mesh).items()
    return glb_bytes(
        [GlbMesh(name, part.vertices - middle, part.faces) for name, part in parts], back
    )


def _obj(mesh: Mesh) -> bytes:
    whole = mesh.to_trimesh()
    return _exported(whole if mesh.filled is None or not len(mesh.faces) else _scene(mesh), "obj")


def _stl(mesh: Mesh) -> bytes:
    if mesh.filled is not None:
        raise InvalidInputError(
            "an .stl cannot tell which faces fill holes: use .ply, .glb or .obj, or no fill_m"
        )
    return _exported(mesh.to_trimesh(), "stl")


def _parts(mesh: Mesh) -> dict[str, Mesh]:
    """Return the mesh by itself; where holes were filled, in two parts, ``seen`` and ``filled``."""
    if mesh.filled is None:
        return {"mesh": mesh}
    chosen = {"seen": ~mesh.filled, "filled": mesh.filled}
    return {
        name: compacted(mesh.vertices, mesh.faces[faces])
        for name, faces in chosen.items()
        if faces.any()
    }


def _scene(mesh: Mesh) -> trimesh.Scene:
    import trimesh

    scene = trimesh.Scene()
    for name, part in _parts(mesh).items():
        scene.add_geometry(part.to_trimesh(), node_name=name, geom_name=name)
    return scene


def _exported(surface: trimesh.Trimesh | trimesh.Scene, kind: str) -> bytes:
    data = surface.export(file_type=kind)
    return data.encode("ascii") if isinstance(data, str) else cast(bytes, data)


_FORMATS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": _ply,
    ".glb": _glb,
    ".obj": _obj,
    ".stl": _stl,
}
