"""A camera that shows a whole mesh by itself: from which side, and how near."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles

from triquad_tools.evaluation.metrics import sample_mesh
from triquad_tools.plots.camera import ParallelCamera, view_axes
from triquad_tools.plots.render import facing

_DOWN_DEG = 42.0
_SIDES = 16
_MOST = (0.01, 0.99)  # of the surface, along each axis of the picture: these are shown in any case
_ROOM = 0.25  # beyond them, of their extent, as far as there is anything
_MARGIN = 1.04
_LEAST_HEIGHT_M = 0.01
_FACES, _SAMPLES = 200_000, 50_000  # enough to choose the camera
_SEED = 0  # the same map has the same picture
_CELLS = 90  # along the picture's height, to tell how much of it is filled


@dataclass(frozen=True)
class Framing:
    """A camera, and what of the mesh lies outside of its picture."""

    camera: ParallelCamera
    outside_share: float  # of the faces
    farthest_m: float  # from the middle of the picture, across the view

    @property
    def looks_to(self) -> str:
        """The direction in which the camera looks, as those of maps: +y is north."""
        forward = self.camera.from_eye
        eighth = round(math.degrees(math.atan2(forward[1], forward[0])) / 45.0) % 8
        names = ("+x", "+x +y", "+y", "-x +y", "-x", "-x -y", "-y", "+x -y")
        return names[eighth]


def framed(mesh: Mesh, aspect: float) -> Framing:
    """The view of a mesh with faces, aslant from above, that fills most of a picture.

    Faces that turn away from the camera, such as ceilings, count for nothing. What lies far away
    from all else does not make the rest small: it stays outside.

    Args:
        mesh: has at least one face.
        aspect: width of the picture by its height.
    """
    some = Mesh(mesh.vertices, mesh.faces[:: max(1, len(mesh.faces) // _FACES)])
    samples = sample_mesh(some, _SAMPLES, np.random.default_rng(_SEED))
    down = math.radians(_DOWN_DEG)
    views = []
    for side in range(_SIDES):
        turn = 2.0 * math.pi * (side + 0.5) / _SIDES
        level = math.cos(down) * np.array([math.cos(turn), math.sin(turn)])
        from_eye = np.append(level, -math.sin(down))
        camera = _camera_along(from_eye, mesh, samples, aspect=aspect)
        views.append((_filled(some, camera, aspect), -side, camera))
    return _framing(mesh, max(views, key=lambda view: view[:2])[2], aspect)


def _camera_along(from_eye: Doubles, mesh: Mesh, samples: Doubles, aspect: float) -> ParallelCamera:
    """The camera in a direction ``[3]`` whose picture holds most of the samples ``[N, 3]``."""
    axes = view_axes(from_eye)
    ends = np.stack([end(mesh.vertices @ axes.T, axis=0) for end in (np.min, np.max)])
    low, high = np.quantile(samples @ axes.T, _MOST, axis=0)
    room = _ROOM * (high - low)
    low, high = np.maximum(low - room, ends[0]), np.minimum(high + room, ends[1])
    width, height, _ = high - low
    height_m = _MARGIN * max(height, width / aspect, _LEAST_HEIGHT_M)
    return ParallelCamera(from_eye, 0.5 * (low + high) @ axes, height_m)


def _filled(mesh: Mesh, camera: ParallelCamera, aspect: float) -> int:
    """How many cells of the picture have a face that is seen from outside."""
    outside = Mesh(mesh.vertices, mesh.faces[facing(mesh.vertices[mesh.faces], camera)])
    if not len(outside.faces):
        return 0
    shown = sample_mesh(outside, _SAMPLES, np.random.default_rng(_SEED))
    columns = round(aspect * _CELLS)
    at = camera.project(shown, columns, _CELLS)[:, :2].astype(np.int64)
    inside = ((at >= 0) & (at < [columns, _CELLS])).all(axis=1)
    return len(np.unique(at[inside] @ [1, columns]))


def _framing(mesh: Mesh, camera: ParallelCamera, aspect: float) -> Framing:
    middles: NDArray[np.floating] = mesh.vertices[mesh.faces].mean(axis=1)
    right, down, _ = ((middles - camera.target) @ camera.axes.T).T
    reach_m = np.hypot(right, down)
    outside = (np.abs(down) > camera.height_m / 2) | (np.abs(right) > aspect * camera.height_m / 2)
    return Framing(camera, float(outside.mean()), float(reach_m.max()))
