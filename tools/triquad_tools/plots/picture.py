"""A picture of a whole mesh, seen aslant from above."""

from pathlib import Path

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.metadata import utc_time
from triquad_map.height_scale import HEIGHT_STOPS, HeightScale

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box, NothingLeftError, SourceMap
from triquad_tools.plots.camera import Camera, ParallelCamera
from triquad_tools.plots.framing import Framing, framed
from triquad_tools.plots.mesh_sheet import HEIGHT, WIDTH, ColourBar, Legend, save_mesh_sheet
from triquad_tools.plots.render import facing, render_mesh


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
    draw_mesh(f"map {record.name!r}, epoch {record.epoch}{when}", mesh, path)
    return f"a picture of {len(mesh.faces):,} faces"


def draw_mesh(title: str, mesh: Mesh, path: Path) -> None:
    """Save a picture of a mesh with faces, coloured by height, by a camera that is chosen for it.

    Ceilings do not hide what is below them: faces that turn away from the camera are left out.

    Raises:
        OSError: it cannot be written.
    """
    view = framed(mesh, WIDTH / HEIGHT)
    shown = Mesh(mesh.vertices, mesh.faces[facing(mesh.vertices[mesh.faces], view.camera)])
    draw_view(title, shown, view.camera, notes=notes_of(view), path=path)


def draw_view(title: str, mesh: Mesh, camera: Camera, notes: list[str], path: Path) -> None:
    """Save a picture of a mesh, coloured by height, as a camera sees it.

    Raises:
        OSError: it cannot be written.
    """
    heights_m = mesh.vertices[np.unique(mesh.faces), 2]
    scale = HeightScale.around(heights_m)
    colours = scale.colours(mesh.vertices[:, 2])
    image = render_mesh(mesh.vertices, mesh.faces, colours, camera, width=WIDTH, height=HEIGHT)
    ends = {"least": float(heights_m.min()), "most": float(heights_m.max())}
    bar = ColourBar("height z in m", "m", HEIGHT_STOPS, scale.low_m, scale.high_m, **ends)
    flat = camera if isinstance(camera, ParallelCamera) else None
    save_mesh_sheet(path, image, Legend(title, bar, notes, flat))


def notes_of(view: Framing) -> list[str]:
    """What the picture of a mesh leaves out."""
    notes = [
        f"looking to {view.looks_to} and down, in parallel projection; faces seen from behind, "
        "such as ceilings, are left out"
    ]
    if view.outside_share > 0.0:
        share = f"{100.0 * view.outside_share:.2g} % of the surface"
        notes.append(
            f"outside of the picture: {share}, up to {view.farthest_m:.3g} m from its middle"
        )
    return notes
