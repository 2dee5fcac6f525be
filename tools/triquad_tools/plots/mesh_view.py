"""Meshes drawn in parallel projection: a z-buffer with Lambert's shading, no display and no GPU.

Own code, as VTK takes 560 MB, and does not run where no library of OpenGL is installed.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints
from triquad_map.compiled.kernel import kernel
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
_FINER = 2  # pixels for one of the picture, along each side
_TO_LIGHT = (-0.45, -0.65, -0.6)  # right, down and forward of a view: over the left shoulder
_AMBIENT = 0.55  # of the light; the rest comes from there
_POINT_PIXELS, _LEAST_POINT_M = 2.5, 0.02  # side of a point: the greater of both


@dataclass(frozen=True)
class View:
    """The viewpoint of a picture, infinitely far away; the picture's top is towards +z."""

    axes: Doubles  # [3, 3] unit vectors to the right, down and forward, map frame
    target: Doubles  # [3] metres, in the middle of the picture
    height_m: float  # of what the picture shows, across the view

    def project(self, points: NDArray[np.floating], height: int = HEIGHT) -> Doubles:
        """Return column, row and metres nearer than the target [N, 3], for ``height`` rows."""
        seen = (points - self.target) @ self.axes.T
        middle, per_m = np.array([WIDTH, HEIGHT]) * height / HEIGHT / 2, height / self.height_m
        return np.column_stack([middle + per_m * seen[:, :2], -seen[:, 2]])

    def facing(self, corners: NDArray[np.floating]) -> Bools:
        """Return whether faces with corners [F, 3, 3] show their outer side."""
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(normals @ self.axes[2] < 0.0)

    def outside(self, points: NDArray[np.floating]) -> str:
        """Return a remark on those of points [N, 3], one at least, beyond the picture's edges."""
        right, down, _ = ((points - self.target) @ self.axes.T).T
        beyond = np.abs(down) > self.height_m / 2
        beyond |= np.abs(right) > WIDTH / HEIGHT * self.height_m / 2
        if not beyond.any():
            return ""
        share, reach_m = 100.0 * float(beyond.mean()), float(np.hypot(right, down).max())
        return f"beyond the edges: {share:.2g} %, up to {reach_m:.3g} m from the picture's middle"


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


class Picture:
    """A picture of faces and points in their colours; what is nearer hides what is farther."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._shape = (HEIGHT * _FINER, WIDTH * _FINER)
        self._light = np.tile(BACKGROUND**GAMMA, (*self._shape, 1))
        self._nearness = np.full(self._shape, -np.inf)

    def add_mesh(self, vertices: Doubles, faces: Ints, colours: Doubles) -> None:
        """Draw the faces that show their outer sides; ``colours`` [V, 3] are sRGB in [0, 1].

        Level ground has its own colour; light is white, so that it changes none into another.
        """
        axes = self._view.axes
        to_light = np.array(_TO_LIGHT) @ axes / np.linalg.norm(_TO_LIGHT)
        lambert = np.maximum(vertex_normals(vertices, faces) @ to_light, 0.0)
        light = _AMBIENT + (1.0 - _AMBIENT) * lambert / max(float(to_light[2]), 0.1)
        shown = faces[self._view.facing(vertices[faces])]
        owners = np.full(self._shape, -1, np.int32)
        weights = np.zeros((*self._shape, 3), np.float32)
        corners = self._view.project(vertices, self._shape[0])
        _draw(corners, np.ascontiguousarray(shown, np.int32), self._nearness, owners, weights)
        covered = owners >= 0
        lit = colours**GAMMA * light[:, None]
        self._light[covered] = np.einsum(
            "pc,pck->pk", weights[covered], lit[shown[owners[covered]]]
        )

    def add_points(self, points: Doubles, colours: Doubles) -> None:
        """Draw points [N, 3] as squares in plain colours [N, 3], sRGB in [0, 1]."""
        at = self._view.project(points, self._shape[0])
        at = np.column_stack([at, colours**GAMMA])[np.argsort(at[:, 2])]
        side = max(_POINT_PIXELS * _FINER, _LEAST_POINT_M * self._shape[0] / self._view.height_m)
        for down, right in np.ndindex(math.ceil(side), math.ceil(side)):
            columns, rows = np.floor(at[:, :2] + [right - side / 2, down - side / 2]).T.astype(int)
            inside = (rows >= 0) & (rows < self._shape[0])
            inside &= (columns >= 0) & (columns < self._shape[1])
            rows, columns, seen = rows[inside], columns[inside], at[inside]
            free = seen[:, 2] >= self._nearness[rows, columns]
            self._light[rows[free], columns[free]] = seen[free, 3:]

    def pixels(self) -> Bytes:
        """Return the picture [HEIGHT, WIDTH, 3]."""
        fine = self._light.reshape(HEIGHT, _FINER, WIDTH, _FINER, 3).mean(axis=(1, 3))
        return np.asarray(np.round(255.0 * np.clip(fine, 0.0, 1.0) ** (1.0 / GAMMA)), np.uint8)


@kernel()
def _draw(corners: Doubles, faces: Ints, nearness: Doubles, owners: Ints, weights: Floats) -> None:
    """Draw triangles into a z-buffer: in each pixel the nearest face and weights of its corners."""
    height, width = nearness.shape
    for f in range(faces.shape[0]):
        ax, ay, an = corners[faces[f, 0]]
        bx, by, bn = corners[faces[f, 1]]
        cx, cy, cn = corners[faces[f, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        left = int(max(np.ceil(min(ax, bx, cx) - 0.5), 0.0))
        right = int(min(np.floor(max(ax, bx, cx) - 0.5), width - 1.0))
        top = int(max(np.ceil(min(ay, by, cy) - 0.5), 0.0))
        bottom = int(min(np.floor(max(ay, by, cy) - 0.5), height - 1.0))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                near = wa * an + wb * bn + wc * cn
                if min(wa, wb, wc) >= 0.0 and near > nearness[row, column]:
                    nearness[row, column] = near
                    owners[row, column] = f
                    weights[row, column, 0] = wa
                    weights[row, column, 1] = wb
                    weights[row, column, 2] = wc
