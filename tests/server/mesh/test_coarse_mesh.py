"""The mesh of previews: the surface of the map in few faces, without holes of its own."""

import dataclasses
import io
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from support.map_records import random_record, surface_evidence
from support.small_world import settings, settled_mapper, world
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_format.records.field_settings import FieldSettings
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.coarse_mesh import FACES_MIN, coarse_mesh
from triquad_server.mesh.preview import previews_of
from triquad_tools.evaluation.metrics import mesh_area_m2, sample_mesh

USUAL = FieldSettings()
SAMPLES = 200_000

Sdf = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def mesh_of_seen(seen: NDArray[np.float64], sdf: Sdf) -> Mesh:
    """The coarse mesh of a field where points [N, 3] of its surface have been seen."""
    (region,) = random_record(1, settings=USUAL, points=10).regions
    region = dataclasses.replace(region, evidence=surface_evidence(seen, USUAL))
    return Mesh(*coarse_mesh(region, USUAL, sdf))


def samples(mesh: Mesh) -> NDArray[np.float64]:
    return sample_mesh(mesh, SAMPLES, np.random.default_rng(0))


def share_near(points: NDArray[np.float64], others: NDArray[np.float64], reach_m: float) -> float:
    return float((cKDTree(others).query(points)[0] < reach_m).mean())


def largest_piece(mesh: Mesh) -> float:
    """The share of the area of a mesh that its largest connected part has."""
    a, b, c = mesh.faces.T
    links = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), (len(mesh.vertices),) * 2)
    piece = connected_components(links, directed=False)[1][a]
    areas = [mesh_area_m2(Mesh(mesh.vertices, mesh.faces[piece == p])) for p in np.unique(piece)]
    return max(areas) / sum(areas)


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    field = dataclasses.replace(settings().field, depth=10)  # one region, as streets have
    chosen = settings().model_copy(update={"field": field})
    return settled_mapper(chosen, world(10)).publish()


def area_m2(x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.float64]:
    """Points [N, 3] all over a rectangle at height 0."""
    over = np.stack(np.meshgrid(np.arange(*x, 0.1), np.arange(*y, 0.1)), axis=-1).reshape(-1, 2)
    return np.column_stack([over, np.zeros(len(over))])


def test_the_preview_of_a_street_is_its_mesh_in_few_faces(epoch: Epoch) -> None:
    """As complete as the coarsest level of detail, which lies on cells of the same side."""
    record = epoch.record()
    (region,) = record.regions
    coarse = Mesh(*coarse_mesh(region, record.settings, epoch.distances))
    with OfflineMap(record) as offline:
        detailed = offline.mesh(cell_m=0.4)
    assert 0 < 5 * len(coarse.faces) < len(detailed.faces)
    shown, wanted = samples(coarse), samples(detailed)
    assert share_near(wanted, shown, 0.2) > 0.75  # without the lidar's rings on far ground
    assert share_near(shown, wanted, 0.4) > 0.95
    assert largest_piece(coarse) > largest_piece(detailed)


def test_surface_is_found_in_the_cell_beside_the_voxel_that_was_hit() -> None:
    """Noise, and the field, put it on either side of a border of cells."""
    mesh = mesh_of_seen(area_m2((-10, 10), (-10, 10)) + 0.01, lambda points: points[:, 2] + 0.01)
    assert mesh_area_m2(mesh) == pytest.approx(20**2, rel=0.1)
    np.testing.assert_allclose(mesh.vertices[:, 2], -0.01, atol=1e-6)


def test_both_sides_of_a_thin_wall_stay() -> None:
    half_m = 0.25
    wall = area_m2((-10, 10), (0, 5))[:, [0, 2, 1]]
    sides = np.concatenate([wall + [0, half_m, 0], wall - [0, half_m, 0]])
    mesh = mesh_of_seen(sides, lambda points: np.abs(points[:, 1]) - half_m)
    np.testing.assert_allclose(np.abs(mesh.vertices[:, 1]), half_m, atol=1e-6)
    assert mesh_area_m2(mesh) == pytest.approx(2 * 20 * 5, rel=0.15)


def test_single_rings_are_left_out_beside_solid_ground_but_not_alone() -> None:
    rings = [area_m2((12 + 2 * ring, 12.1 + 2 * ring), (-10, 10)) for ring in range(3)]
    alone = mesh_of_seen(np.concatenate(rings), lambda points: points[:, 2] - 0.05)
    assert alone.vertices[:, 0].max() > 15
    solid = area_m2((-10, 10), (-10, 10))
    together = mesh_of_seen(np.concatenate([solid, *rings]), lambda points: points[:, 2] - 0.05)
    assert mesh_area_m2(together) == pytest.approx(20**2, rel=0.1)
    assert together.vertices[:, 0].max() < 11


def test_a_preview_is_a_small_part_of_its_map(epoch: Epoch) -> None:
    record = epoch.record()
    with_preview, without = io.BytesIO(), io.BytesIO()
    previews = previews_of(record, distances=epoch.distances)
    size = write_map(record, with_preview, previews=previews).bytes
    assert write_map(record, without).bytes < size < 1.04 * write_map(record, without).bytes


def test_a_preview_is_bounded_however_much_was_seen() -> None:
    def bumps(points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = points.T
        return z - 0.3 * np.sin(3 * x) * np.sin(3 * y)

    seen = np.concatenate([area_m2((-75, 75), (-75, 75)) + [0, 0, z] for z in (-0.2, 0, 0.2)])
    mesh = mesh_of_seen(seen, bumps)
    assert FACES_MIN / 10 < len(mesh.faces) <= FACES_MIN  # of a field of few parameters
    assert share_near(area_m2((-70, 70), (-70, 70))[::50], samples(mesh), 5.0) == 1.0
