"""A picture of a whole mesh, seen aslant from above, coloured by height."""

import math
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from triquad_client import Mesh
from triquad_format.mapfile.files import replacing
from triquad_map.height_scale import HeightScale

from triquad_tools.plots.colours import HEIGHTS
from triquad_tools.plots.mesh_view import draw_faces, view_along

BACKGROUND = (0.93, 0.94, 0.95)  # the sRGB colour of the background
TOP, WIDTH, HEIGHT = 90, 1340, 740  # rows above the mesh, which is at the left; its size, pixels
_PALE = 0.6  # how far faces that were not seen are turned to the background
_WIDE, _HIGH = 1600, 900  # pixels of the whole picture
_BAR = (1362 / _WIDE, 390 / _HIGH, 30 / _WIDE, 360 / _HIGH)  # left, bottom, width, height


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
