"""A surface as triangles, and its files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from triquad_client.errors import InvalidInputError

if TYPE_CHECKING:
    import trimesh

_Y_UP = np.array([(1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1.0)])
"""The map's axes, of which z points upwards, as those of a glTF scene."""

_PLY_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])


@dataclass(frozen=True)
class Mesh:
    """Triangles of the map frame."""

    vertices: NDArray[np.float64]  # [V, 3] metres
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    epoch: int = 0  # number of the published state of the map that it shows; 0: of none

    def save(self, path: str | Path) -> None:
        """Write the mesh to a file: ``.ply``, or ``.glb``, ``.obj`` or ``.stl`` with trimesh.

        A ``.ply`` is exact (double precision), an ``.obj`` has eight decimals, an ``.stl`` is of
        single precision: half a metre where coordinates are as large as UTM northings. So are
        the positions in a ``.glb``, but relative to the middle of the mesh: its node moves them
        back, and turns the map's z axis to the y axis that points upwards in a glTF scene.

        Raises:
            InvalidInputError: the name ends otherwise, or trimesh is not installed.
            OSError: the file cannot be written.
        """
        Path(path).write_bytes(self.file_bytes(Path(path).suffix))

    def file_bytes(self, suffix: str) -> bytes:
        """What :meth:`save` writes to a file whose name ends in ``suffix``, such as ``".ply"``.

        Raises:
            InvalidInputError: there is no such format, or trimesh is not installed.
        """
        encode = _FORMATS.get(suffix.lower())
        if encode is None:
            raise InvalidInputError(f"suffix = {suffix!r}: use one of {', '.join(_FORMATS)}")
        return encode(self)

    def to_trimesh(self) -> "trimesh.Trimesh":
        """A copy for the library trimesh.

        Raises:
            InvalidInputError: trimesh is not installed.
        """
        try:
            import trimesh
        except ImportError as error:
            raise InvalidInputError("trimesh is missing: pip install 'triquad[mesh]'") from error
        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)


def _ply(mesh: Mesh) -> bytes:
    """Binary PLY in double precision; that of trimesh is single, and this one needs no library."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment triquad, metres\n"
        f"element vertex {len(mesh.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(mesh.faces), _PLY_FACE)
    rows["count"] = 3
    rows["indices"] = mesh.faces
    return header.encode("ascii") + mesh.vertices.astype("<f8").tobytes() + rows.tobytes()


def _glb(mesh: Mesh) -> bytes:
    surface = mesh.to_trimesh()
    middle = surface.bounds.mean(axis=0) if len(mesh.faces) else np.zeros(3)
    surface.vertices -= middle
    back = _Y_UP.copy()
    back[:3, 3] = _Y_UP[:3, :3] @ middle
    scene = surface.scene(camera=None)
    scene.apply_transform(back)
    return _exported(scene, "glb")


def _obj(mesh: Mesh) -> bytes:
    return _exported(mesh.to_trimesh(), "obj")


def _stl(mesh: Mesh) -> bytes:
    return _exported(mesh.to_trimesh(), "stl")


def _exported(surface: "trimesh.Trimesh | trimesh.Scene", kind: str) -> bytes:
    data = surface.export(file_type=kind)
    return data.encode("ascii") if isinstance(data, str) else cast(bytes, data)


_FORMATS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": _ply,
    ".glb": _glb,
    ".obj": _obj,
    ".stl": _stl,
}
