"""Previews in map files: a coarse mesh of each region for MCAP viewers, a ``foxglove.SceneUpdate``.

The schema is at https://docs.foxglove.dev/docs/sdk/schemas/scene-update. Nothing reads it back:
answers come from the field.
"""

import math

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from triquad_format.mapfile.metadata import FRAME_ID
from triquad_format.mapfile.parts.part import PREVIEW, Part, PartKey
from triquad_format.mapfile.writer import Previews
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region
from triquad_map.height_scale import HeightScale
from triquad_map.reference.evaluator import MapEvaluator

from triquad_server.mesh.coarse_mesh import coarse_mesh
from triquad_server.mesh.surface_net import Distances

_STEPS_A_LEAF = 2
"""Positions are rounded to a power of two, finer than a leaf by so much: zeros compress."""

_BANDS = 32
"""Different colours, at most: they compress, too."""


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
    step_m = 2.0 ** math.floor(math.log2(settings.leaf_m / _STEPS_A_LEAF))
    scale = HeightScale.around(vertices[:, 2])
    update = SceneUpdate()
    entity = update.entities.add()
    entity.timestamp.FromNanoseconds(stamp_ns)
    entity.frame_id = FRAME_ID
    entity.id = "region {} {} {}".format(*region.index)
    for key, value in _words(scale).items():
        entity.metadata.add(key=key, value=value)
    triangles = entity.triangles.add()
    triangles.pose.orientation.w = 1.0
    for x, y, z in (np.round(vertices / step_m) * step_m).tolist():
        triangles.points.add(x=x, y=y, z=z)
    for red, green, blue in _colours(vertices[:, 2], scale).tolist():
        triangles.colors.add(r=red, g=green, b=blue, a=1.0)
    triangles.indices.extend(faces.ravel().tolist())
    payload: bytes = update.SerializeToString(deterministic=True)
    return Part(PartKey(PREVIEW, region.index), payload)


def _colours(heights_m: Doubles, scale: HeightScale) -> Doubles:
    """Colours [N, 3], sRGB in [0, 1], of heights [N], few of them different."""
    band_m = (scale.high_m - scale.low_m) / _BANDS
    return scale.colours(scale.low_m + np.round((heights_m - scale.low_m) / band_m) * band_m)


def _words(scale: HeightScale) -> dict[str, str]:
    """What a viewer tells who clicks on the mesh."""
    return {
        "shows": "surface that rays have seen, coarsely: to look at, not to measure",
        "axes": "metres, z up",
        "colours": f"height, from {scale.low_m:.1f} m (blue) to {scale.high_m:.1f} m (yellow)",
    }
