"""A picture of a whole mesh, seen aslant from above."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.metadata import utc_time
from triquad_map.height_scale import HEIGHT_STOPS, HeightScale

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box, NothingLeftError, SourceMap
from triquad_tools.plots.camera import Camera
from triquad_tools.plots.framing import Framing, framed
from triquad_tools.plots.mesh_sheet import (
    HEIGHT,
    WIDTH,
    ColourBar,
    Heading,
    Legend,
    save_mesh_sheet,
)
from triquad_tools.plots.render import facing, render_mesh

DIRECTION_NOTE = (
    "looking to {} and down, in parallel projection; faces seen from behind (ceilings) are left out"
)


def export_picture(source: SourceMap, box: Box | None, cell_m: float | None, path: Path) -> str:
    """Save a picture of a map, or of what of it lies in a box; returns what it shows.

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
    record, stamp_ns = source.record, source.stamp_ns
    when = f", {utc_time(stamp_ns)}" if stamp_ns else ""
    summary = f"{len(mesh.faces):,} faces"
    draw_mesh(Heading(f"map {record.name!r}, epoch {record.epoch}{when}", summary), mesh, path)
    return f"a picture of {summary}"


def draw_mesh(heading: Heading, mesh: Mesh, path: Path) -> None:
    """Save a picture of a mesh with faces, coloured by height, by a camera that is chosen for it.

    Ceilings do not hide what is below them: faces that turn away from the camera are left out.

    Raises:
        OSError: it cannot be written.
    """
    view = framed(mesh, WIDTH / HEIGHT)
    shown = Mesh(mesh.vertices, mesh.faces[facing(mesh.vertices[mesh.faces], view.camera)])
    notes = [DIRECTION_NOTE.format(view.looks_to), *outside_notes(view)]
    draw_view(heading, shown, view.camera, notes=notes, path=path)


def draw_view(
    heading: Heading, mesh: Mesh, camera: Camera, notes: Sequence[str], path: Path
) -> None:
    """Save a picture of a mesh, coloured by height, as a camera sees it.

    Raises:
        OSError: it cannot be written.
    """
    heights_m = mesh.vertices[np.unique(mesh.faces), 2]
    scale = HeightScale.around(heights_m)
    colours = scale.colours(mesh.vertices[:, 2])
    image = render_mesh(
        mesh.vertices, mesh.faces, colours, camera=camera, width=WIDTH, height=HEIGHT
    )
    least_m, most_m = float(heights_m.min()), float(heights_m.max())
    bar = ColourBar(
        "height z in m",
        HEIGHT_STOPS,
        low=scale.low_m,
        high=scale.high_m,
        above=f"up to {most_m:.2g} m" if most_m > scale.high_m else "",
        below=f"down to {least_m:.2g} m" if least_m < scale.low_m else "",
    )
    save_mesh_sheet(path, image, Legend(heading, bar, notes, camera=camera))


def outside_notes(view: Framing) -> list[str]:
    """What of a mesh lies outside of its picture, if anything does."""
    if not view.outside_share:
        return []
    share = f"{100.0 * view.outside_share:.2g} % of the faces"
    return [f"beyond the edges: {share}, up to {view.farthest_m:.3g} m from the picture's middle"]
