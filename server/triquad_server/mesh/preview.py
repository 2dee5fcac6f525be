"""Previews in map files: a coarse mesh of each region for MCAP viewers, a ``foxglove.SceneUpdate``.

The schema is at https://docs.foxglove.dev/docs/sdk/schemas/scene-update. Nothing reads it back:
answers come from the field.
"""

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from triquad_format.mapfile.metadata import FRAME_ID
from triquad_format.mapfile.parts.part import PREVIEW, Part, PartKey
from triquad_format.mapfile.writer import Previews
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region
from triquad_map.reference.evaluator import MapEvaluator

from triquad_server.mesh.coarse_mesh import Distances, coarse_mesh

_STEP_M = 2.0**-5
"""Positions are rounded to 3 cm: zeros compress."""

_COLOUR = (0.62, 0.66, 0.72, 1.0)


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
    shown = distances or _distances_of(record)
    parts = {
        region.index: preview_part(region, record.settings, shown, stamp_ns or 0)
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


def _distances_of(record: MapRecord) -> Distances:
    evaluator = MapEvaluator(record)
    return lambda points: evaluator.query(points).sdf
