"""Meshes drawn in parallel projection with Lambert's shading: no display and no GPU.

Faces are drawn from the farthest to the nearest, which is right where they are as small as those of
a map's mesh. A view is three unit vectors ``[3, 3]``, to the right, down and forward, map frame.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import TriMesh
from matplotlib.tri import Triangulation
from triquad_format.records.arrays import Bools, Doubles, Ints
from triquad_map.height_scale import GAMMA

_DOWN_DEG, _ASIDE_DEG = 42.0, 18.0  # how far a view is turned down, and past the map's longer side
_MOST = (0.01, 0.99)  # of the vertices, along each axis of the picture: these are shown in any case
_ROOM, _MARGIN = 0.25, 1.04  # beyond them, of their extent, as far as there is anything; an edge
_LEAST_PIXEL_M = 1e-5
_SOME = 200_000  # faces or points are enough to choose a view
_TO_LIGHT = (-0.45, -0.65, -0.6)  # right, down and forward of a view: over the left shoulder
_AMBIENT = 0.55  # of the light; the rest comes from there


def vertex_normals(vertices: Doubles, faces: Ints) -> Doubles:
    """Return unit normals [V, 3]: those of the faces around a vertex, weighted by their area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shares = [np.bincount(faces.ravel(), part, len(vertices)) for part in across.repeat(3, 0).T]
    normals: Doubles = np.stack(shares, axis=1).astype(np.float64)  # integers of no face
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals


def view_axes(forward: Doubles) -> Doubles:
    """Return unit vectors [3, 3] to the right, down and forward of a view in a direction [3]."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def view_along(points: Doubles, corners: Doubles) -> Doubles:
    """Return the view of points [N, 3] aslant from above, of whose two sides that shows more faces.

    The longer side lies along the picture.

    Args:
        points: metres, map frame; one at least.
        corners: [F, 3, 3] of faces, which may be none.
    """
    some = points[:: len(points) // _SOME + 1]
    spread = np.cov(some[:, :2].T) if len(some) > 1 else np.eye(2)
    longest = np.linalg.eigh(spread)[1][:, -1]
    turn = math.atan2(longest[1], longest[0]) + math.pi / 2 - math.radians(_ASIDE_DEG)
    down, shown = math.radians(_DOWN_DEG), corners[:: len(corners) // _SOME + 1]
    views = []
    for to in (turn, turn + math.pi):
        level = math.cos(down) * np.array([math.cos(to), math.sin(to)])
        views.append(view_axes(np.append(level, -math.sin(down))))
    return max(views, key=lambda view: int(_are_facing(view, shown).sum()))


def draw_faces(axes: Axes, view: Doubles, vertices: Doubles, faces: Ints, colours: Doubles) -> None:
    """Draw the faces that show their outer sides onto axes, whose units become metres.

    Level ground has its own colour; light is white, so that it changes none into another. What lies
    far away from all else does not make the rest small: it stays outside.

    Args:
        axes: where to draw.
        view: as of :func:`view_along`.
        vertices: [V, 3] metres, map frame.
        faces: [F, 3] rows of vertices, one at least.
        colours: [V, 3] of the vertices, sRGB in [0, 1].
    """
    to_light = np.array(_TO_LIGHT) @ view / np.linalg.norm(_TO_LIGHT)
    lambert = np.maximum(vertex_normals(vertices, faces) @ to_light, 0.0)
    light = _AMBIENT + (1.0 - _AMBIENT) * lambert / max(float(to_light[2]), 0.1)
    shown = np.clip(colours**GAMMA * light[:, None], 0.0, 1.0) ** (1.0 / GAMMA)
    at = vertices @ view.T * [1.0, -1.0, -1.0]  # to the right, up and towards the eye
    _frame(axes, at[np.unique(faces), :2])
    facing = faces[_are_facing(view, vertices[faces])]
    if len(facing):
        nearest_last = facing[np.argsort(at[facing, 2].sum(axis=1))]
        triangles = TriMesh(Triangulation(at[:, 0], at[:, 1], nearest_last))
        triangles.set_facecolor(shown)
        axes.add_collection(triangles, autolim=False)


def _are_facing(view: Doubles, corners: Doubles) -> Bools:
    """Return whether faces with corners [F, 3, 3] show their outer side."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals @ view[2] < 0.0)


def _frame(axes: Axes, places: Doubles) -> None:
    """Let axes show most of some places [N, 2], metres, which are as long in both directions."""
    low, high = np.quantile(places, _MOST, axis=0)
    room = _ROOM * (high - low)
    low = np.maximum(low - room, places.min(axis=0))
    high = np.minimum(high + room, places.max(axis=0))
    pixels = axes.bbox.size
    pixel_m = _MARGIN * max(*((high - low) / pixels), _LEAST_PIXEL_M)
    left, bottom = 0.5 * (low + high - pixel_m * pixels)
    right, top = 0.5 * (low + high + pixel_m * pixels)
    axes.set(xlim=(left, right), ylim=(bottom, top))
