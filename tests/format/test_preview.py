"""The mesh that MCAP viewers show, read back as they read it."""

import dataclasses
import io
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from support.map_records import SMALL, evidence_of, random_record, surface_evidence
from support.mapfile_edit import file_bytes, parts_of, read_bytes, rewritten
from triquad_format.errors import DamagedMapFileError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import BLOCK_BYTES, Evidence, MapRecord
from triquad_map.height_scale import HeightScale
from triquad_server.mesh.coarse_mesh import CLUSTER_LEVELS
from triquad_server.mesh.surface_net import NET_LEAVES

SETTINGS = FieldSettings()
GROUND_M = 1.3


def ground(points: Doubles) -> Doubles:
    """Signed distance to a level ground."""
    return points[:, 2] - GROUND_M


def seen_ground(record: MapRecord) -> MapRecord:
    """The record with evidence of the ground in a square of 40 m around each region's centre."""
    return dataclasses.replace(
        record,
        regions=tuple(
            dataclasses.replace(region, evidence=of_ground(record.settings))
            for region in record.regions
        ),
    )


def of_ground(settings: FieldSettings) -> Evidence:
    side = np.arange(-20, 20, settings.leaf_m)
    x, y = np.meshgrid(side, side)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_M)], axis=1)
    return surface_evidence(points, settings)


def scenes(data: bytes) -> list[tuple[str, Any]]:
    """The scene updates of a file by the stock reader and decoder."""
    reader = make_reader(io.BytesIO(data), decoder_factories=[DecoderFactory()])
    messages = reader.iter_decoded_messages(topics=["/preview/mesh"])
    return [(schema.name, scene) for schema, _, _, scene in messages if schema is not None]


def mesh_of(scene: Any) -> tuple[Doubles, Longs]:
    """Vertices [V, 3] and faces [F, 3] of the one entity in a scene."""
    (entity,) = scene.entities
    (triangles,) = entity.triangles
    vertices = np.array([(p.x, p.y, p.z) for p in triangles.points]).reshape(-1, 3)
    return vertices, np.array(triangles.indices).reshape(-1, 3)


@pytest.fixture(scope="module")
def ground_file() -> bytes:
    indices = ((0, 0, 0), (1, 0, 0))
    record = seen_ground(random_record(60, settings=SETTINGS, indices=indices, points=50))
    return file_bytes(record, preview=True, distances=ground, stamp_ns=1_700_000_000_000_000_005)


def test_viewers_see_the_surface(ground_file: bytes) -> None:
    cell = SETTINGS.leaf_m * NET_LEAVES * 2**CLUSTER_LEVELS
    found = scenes(ground_file)
    assert len(found) == 2
    for (name, scene), x in zip(found, (0.0, SETTINGS.region_pitch_m), strict=True):
        assert name == "foxglove.SceneUpdate"
        vertices, faces = mesh_of(scene)
        assert 200 < len(faces) < 1000  # few where all is flat
        assert faces.max() < len(vertices)
        np.testing.assert_allclose(vertices[:, 2], GROUND_M, atol=0.04)
        extent = np.abs(vertices[:, :2] - (x, 0)).max(axis=0)
        assert (extent > 20 - 2 * cell).all()
        assert (extent < 20 + cell).all()
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        assert (normals[:, 2] > 0).all()  # towards free space
        assert normals[:, 2].sum() / 2 > 0.95 * 40**2  # its area: no holes


def test_each_entity_tells_region_frame_and_time(ground_file: bytes) -> None:
    entities = [entity for _, scene in scenes(ground_file) for entity in scene.entities]
    assert [entity.id for entity in entities] == ["region 0 0 0", "region 1 0 0"]
    for entity in entities:
        assert entity.frame_id == "map"
        assert entity.timestamp.ToNanoseconds() == 1_700_000_000_000_000_005
        words = {pair.key: pair.value for pair in entity.metadata}
        assert words["axes"] == "metres, z up"
        assert words["colours"] == "height, from 1.3 m (blue) to 1.4 m (yellow)"


def test_colours_tell_the_height() -> None:
    def slope(points: Doubles) -> Doubles:
        return points[:, 2] - (GROUND_M + 0.1 * points[:, 0])

    record = random_record(65, settings=SETTINGS, points=50)
    x, y = np.random.default_rng(0).uniform(-20, 20, (2, 100_000))
    seen = surface_evidence(np.stack([x, y, GROUND_M + 0.1 * x], axis=1), SETTINGS)
    region = dataclasses.replace(record.regions[0], evidence=seen)
    record = dataclasses.replace(record, regions=(region,))
    ((_, scene),) = scenes(file_bytes(record, preview=True, distances=slope))
    vertices, _ = mesh_of(scene)
    shown = scene.entities[0].triangles[0].colors
    colours = np.array([(colour.r, colour.g, colour.b) for colour in shown])
    assert {colour.a for colour in shown} == {1.0}
    exact = HeightScale.around(vertices[:, 2]).colours(vertices[:, 2])
    assert np.abs(colours - exact).max() < 0.04  # a step of the colours, and rounding
    assert len(np.unique(colours, axis=0)) > 12


def test_schema_is_complete() -> None:
    """A viewer that knows no schema by heart can decode it: dependencies are in the file."""
    reader = make_reader(io.BytesIO(file_bytes(random_record(61), preview=True)))
    summary = reader.get_summary()
    assert summary is not None
    (schema,) = summary.schemas.values()
    assert (schema.name, schema.encoding) == ("foxglove.SceneUpdate", "protobuf")
    assert b"foxglove/TriangleListPrimitive.proto" in schema.data
    assert b"google/protobuf/timestamp.proto" in schema.data


def test_the_field_of_the_map_is_shown_where_no_other_is_given() -> None:
    """Also at the border of all regions, where cells reach to where the field says nothing."""
    record = random_record(62, points=400, training=False)
    full = np.full((8**3, BLOCK_BYTES), 255, np.uint8)
    seen = evidence_of(np.arange(8**3), full, full)
    everywhere = dataclasses.replace(record.regions[0], evidence=seen)
    record = dataclasses.replace(record, regions=(everywhere,))
    ((_, scene),) = scenes(file_bytes(record, preview=True))
    vertices, faces = mesh_of(scene)
    assert len(faces)
    assert np.isfinite(vertices).all()
    assert (np.abs(vertices) <= SMALL.region_side_m / 2).all()


def test_nothing_seen_is_an_empty_mesh() -> None:
    ((_, scene),) = scenes(file_bytes(random_record(64, points=0), preview=True))
    vertices, faces = mesh_of(scene)
    assert len(vertices) == len(faces) == 0


def test_readers_mind_a_preview_that_is_not_the_listed_one(ground_file: bytes) -> None:
    payloads = {
        number: part.payload + b" "
        for number, part in enumerate(parts_of(ground_file))
        if part.topic == "/preview/mesh"
    }
    with pytest.raises(DamagedMapFileError, match="preview"):
        read_bytes(rewritten(ground_file, payloads=payloads, fitting=False))
