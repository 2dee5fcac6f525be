"""A picture of a whole mesh, seen from above and aside."""

import math
from pathlib import Path

import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray
from triquad_client import Mesh, OfflineMap
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import MapRecord

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box
from triquad_tools.plots.render import Camera, height_colours, render_mesh, view_axes

_VIEW_DEG = 35.0
_TOWARDS_EYE = np.array([-0.45, -0.65, 0.62])
_FRAMED = (1.0, 99.0)  # percentiles: what lies far away from all else does not make it small
_MARGIN = 1.05
_ENOUGH = 200_000  # vertices, to find the place of the camera
_ASPECT = 16 / 9


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


def camera_around(vertices: NDArray[np.floating]) -> Camera:
    """A camera that looks down aslant and has nearly all vertices ``[V, 3]`` in its picture."""
    if len(vertices) == 0:
        return Camera(_TOWARDS_EYE, np.zeros(3), _VIEW_DEG)
    some = vertices[:: max(1, len(vertices) // _ENOUGH)].astype(np.float64)
    axes = view_axes(-_TOWARDS_EYE)
    seen = some @ axes.T
    middle = 0.5 * np.percentile(seen, _FRAMED, axis=0).sum(axis=0)
    right, down, ahead = (seen - middle).T
    tangent = math.tan(0.5 * math.radians(_VIEW_DEG))
    needed = np.maximum(np.abs(right) / _ASPECT, np.abs(down)) / tangent - ahead
    distance_m = _MARGIN * np.percentile(needed, _FRAMED[1])
    return Camera((middle - [0.0, 0.0, distance_m]) @ axes, middle @ axes, _VIEW_DEG)


def _towards(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], eye: Doubles
) -> NDArray[np.integer]:
    """The faces whose outer sides are seen from ``eye``."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    outwards = np.cross(second - first, third - first)
    kept: NDArray[np.integer] = faces[((eye - first) * outwards).sum(axis=1) > 0]
    return kept
