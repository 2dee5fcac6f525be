"""Meshes of map files, without a server."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.maps.exact_maps import SEEN_M, exact_map, flat, table
from support.maps.map_records import with_region, with_support
from triquad_client import InvalidInputError, Mesh, OfflineMap, open_map
from triquad_client.offline import map_mesh
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord

TABLE = table(0.1, 0.5)
RECORD = exact_map(TABLE, epoch=7)


def mesh_of(record: MapRecord, **options: object) -> Mesh:
    with OfflineMap(record) as offline:
        return offline.mesh(**options)


def centroids(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].mean(axis=1)


def test_the_mesh_of_a_file_lies_on_the_surface_that_was_seen(tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    write_map(RECORD, path)
    with open_map(path) as offline:
        mesh = offline.mesh()
    assert mesh.epoch == 7
    x, y, z = mesh.vertices.T
    away = np.abs(np.maximum(np.abs(x), np.abs(y)) - 2.0) > 0.2  # from the table's edge
    np.testing.assert_allclose(z[away], TABLE(x, y)[away], atol=1e-4)
    assert SEEN_M - 0.2 < np.abs(mesh.vertices).max() < SEEN_M + 0.2
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    area = np.cross(b - a, c - a)[:, 2].sum() / 2  # seen from above, where free space is
    assert area == pytest.approx((2 * SEEN_M) ** 2, rel=0.02)


def test_a_box_holds_the_faces_whose_centroids_lie_in_it() -> None:
    whole = mesh_of(RECORD, cell_m=0.2)
    low, high = np.array([-3.05, -1.0, 0.0]), np.array([0.0, np.inf, 0.3])
    part = mesh_of(RECORD, bounds=(low.tolist(), high.tolist()), cell_m=0.2)
    inside = ((centroids(whole) >= low) & (centroids(whole) <= high)).all(axis=1)
    assert 0 < len(part.faces) == inside.sum() < len(whole.faces)
    nowhere = mesh_of(RECORD, bounds=((50, 50, 50), (60, 60, 60)))
    assert nowhere.vertices.shape == nowhere.faces.shape == (0, 3)


def test_surface_is_where_the_mesh_has_faces() -> None:
    with OfflineMap(with_support(exact_map(flat(0.1)))) as offline:
        middles = centroids(offline.mesh())
        assert offline.has_surface(middles).all()
        x, y = np.random.default_rng(0).uniform(-SEEN_M - 1, SEEN_M + 1, (2, 2_000))
        points = np.stack([x, y, np.full(len(x), 0.1)], axis=1)
        has = offline.has_surface(points)
        with pytest.raises(InvalidInputError, match="points"):
            offline.has_surface(points[:, :2])
    to_face_m, _ = cKDTree(middles).query(points)
    assert np.quantile(to_face_m[has], 0.99) < 0.1, "cells of 0.1 m, but for slivers"
    beside = np.abs(points[:, :2]).max(axis=1) > SEEN_M + 0.05
    assert not has[beside].any()
    assert 0.4 < has[~beside].mean() < 0.5, "margins are on a third of all sides"


def test_far_regions_are_meshed_as_near_ones() -> None:
    def faces_at(index: int) -> int:
        return len(mesh_of(with_region(RECORD, index=(index, 0, 0)), cell_m=0.2).faces)

    assert faces_at(2**31 - 1) == faces_at(0) > 10_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cell_m": 0.001}, r"cell_m = 0\.001: use 0\.005 to 10"),
        ({"cell_m": "fine"}, "cell_m = 'fine' is not a number"),
        ({"bounds": ((0, 0, 0), (-1, 1, 1))}, "the minimum must not exceed the maximum"),
        ({"bounds": ((0, 0), (1, 1))}, "each corner has three coordinates"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(
    options: dict[str, object], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        mesh_of(RECORD, **options)


def test_a_mesh_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_mesh, "MAX_FACES", 1000)
    with pytest.raises(InvalidInputError, match=r"1,000 faces with cells of 0\.1 m.*smaller box"):
        mesh_of(RECORD)


def test_tile_by_tile_it_is_the_same_surface() -> None:
    with OfflineMap(RECORD) as offline:
        whole = offline.mesh(cell_m=0.2)
        tiles = offline.mesh_tiles(cell_m=0.2)
        parts = [(np.array(index) * tiles.side_m, tiles.mesh(index)) for index in tiles.indices]
    assert len(parts) >= 4
    assert sum(len(part.faces) for _, part in parts) == len(whole.faces)
    for low, part in parts:
        middles = centroids(part)
        assert ((middles >= low) & (middles <= low + tiles.side_m)).all()
    together = np.concatenate([centroids(part) for _, part in parts])
    sums = [np.sort(points @ [1.0, 2.0, 3.0]) for points in (together, centroids(whole))]
    np.testing.assert_allclose(*sums, atol=1e-6)
