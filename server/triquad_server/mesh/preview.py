"""Previews in map files: a coarse mesh of each region for MCAP viewers, a ``foxglove.SceneUpdate``.

The schema is at https://docs.foxglove.dev/docs/sdk/schemas/scene-update. Nothing reads it back:
answers come from the field.
"""

from collections.abc import Callable

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from numpy.typing import NDArray
from triquad_format.mapfile.metadata import FRAME_ID
from triquad_format.mapfile.parts.part import PREVIEW, Part, PartKey
from triquad_format.mapfile.writer import Previews
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region, seen_voxels
from triquad_map.reference.evaluator import MapEvaluator

_STEP_M = 2.0**-5
"""Positions are rounded to 3 cm: zeros compress."""

_COLOUR = (0.62, 0.66, 0.72, 1.0)

NET_LEAVES = 2
"""Side of the cells in which the surface is searched for, in leaves: 0.4 m."""

CLUSTER_CELLS = 3
"""Side of the cubes of cells whose vertices become one: 1.2 m."""

_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_EDGES = [(corner, corner | bit) for corner in range(8) for bit in (1, 2, 4) if not corner & bit]
"""The two corners of each edge, as rows of ``_CORNERS``."""

Distances = Callable[[Doubles], NDArray[np.floating]]
"""Signed distances [N] at points [N, 3] of the map frame."""


def preview_schema() -> bytes:
    """The schema as MCAP wants it: a ``FileDescriptorSet``, dependencies first."""
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


def previews_of(
    record: MapRecord, *, distances: Distances | None = None, stamp_ns: int | None = None
) -> Previews:
    """The previews of all regions of a map.

    Args:
        record: the map.
        distances: a faster way to the map's signed distances than numpy.
        stamp_ns: time that viewers show, nanoseconds since 1970.
    """
    shown = distances or MapEvaluator(record).distances
    parts = {
        region.index: preview_part(region, record.settings, shown, stamp_ns=stamp_ns or 0)
        for region in record.regions
    }
    return Previews(preview_schema(), parts)


def preview_part(
    region: Region, settings: FieldSettings, distances: Distances, stamp_ns: int
) -> Part:
    """The preview of one region."""
    vertices, faces = coarse_mesh(region, settings, distances)
    update = SceneUpdate()
    entity = update.entities.add()
    entity.timestamp.FromNanoseconds(stamp_ns)
    entity.frame_id = FRAME_ID
    entity.id = "region {} {} {}".format(*region.index)
    triangles = entity.triangles.add()
    triangles.pose.orientation.w = 1.0
    triangles.color.r, triangles.color.g, triangles.color.b, triangles.color.a = _COLOUR
    for x, y, z in (np.round(vertices / _STEP_M) * _STEP_M).tolist():
        triangles.points.add(x=x, y=y, z=z)
    triangles.indices.extend(faces.ravel().tolist())
    payload: bytes = update.SerializeToString(deterministic=True)
    return Part(PartKey(PREVIEW, region.index), payload)


def coarse_mesh(
    region: Region, settings: FieldSettings, distances: Distances
) -> tuple[Doubles, Longs]:
    """Vertices [V, 3], metres, map frame, and faces [F, 3], counter-clockwise from free space.

    The method is surface nets (Gibson 1998), with vertices clustered: some thousand faces a region.
    """
    # By codes: numpy holds Python's lock while it sorts rows.
    seen = morton.encode(seen_voxels(region.evidence, region.evidence.surface) // NET_LEAVES)
    cells = morton.decode(np.unique(seen), 3)
    side_m = settings.leaf_m * NET_LEAVES
    origin = settings.region_corner(region.index)
    corners = morton.encode(cells[:, None] + _CORNERS)  # [C, 8]
    codes, where = np.unique(corners, return_inverse=True)
    values = distances(morton.decode(codes, 3) * side_m + origin)
    values = values[where.reshape(corners.shape)]
    known = np.isfinite(values).all(axis=1)  # not so where a cell reaches out of all regions
    cells, values = cells[known], values[known]
    crossed, points = _crossings(cells, np.asarray(values, np.float64))
    clusters, cluster = np.unique(
        morton.encode(cells[crossed] // CLUSTER_CELLS), return_inverse=True
    )
    counts = np.bincount(cluster, minlength=len(clusters))
    sums = [np.bincount(cluster, points[:, axis], len(clusters)) for axis in range(3)]
    vertices = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
    faces = cluster[_quads(cells[crossed], values[crossed])]
    faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    vertices, faces = _without_repeats(vertices, faces)
    return vertices * side_m + origin, faces


def _crossings(cells: Longs, values: Doubles) -> tuple[NDArray[np.intp], Doubles]:
    """Cells that the surface crosses, and the mean [K, 3] of where it crosses their edges."""
    total = np.zeros((len(cells), 3))
    count = np.zeros(len(cells))
    for a, b in _EDGES:
        low, high = values[:, a], values[:, b]
        rows = np.flatnonzero((low > 0) != (high > 0))
        share = (low[rows] / (low[rows] - high[rows]))[:, None]
        total[rows] += cells[rows] + _CORNERS[a] + share * (_CORNERS[b] - _CORNERS[a])
        count[rows] += 1
    crossed = np.flatnonzero(count)
    return crossed, total[crossed] / count[crossed, None]


def _quads(cells: Longs, values: NDArray[np.floating]) -> NDArray[np.intp]:
    """The four cells around each crossed edge, counter-clockwise seen from free space."""
    codes = morton.encode(cells)
    order = np.argsort(codes)
    quads = [np.zeros((0, 4), np.intp)]
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        inside = values[:, 0] > 0, values[:, 4 >> axis] > 0
        rows = np.flatnonzero((inside[0] != inside[1]) & (cells.min(axis=1) > 0))
        around = np.stack([cells[rows], cells[rows] - u, cells[rows] - u - v, cells[rows] - v], 1)
        wanted = morton.encode(around)
        found = np.minimum(np.searchsorted(codes[order], wanted), max(len(codes) - 1, 0))
        there = (codes[order][found] == wanted).all(axis=1)
        quad = order[found][there]
        backwards = inside[0][rows][there]
        quads.append(np.where(backwards[:, None], quad[:, ::-1], quad))
    return np.concatenate(quads)


def _without_repeats(vertices: Doubles, faces: NDArray[np.intp]) -> tuple[Doubles, Longs]:
    """The mesh without degenerate and double faces, and without vertices that no face uses."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    low, middle, high = np.sort(faces, axis=1).T
    count = len(vertices)
    _, first = np.unique((low * count + middle) * count + high, return_index=True)
    faces = faces[np.sort(first)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int64)
