"""The mesh that MCAP viewers show: the surface of the map in few faces, read back as they do."""

import dataclasses
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from support.files.mapfile_edit import file_bytes
from support.maps.map_records import (
    SMALL,
    evidence_of,
    random_record,
    surface_evidence,
    with_region,
)
from support.maps.small_world import settings, settled_mapper, world
from trimesh import Trimesh
from trimesh.sample import sample_surface
from triquad_client import OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import BLOCK_BYTES, Evidence, MapRecord
from triquad_map.composition.composed_view import RecordedView
from triquad_map.field.frozen_field import in_grid
from triquad_map.height_scale import HeightScale
from triquad_map.preview import CELL_LEAVES, FACES_MIN, coarse_mesh, previews_of

SETTINGS = FieldSettings()
GROUND_M = 1.3


def ground(points: Doubles) -> Doubles:
    """Signed distance to a level ground."""
    return points[:, 2] - GROUND_M


class OtherField(RecordedView):
    """Meshes of it show the surface of ``sdf`` where rays of the record ended."""

    def __init__(self, record: MapRecord, sdf: Callable[[Doubles], Doubles]) -> None:
        super().__init__(record)
        self._sdf = sdf

    def distances_in_grid(self, axes: Doubles, points: Longs) -> NDArray[np.float32]:
        return self._sdf(in_grid(axes, points)).astype(np.float32)


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
    return file_bytes(
        record, preview=True, view=OtherField(record, ground), stamp_ns=1_700_000_000_000_000_005
    )


def test_viewers_see_the_surface(ground_file: bytes) -> None:
    cell = 4 * SETTINGS.leaf_m * CELL_LEAVES
    found = scenes(ground_file)
    assert len(found) == 2
    for (name, scene), x in zip(found, (0.0, SETTINGS.region_pitch_m), strict=True):
        assert name == "foxglove.SceneUpdate"
        vertices, faces = mesh_of(scene)
        assert 200 < len(faces) <= FACES_MIN
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
    record = with_region(record, evidence=seen)
    ((_, scene),) = scenes(file_bytes(record, preview=True, view=OtherField(record, slope)))
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
    """Also at the border of all regions."""
    record = random_record(42, points=400, training=False)
    full = np.full((8**3, BLOCK_BYTES), 255, np.uint8)
    seen = evidence_of(np.arange(8**3), full, full)
    record = with_region(record, evidence=seen)
    ((_, scene),) = scenes(file_bytes(record, preview=True))
    vertices, faces = mesh_of(scene)
    assert len(faces)
    assert np.isfinite(vertices).all()
    assert (np.abs(vertices) <= SMALL.region_side_m / 2).all()


def test_nothing_seen_is_an_empty_mesh() -> None:
    ((_, scene),) = scenes(file_bytes(random_record(64, points=0), preview=True))
    vertices, faces = mesh_of(scene)
    assert len(vertices) == len(faces) == 0


def mesh_of_seen(seen, sdf):
    """The coarse mesh of a field where points [N, 3] of its surface have been seen."""
    record = random_record(1, settings=SETTINGS, points=10)
    record = with_region(record, evidence=surface_evidence(seen, SETTINGS))
    return coarse_mesh(record.regions[0], SETTINGS, OtherField(record, sdf))


def surface(mesh):
    return Trimesh(mesh.vertices, mesh.faces, process=False)


def samples(mesh):
    return sample_surface(surface(mesh), 200_000, seed=0)[0]


def share_near(points, others, reach_m):
    return float((cKDTree(others).query(points)[0] < reach_m).mean())


def largest_piece(mesh):
    """The share of the area of a mesh that its largest connected part has."""
    a, b, c = mesh.faces.T
    links = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), (len(mesh.vertices),) * 2)
    piece = connected_components(links, directed=False)[1][a]
    areas = np.bincount(piece, surface(mesh).area_faces)
    return areas.max() / areas.sum()


@pytest.fixture(scope="module")
def epoch():
    field = dataclasses.replace(settings().field, depth=10)  # one region, as streets have
    chosen = settings(samples_per_ray=9.0).model_copy(update={"field": field})
    return settled_mapper(chosen, world(10)).publish()


def area_m2(x, y, step_m=0.1):
    """Points [N, 3] all over a rectangle at height 0."""
    axes = np.arange(*x, step_m), np.arange(*y, step_m)
    over = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return np.column_stack([over, np.zeros(len(over))])


def test_the_preview_of_a_street_is_its_mesh_in_few_faces(epoch):
    record = epoch.record()
    (region,) = record.regions
    coarse = coarse_mesh(region, record.settings, epoch)
    with OfflineMap(record) as offline:
        detailed = offline.mesh(cell_m=0.4)
    assert 0 < 5 * len(coarse.faces) < len(detailed.faces)
    shown, wanted = samples(coarse), samples(detailed)
    assert share_near(wanted, shown, 0.2) > 0.75
    assert share_near(shown, wanted, 0.4) > 0.95
    assert largest_piece(coarse) > largest_piece(detailed) - 0.02


def test_surface_is_found_in_the_cell_beside_the_voxel_that_was_hit():
    """Noise, and the field, put it on either side of a border of cells."""
    mesh = mesh_of_seen(area_m2((-10, 10), (-10, 10)) + 0.01, lambda points: points[:, 2] + 0.01)
    assert surface(mesh).area == pytest.approx(20**2, rel=0.1)
    np.testing.assert_allclose(mesh.vertices[:, 2], -0.01, atol=1e-6)


def test_both_sides_of_a_thin_wall_stay():
    half_m = 0.25
    wall = area_m2((-10, 10), (0, 5))[:, [0, 2, 1]]
    sides = np.concatenate([wall + [0, half_m, 0], wall - [0, half_m, 0]])
    mesh = mesh_of_seen(sides, lambda points: np.abs(points[:, 1]) - half_m)
    np.testing.assert_allclose(np.abs(mesh.vertices[:, 1]), half_m, atol=1e-6)
    assert surface(mesh).area == pytest.approx(2 * 20 * 5, rel=0.15)


def test_a_preview_is_a_small_part_of_its_map(epoch):
    record = epoch.record()
    with_preview, without = io.BytesIO(), io.BytesIO()
    previews = previews_of(record, epoch)
    size = write_map(record, with_preview, previews=previews).bytes
    assert write_map(record, without).bytes < size < 1.04 * write_map(record, without).bytes


def test_a_preview_is_bounded_however_much_was_seen():
    def bumps(points):
        x, y, z = points.T
        return z - 0.3 * np.sin(3 * x) * np.sin(3 * y)

    over = area_m2((-75, 75), (-75, 75), SETTINGS.leaf_m)
    seen = np.concatenate([over + [0, 0, z] for z in (-0.2, 0, 0.2)])
    mesh = mesh_of_seen(seen, bumps)
    assert FACES_MIN / 10 < len(mesh.faces) <= FACES_MIN  # of a field of few parameters
    assert share_near(area_m2((-70, 70), (-70, 70), 0.7), samples(mesh), 5.0) == 1.0
