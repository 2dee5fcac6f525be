"""A picture of a whole mesh, seen aslant from above, coloured by height: no display and no GPU.

It is drawn in parallel projection with Lambert's shading, from the farthest face to the nearest,
which is right where faces are as small as those of a map's mesh. A view is three unit vectors
``[3, 3]``, to the right, down and forward, map frame.
"""

import math
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import TriMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from triquad_client import Mesh
from triquad_format.mapfile.files import replacing
from triquad_format.records.arrays import Bools, Doubles, Ints
from triquad_map.height_scale import GAMMA, HeightScale

from triquad_tools.plots.colours import HEIGHTS

BACKGROUND = (0.93, 0.94, 0.95)  # the sRGB colour of the background
TOP, WIDTH, HEIGHT = 90, 1340, 740  # rows above the mesh, which is at the left; its size, pixels
_PALE = 0.6  # how far faces that were not seen are turned to the background
_WIDE, _HIGH = 1600, 900  # pixels of the whole picture
_BAR = (1362 / _WIDE, 390 / _HIGH, 30 / _WIDE, 360 / _HIGH)  # left, bottom, width, height

_DOWN_DEG, _ASIDE_DEG = 42.0, 18.0  # how far a view is turned down, and past the map's longer side
_MOST = (0.01, 0.99)  # of the vertices, along each axis of the picture: these are shown in any case
_ROOM, _MARGIN = 0.25, 1.04  # beyond them, of their extent, as far as there is anything; an edge
_LEAST_PIXEL_M = 1e-5
_SOME = 200_000  # faces or points are enough to choose a view
_TO_LIGHT = (-0.45, -0.65, -0.6)  # right, down and forward of a view: over the left shoulder
_AMBIENT = 0.55  # of the light; the rest comes from there


def draw_mesh(title: str, mesh: Mesh, path: Path) -> None:
    """Save a picture of a mesh with faces, from a side that is chosen for it.

    Faces that only continue what was seen are pale, and the note counts them.

    Ceilings do not hide what is below them: faces that turn away are left out.

    Raises:
        OSError: it cannot be written.
    """
    used = mesh.vertices[np.unique(mesh.faces)]
    heights = HeightScale.around(used[:, 2])
    view = view_along(used, mesh.vertices[mesh.faces])
    least_m, most_m = float(used[:, 2].min()), float(used[:, 2].max())
    # A scale ends in an arrow where there are values beyond.
    arrows = (("neither", "max"), ("min", "both"))
    beyond = arrows[least_m < heights.low_m][most_m > heights.high_m]
    colours, filled = heights.colours(mesh.vertices[:, 2]), ""
    if mesh.filled is not None and mesh.filled.any():
        alone = np.setdiff1d(mesh.faces[mesh.filled], mesh.faces[~mesh.filled])
        colours[alone] += _PALE * (np.array(BACKGROUND) - colours[alone])
        filled = f", {mesh.filled.mean():.0%} of them pale: not seen, continued from what was"
    note = f"{len(mesh.faces):,} faces{filled}, from z = {least_m:.2f} to {most_m:.2f} m"
    with rc_context({"font.size": 15}):
        figure = Figure((_WIDE / 100, _HIGH / 100), 100, facecolor=BACKGROUND)
        place = (0.0, 1.0 - (TOP + HEIGHT) / _HIGH, WIDTH / _WIDE, HEIGHT / _HIGH)
        axes = figure.add_axes(place, xticks=[], yticks=[], facecolor=BACKGROUND)
        draw_faces(axes, view, mesh.vertices, mesh.faces, colours)
        axes.spines[:].set_visible(False)
        axes.set_title(title, loc="left", x=0.01, parse_math=False)
        wide_m, turn_deg = np.ptp(axes.get_xlim()), math.degrees(math.atan2(view[2, 1], view[2, 0]))
        seen = (
            f"parallel projection, {wide_m:.3g} m wide, looking down and to {turn_deg:.0f}° from "
            "+x; without faces seen from behind (ceilings) and what lies far away"
        )
        axes.set_xlabel(f"{seen}\n{note}", ha="left", x=0.01)
        scale = ScalarMappable(Normalize(heights.low_m, heights.high_m), HEIGHTS)
        bar = figure.add_axes(_BAR)
        figure.colorbar(scale, cax=bar, extend=beyond, label="height z in m")
        with replacing(path) as stream:
            figure.savefig(stream, format="png")


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
