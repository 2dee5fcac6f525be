"""Previews in map files: a coarse mesh of each region for MCAP viewers, a ``foxglove.SceneUpdate``.

The schema is at https://docs.foxglove.dev/docs/sdk/schemas/scene-update. Nothing reads it back:
answers come from the field.
"""

import math
from contextlib import closing

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from triquad_format.mapfile.metadata import FRAME_ID
from triquad_format.mapfile.parts.part import PREVIEW, Part, PartKey
from triquad_format.mapfile.writer import Previews
from triquad_format.records.arrays import Doubles
from triquad_format.records.cells import same_cells
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region, seen_voxels

from triquad_map.composition.composed_view import ComposedView, RecordedView
from triquad_map.height_scale import HeightScale
from triquad_map.mesh.tile_mesh import TileLattice, mesh_tile
from triquad_map.triangles import TileJoin, Triangles

PARAMETERS_A_FACE = 130  # so that a preview takes some 4 % of a map file of fp16
FACES_MIN, FACES_MAX = 2_000, 100_000
"""The bounds of a region's most faces: one for ``PARAMETERS_A_FACE`` parameters of its field."""

CELL_LEAVES = 2
"""Side of the cells, in leaves: 0.4 m. Where that gives too many faces, vertices are merged."""

_LARGER = 1.1  # times that at least, each time
_TILE_CELLS = 32
_REACH_CELLS = 0.09  # centres of faces lie at most so far from voxels with seen surface

_STEPS_A_LEAF = 2
"""Positions are rounded to a power of two, finer than a leaf by this factor: zeros compress."""

_BANDS = 32
"""Different colours, at most: they compress, too."""


def preview_schema() -> bytes:
    """Return the schema as MCAP wants it: a ``FileDescriptorSet``, dependencies first."""
    files: dict[str, FileDescriptor] = {}

    def collect(file: FileDescriptor) -> None:
        for dependency in file.dependencies:
            collect(dependency)
        files.setdefault(file.name, file)

    collect(SceneUpdate.DESCRIPTOR.file)
    described = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(described.file.add())
    data: bytes = described.SerializeToString(deterministic=True)
    return data


def previews_of(record: MapRecord, view: ComposedView | None = None, stamp_ns: int = 0) -> Previews:
    """Return the previews of all regions of a map.

    Args:
        record: the map.
        view: what answers for it; None: it is opened for this.
        stamp_ns: time that viewers show, nanoseconds since 1970.
    """
    if view is None:
        with closing(RecordedView(record)) as opened:
            return previews_of(record, opened, stamp_ns)
    parts = {
        region.index: preview_part(record, region, view, stamp_ns=stamp_ns)
        for region in record.regions
    }
    return Previews(preview_schema(), parts)


def preview_part(record: MapRecord, region: Region, view: ComposedView, stamp_ns: int) -> Part:
    """Return the preview of one region of the map that ``view`` answers for."""
    mesh = coarse_mesh(region, record.settings, view)
    step_m = 2.0 ** math.floor(math.log2(record.settings.leaf_m / _STEPS_A_LEAF))
    vertices = np.round(mesh.vertices / step_m) * step_m
    heights_m = vertices[:, 2] + record.origin_m[2]
    scale = HeightScale.around(heights_m)
    update = SceneUpdate()
    entity = update.entities.add()
    entity.timestamp.FromNanoseconds(stamp_ns)
    entity.frame_id = FRAME_ID
    entity.id = "region {} {} {}".format(*region.index)
    for key, value in _words(scale).items():
        entity.metadata.add(key=key, value=value)
    triangles = entity.triangles.add()
    triangles.pose.orientation.w = 1.0
    if record.origin.any():
        position = triangles.pose.position
        position.x, position.y, position.z = record.origin_m
    for x, y, z in vertices.tolist():
        triangles.points.add(x=x, y=y, z=z)
    for red, green, blue in _colours(heights_m, scale).tolist():
        triangles.colors.add(r=red, g=green, b=blue, a=1.0)
    triangles.indices.extend(mesh.faces.ravel().tolist())
    payload: bytes = update.SerializeToString(deterministic=True)
    return Part(PartKey(PREVIEW, region.index), payload)


def coarse_mesh(region: Region, settings: FieldSettings, view: ComposedView) -> Triangles:
    """Return the surface of a region in few faces: vertices that lie together become their mean.

    Faces on the border between two regions are of the one in which their middle lies.
    """
    faces_max = min(max(region.parameters // PARAMETERS_A_FACE, FACES_MIN), FACES_MAX)
    cell_m = CELL_LEAVES * settings.leaf_m
    mesh = detailed = _mesh_of_cells(cell_m, region, settings, view)
    while len(mesh.faces) > faces_max:
        cell_m *= max(_LARGER, math.sqrt(len(mesh.faces) / faces_max))
        mesh = _merged(detailed, cell_m)
    return mesh


def _merged(mesh: Triangles, cell_m: float) -> Triangles:
    """Return the mesh with one vertex, their mean, for all in a cube of side ``cell_m``."""
    cells = np.floor(mesh.vertices / cell_m).astype(np.int64)
    of_vertex = same_cells(cells)[1]
    counts = np.bincount(of_vertex)
    sums = [np.bincount(of_vertex, weights=axis) for axis in mesh.vertices.T]
    faces = of_vertex[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # with three corners
    first = same_cells(np.sort(faces, axis=1))[0]
    kept, corners = np.unique(faces[first], return_inverse=True)
    vertices = (np.stack(sums, axis=1) / counts[:, None])[kept]
    return Triangles(vertices, corners.reshape(-1, 3).astype(np.int32))


def _mesh_of_cells(
    cell_m: float, region: Region, settings: FieldSettings, view: ComposedView
) -> Triangles:
    lattice = TileLattice(cell_m, _TILE_CELLS, reach_m=_REACH_CELLS * cell_m)
    middle, half_m = settings.region_centre(region.index), settings.region_pitch_m / 2
    join = TileJoin(lattice.tile_side_m, (middle - half_m, middle + half_m))
    seen = seen_voxels(region.evidence, region.evidence.surface) * settings.leaf_m
    low = settings.region_corner(region.index) + seen
    for x, y, z in lattice.tiles_meeting(low, low + settings.leaf_m, lattice.reach_m).tolist():
        join.add(mesh_tile(view, (x, y, z), lattice).triangles)
    return join.mesh()


def _colours(heights_m: Doubles, scale: HeightScale) -> Doubles:
    """Return colours [N, 3], sRGB in [0, 1], of heights [N], few of them different."""
    band_m = (scale.high_m - scale.low_m) / _BANDS
    return scale.colours(scale.low_m + np.round((heights_m - scale.low_m) / band_m) * band_m)


def _words(scale: HeightScale) -> dict[str, str]:
    """Return the text that a viewer shows for a click on the mesh."""
    return {
        "shows": "surface that rays have seen, coarsely: to look at, not to measure",
        "axes": "metres, z up",
        "colours": f"height, from {scale.low_m:.1f} m (blue) to {scale.high_m:.1f} m (yellow)",
    }
