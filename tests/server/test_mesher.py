import numpy as np
import pytest
from support.small_world import settings, settled_mapper, world
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.mesher import TileMesh


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    return settled_mapper(settings(), world(4)).publish()


@pytest.fixture(scope="module")
def tiles(epoch: Epoch) -> dict[tuple[int, int, int], TileMesh]:
    low, high = np.array([-12.0, -12, -3]), np.array([12.0, 12, 9])
    return {(x, y, z): epoch.mesh((x, y, z)) for x, y, z in epoch.tiles(low, high).tolist()}


def test_the_mesh_lies_on_the_surface(tiles: dict[tuple[int, int, int], TileMesh]) -> None:
    vertices = np.concatenate([tile.vertices + tile.origin for tile in tiles.values()])
    assert len(vertices) > 10_000
    distance = np.abs(world(4).scene.sdf(vertices))
    assert np.median(distance) < 0.01
    assert (distance < 0.1).mean() > 0.95


def test_faces_look_into_free_space(tiles: dict[tuple[int, int, int], TileMesh]) -> None:
    scene = world(4).scene
    agree = []
    for tile in tiles.values():
        corners = tile.vertices[tile.faces] + tile.origin
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = scene.gradient(corners.mean(axis=1))
        agree.append((normals * outwards).sum(axis=1) > 0)
    assert np.concatenate(agree).mean() > 0.9


def test_neighbouring_tiles_meet_without_seams(
    tiles: dict[tuple[int, int, int], TileMesh],
) -> None:
    """On their common face, both tiles have the same vertices."""
    side = settings().mesh.tile_side_m
    twins = []
    for (x, y, z), tile in tiles.items():
        other = tiles.get((x + 1, y, z))
        if other is None:
            continue
        mine = tile.vertices[np.abs(tile.vertices[:, 0] - side) < 1e-5]
        theirs = other.vertices[np.abs(other.vertices[:, 0]) < 1e-5]
        if len(mine) == 0 or len(theirs) == 0:
            continue
        gaps = np.abs(mine[:, None, 1:] - theirs[None, :, 1:]).max(axis=2)
        twins.append(gaps.min(axis=1) < 1e-4)
    # A vertex without a twin ends the mesh there: no surface was seen beyond.
    assert np.concatenate(twins).sum() > 200
    assert np.concatenate(twins).mean() > 0.8


def test_nothing_is_meshed_where_nothing_was_seen(epoch: Epoch) -> None:
    assert len(epoch.mesh((1000, 1000, 1000)).faces) == 0
    ground_below = epoch.mesh((0, 0, -3))
    assert len(ground_below.faces) == 0


def test_meshes_are_repeatable(
    epoch: Epoch,
    tiles: dict[tuple[int, int, int], TileMesh],
) -> None:
    tile = max(tiles, key=lambda index: len(tiles[index].faces))
    again = epoch.mesh(tile)
    np.testing.assert_array_equal(again.vertices, tiles[tile].vertices)
    np.testing.assert_array_equal(again.faces, tiles[tile].faces)
