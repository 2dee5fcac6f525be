import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from support.maps.small_world import mapper_of, settings, settled_epoch, world
from triquad_client import OfflineMap
from triquad_format.records.status import Status
from triquad_map.mesh.tile_mesh import TileMesh, mesh_tile
from triquad_map.triangles import Triangles, joined
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.tile_cache import tile_lattice
from triquad_server.mesh.tile_queries import surface_tiles
from triquad_server.settings import MeshSettings

LATTICE = tile_lattice(settings().mesh, 0)


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    return settled_epoch(4)


@pytest.fixture(scope="module")
def tiles(epoch: Epoch) -> dict[tuple[int, int, int], TileMesh]:
    low, high = np.array([-12.0, -12, -3]), np.array([12.0, 12, 9])
    indices = surface_tiles(epoch, LATTICE)
    inside = indices[LATTICE.meets(indices, low, high)]
    return {(x, y, z): mesh_tile(epoch, (x, y, z), LATTICE) for x, y, z in inside.tolist()}


def test_the_mesh_lies_on_the_surface(tiles: dict[tuple[int, int, int], TileMesh]) -> None:
    vertices = np.concatenate([tile.triangles.vertices for tile in tiles.values()])
    assert len(vertices) > 10_000
    distance = np.abs(world(4).scene.sdf(vertices))
    assert np.median(distance) < 0.01
    assert (distance < 0.1).mean() > 0.95


def test_faces_look_into_free_space(tiles: dict[tuple[int, int, int], TileMesh]) -> None:
    scene = world(4).scene
    agree = []
    for tile in tiles.values():
        corners = tile.triangles.vertices[tile.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = scene.gradient(corners.mean(axis=1))
        agree.append((normals * outwards).sum(axis=1) > 0)
    assert np.concatenate(agree).mean() > 0.9


def test_nothing_is_meshed_where_nothing_was_seen(epoch: Epoch) -> None:
    for outside_or_below_ground in ((1000, 1000, 1000), (0, 0, -3)):
        assert len(mesh_tile(epoch, outside_or_below_ground, LATTICE).faces) == 0


# Ambiguous cells differ; and tiles of level 1 reach farther beside voxels.
@pytest.mark.parametrize(("level", "differ"), [(0, 0.04), (1, 0.12)])
def test_holes_of_tiles_are_those_of_the_map_in_one_piece(
    epoch: Epoch, level: int, differ: float
) -> None:
    lattice, fill_m = tile_lattice(settings().mesh, level), 0.6
    low, high = np.array([0.0, -12.8, -12.8]), np.array([12.8, 0.0, 12.8])
    indices = surface_tiles(epoch, lattice, fill_m)
    inside = lattice.meets(indices, low + 1, high - 1)
    made = [mesh_tile(epoch, (*index,), lattice, fill_m=fill_m) for index in indices[inside]]
    seen, filled = (
        np.concatenate([_middles(tile)[tile.filled == kind] for tile in made]) for kind in (0, 1)
    )
    with OfflineMap(epoch.record()) as offline:
        whole = offline.mesh((low, high), lattice.cell_m, fill_m=fill_m)
    middles = whole.vertices[whole.faces].mean(axis=1)
    assert len(filled) > 0.02 * len(seen)
    assert len(filled) == pytest.approx(whole.filled.sum(), rel=differ)
    away = cKDTree(middles[whole.filled]).query(filled)[0]
    assert (away < lattice.cell_m / 2).mean() > 1 - differ
    assert (epoch.status(filled, 0.0) != Status.FREE).all()
    plain = [mesh_tile(epoch, (*index,), lattice) for index in indices[inside]]
    assert sum(len(tile.faces) for tile in plain) == len(seen)
    assert not any(tile.filled.any() for tile in plain)


def _middles(tile: TileMesh) -> NDArray[np.float64]:
    return tile.triangles.vertices[tile.faces].mean(axis=1)


def test_every_tile_with_faces_is_listed_however_small_tiles_are() -> None:
    chosen = settings(samples_per_ray=1.2)
    small = chosen.model_copy(
        update={"mesh": MeshSettings(cell_m=0.05, tile_cells=16, reach_m=0.2)}
    )
    epoch = mapper_of(*world(1).scans, chosen=small).publish()
    lattice = tile_lattice(small.mesh, 0)
    low = np.array([3.0, -2.0, -1.0])
    listed = {tuple(tile) for tile in surface_tiles(epoch, lattice).tolist()}
    side = lattice.tile_side_m
    for offset in np.ndindex(3, 6, 3):
        x, y, z = (np.floor(low / side).astype(int) + offset).tolist()
        if len(mesh_tile(epoch, (x, y, z), lattice).faces):
            assert (x, y, z) in listed


def test_tiles_are_joined_without_cracks_however_their_numbers_are_rounded() -> None:
    rng = np.random.default_rng(0)
    edge = np.stack([np.full(2000, 6.4), rng.uniform(0, 6.4, 2000), np.full(2000, 0.3)], axis=1)
    edge[:, 1] = np.round(edge[:, 1] / 1e-3) * 1e-3 + 0.5e-4  # on boundaries of the rounding
    edge = np.unique(edge, axis=0)
    copy = edge + rng.normal(0, 1e-7, edge.shape) * (0, 1, 0)
    at = np.arange(len(edge) - 1)
    fan = np.stack([at, at + 1, np.full(len(at), len(edge))], axis=1).astype(np.int32)
    left = Triangles(np.concatenate([edge, [[6.0, 3.0, 0.5]]]), fan)
    right = Triangles(np.concatenate([copy, [[6.8, 3.0, 0.5]]]), fan[:, ::-1])
    mesh = joined([left, right], 6.4, box=(np.full(3, -np.inf), np.full(3, np.inf)))
    assert len(mesh.vertices) == len(edge) + 2
    assert len(mesh.faces) == 2 * len(at)
