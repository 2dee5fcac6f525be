"""A picture of a whole mesh, seen from above and aside."""

from pathlib import Path

import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray
from triquad_client import Mesh, OfflineMap
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import MapRecord

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box
from triquad_tools.plots.camera import camera_around
from triquad_tools.plots.render import height_colours, render_mesh


def export_picture(record: MapRecord, box: Box | None, cell_m: float, path: Path) -> str:
    """Save a picture of a map, or of what of it lies in a box; returns what it shows.

    Raises:
        InvalidInputError: the mesh is too large, or a library is missing.
        OSError: it cannot be written.
    """
    bounds = None if box is None else (box[0].tolist(), box[1].tolist())
    with OfflineMap(record) as opened, progress("meshing", 1.0) as report:
        mesh = opened.mesh(bounds, cell_m, lambda done, of: report(done / of, f"{done} blocks"))
    draw_mesh(mesh, path)
    return f"a picture of {len(mesh.faces):,} faces"


def draw_mesh(mesh: Mesh, path: Path) -> None:
    """Save a picture of a mesh, coloured by height. Ceilings do not hide what is below them.

    Raises:
        OSError: it cannot be written.
    """
    camera = camera_around(mesh.vertices)
    faces = _towards(mesh.vertices, mesh.faces, camera.eye)
    image = render_mesh(mesh.vertices, faces, height_colours(mesh.vertices), camera=camera)
    imsave(path, image)


def _towards(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], eye: Doubles
) -> NDArray[np.integer]:
    """The faces whose outer sides are seen from ``eye``."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    outwards = np.cross(second - first, third - first)
    kept: NDArray[np.integer] = faces[((eye - first) * outwards).sum(axis=1) > 0]
    return kept
