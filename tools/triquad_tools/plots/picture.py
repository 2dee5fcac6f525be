"""A picture of a whole mesh, seen aslant from above, coloured by height."""

from pathlib import Path

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.metadata import utc_time
from triquad_map.height_scale import HeightScale

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box, NothingLeftError, SourceMap
from triquad_tools.plots.mesh_sheet import Legend, save_mesh_sheet
from triquad_tools.plots.mesh_view import Picture, view_along
from triquad_tools.plots.plan import HEIGHTS, Scale


def export_picture(source: SourceMap, box: Box | None, cell_m: float | None, path: Path) -> str:
    """Save a picture of a map, or of its part in a box; return what it shows.

    Raises:
        InvalidInputError: the mesh is too large, or a library is missing.
        NothingLeftError: no surface was seen.
        OSError: it cannot be written.
    """
    bounds = None if box is None else (box[0].tolist(), box[1].tolist())
    with OfflineMap(source.record) as opened, progress("meshing", 1.0) as report:
        mesh = opened.mesh(bounds, cell_m, lambda done, of: report(done / of, f"{done} blocks"))
    if not len(mesh.faces):
        where = "" if box is None else " in the box of --crop"
        raise NothingLeftError(f"{path} is not written: no surface was seen{where}")
    when = f", {utc_time(source.stamp_ns)}" if source.stamp_ns else ""
    draw_mesh(f"map {source.record.name!r}, epoch {source.record.epoch}{when}", mesh, path)
    return f"a picture of {len(mesh.faces):,} faces"


def draw_mesh(title: str, mesh: Mesh, path: Path) -> None:
    """Save a picture of a mesh with faces, from a side that is chosen for it.

    Ceilings do not hide what is below them: faces that turn away are left out.

    Raises:
        OSError: it cannot be written.
    """
    used = mesh.vertices[np.unique(mesh.faces)]
    heights = HeightScale.around(used[:, 2])
    picture = Picture(view_along(used, mesh.vertices[mesh.faces]))
    picture.add_mesh(mesh.vertices, mesh.faces, heights.colours(mesh.vertices[:, 2]))
    least_m, most_m = float(used[:, 2].min()), float(used[:, 2].max())
    legend = Legend(
        title,
        Scale("height z in m", HEIGHTS, heights.low_m, heights.high_m),
        beyond=(least_m < heights.low_m, most_m > heights.high_m),
        notes=[f"{len(mesh.faces):,} faces, from z = {least_m:.2f} to {most_m:.2f} m"],
    )
    save_mesh_sheet(path, picture, legend)
