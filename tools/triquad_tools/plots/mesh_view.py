"""Meshes drawn in parallel projection with Lambert's shading: no display and no GPU.

Faces are drawn from the farthest to the nearest, which is right where they are as small as those of
a map's mesh.
"""

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import TriMesh
from matplotlib.tri import Triangulation
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Ints
from triquad_map.height_scale import GAMMA

WIDTH, HEIGHT = 1340, 740
"""The size of a picture, pixels."""

BACKGROUND: Doubles = np.array([0.93, 0.94, 0.95])
"""The sRGB colour of the background."""

_DOWN_DEG, _ASIDE_DEG = 42.0, 18.0  # how far a view is turned down, and past the map's longer side
_MOST = (0.01, 0.99)  # of the surface, along each axis of the picture: these are shown in any case
_ROOM, _MARGIN = 0.25, 1.04  # beyond them, of their extent, as far as there is anything; an edge
_LEAST_HEIGHT_M = 0.01
_SOME = 200_000  # faces or points are enough to choose a view
_TO_LIGHT = (-0.45, -0.65, -0.6)  # right, down and forward of a view: over the left shoulder
_AMBIENT = 0.55  # of the light; the rest comes from there


@dataclass(frozen=True)
class View:
    """The viewpoint of a picture, infinitely far away; the picture's top is towards +z."""

    axes: Doubles  # [3, 3] unit vectors to the right, down and forward, map frame
    target: Doubles  # [3] metres, in the middle of the picture
    height_m: float  # of what the picture shows, across the view

    def project(self, points: NDArray[np.floating]) -> Doubles:
        """Return column, row and metres nearer than the target [N, 3]."""
        seen = (points - self.target) @ self.axes.T
        columns_rows = np.array([WIDTH, HEIGHT]) / 2 + HEIGHT / self.height_m * seen[:, :2]
        return np.column_stack([columns_rows, -seen[:, 2]])

    def facing(self, corners: NDArray[np.floating]) -> Bools:
        """Return whether faces with corners [F, 3, 3] show their outer side."""
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(normals @ self.axes[2] < 0.0)

    @property
    def description(self) -> str:
        """What it shows, in words."""
        turn_deg = math.degrees(math.atan2(self.axes[2, 1], self.axes[2, 0]))
        return (
            f"parallel projection, {self.height_m * WIDTH / HEIGHT:.3g} m wide, looking down and "
            f"to {turn_deg:.0f}° from +x; faces seen from behind (ceilings), and what lies far "
            "away from all else, are left out"
        )


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


def view_along(points: Doubles, corners: Doubles) -> View:
    """Return the view of points [N, 3] aslant from above, of whose two sides that shows more faces.

    The longer side lies along the picture. What lies far away from all else does not make the rest
    small: it stays outside.

    Args:
        points: metres, map frame; one at least.
        corners: [F, 3, 3] of faces, which may be none.
    """
    some = points[:: len(points) // _SOME + 1]
    spread = np.cov(some[:, :2].T) if len(some) > 1 else np.eye(2)
    longest = np.linalg.eigh(spread)[1][:, -1]
    turn = math.atan2(longest[1], longest[0]) + math.pi / 2 - math.radians(_ASIDE_DEG)
    views = [_view_to(some, points, turn + side) for side in (0.0, math.pi)]
    shown = corners[:: len(corners) // _SOME + 1]
    return max(views, key=lambda view: int(view.facing(shown).sum()))


def _view_to(some: Doubles, points: Doubles, turn: float) -> View:
    """Return the view in a direction of the map, whose picture holds most of some points [N, 3]."""
    down = math.radians(_DOWN_DEG)
    level = math.cos(down) * np.array([math.cos(turn), math.sin(turn)])
    axes = view_axes(np.append(level, -math.sin(down)))
    ends = np.stack([end(points @ axes.T, axis=0) for end in (np.min, np.max)])
    low, high = np.quantile(some @ axes.T, _MOST, axis=0)
    room = _ROOM * (high - low)
    low, high = np.maximum(low - room, ends[0]), np.minimum(high + room, ends[1])
    width, height, _ = high - low
    height_m = _MARGIN * max(height, width * HEIGHT / WIDTH, _LEAST_HEIGHT_M)
    return View(axes, 0.5 * (low + high) @ axes, height_m)


def draw_faces(axes: Axes, view: View, vertices: Doubles, faces: Ints, colours: Doubles) -> None:
    """Draw the faces that show their outer sides onto axes, whose limits become the picture's.

    ``colours`` [V, 3] are sRGB in [0, 1]. Level ground has its own colour; light is white, so that
    it changes none into another.
    """
    to_light = np.array(_TO_LIGHT) @ view.axes / np.linalg.norm(_TO_LIGHT)
    lambert = np.maximum(vertex_normals(vertices, faces) @ to_light, 0.0)
    light = _AMBIENT + (1.0 - _AMBIENT) * lambert / max(float(to_light[2]), 0.1)
    shown = np.clip(colours**GAMMA * light[:, None], 0.0, 1.0) ** (1.0 / GAMMA)
    at, facing = view.project(vertices), faces[view.facing(vertices[faces])]
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    if len(facing):
        nearest_last = facing[np.argsort(at[facing, 2].sum(axis=1))]
        triangles = TriMesh(Triangulation(at[:, 0], at[:, 1], nearest_last))
        triangles.set_facecolor(shown)
        axes.add_collection(triangles, autolim=False)
