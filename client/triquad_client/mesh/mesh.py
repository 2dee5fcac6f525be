"""A surface as triangles, and its files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from triquad_client.errors import InvalidInputError
from triquad_client.mesh.glb import glb_bytes
from triquad_client.mesh.ply import ply_bytes


@dataclass(frozen=True)
class Mesh:
    """Triangles of the map frame."""

    vertices: NDArray[np.float64]  # [V, 3] metres
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    epoch: int

    def save(self, path: str | Path) -> None:
        """Write the mesh as ``.ply`` (map frame, metres, double) or ``.glb``.

        A glTF scene has its y axis upwards: in a ``.glb`` the map's (x, y, z) is (x, z, -y) of
        the scene, by the transform of its node.

        Raises:
            InvalidInputError: the name ends otherwise.
        """
        path = Path(path)
        writers = {".ply": ply_bytes, ".glb": glb_bytes}
        if path.suffix.lower() not in writers:
            raise InvalidInputError(f"cannot write {path}: use a name that ends in .ply or .glb")
        path.write_bytes(writers[path.suffix.lower()](self.vertices, self.faces))
