"""How finely what is drawn, from where, and in which colours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.files.changing_store import box_at, write_checkpoint
from support.maps.exact_maps import exact_map, flat
from support.servers import SMALL, learn_all, running_service
from triquad_client import connect
from triquad_client.mesh.followed_mesh import MeshTile
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_tools.viewer.mesh.mesh_layer import cut_tile, joined_tiles
from triquad_tools.viewer.mesh.tile_colours import before_tone_mapping, height_colours
from triquad_tools.viewer.mesh.tiles_in_view import NearTiles, TilesInView
from triquad_tools.viewer.sources import COARSEST, FileSource, LiveSource, MapSource


def test_near_tiles_are_those_of_the_server() -> None:
    with running_service(SMALL) as endpoint, connect(endpoint) as client:
        learn_all(client)
        source = LiveSource(client, endpoint)
        for level in range(COARSEST):
            near = NearTiles(source, level)
            roots = [(0, 0, 0), (-1, -1, -1)]
            near.refresh(roots)
            while not near.loaded:
                near.refresh(roots)
            assert set(roots) <= near.ready
            with client.watch_mesh(level=level) as watch:
                watch.catch_up()
                count = 1 << (COARSEST - level)
                wanted = {
                    index: tile.version
                    for index, tile in watch.tiles.items()
                    if all(0 <= place < count for place in index)
                }
            found = {name.index: tile.version for name, tile in near.within((0, 0, 0))}
            assert wanted
            assert found == wanted
            near.refresh([(40, 40, 40)])
            assert not near.ready & set(roots)
            near.close()
        assert_detail_near(source, np.zeros(3))


def test_tiles_far_from_zero_are_as_fine(tmp_path: Path) -> None:
    path, far = tmp_path / "far.triquad", (450_000.0, 5_400_000.0, 0.0)
    write_map(replace(exact_map(flat(0.0)), origin_m=far), path)
    assert_detail_near(FileSource(path, "here"), np.array(far))


def assert_detail_near(source: MapSource, place: Doubles) -> None:
    """Tiles are the finest where the eye is at a place of the map, and coarse where it is not."""
    tiles = TilesInView(source)
    for eye, level in (place, 0), (place + [1e4, 0.0, 0.0], COARSEST):
        tiles.refresh(eye, 1.0)
        while not tiles.loaded:
            tiles.refresh(eye, 1.0)
        shown = tiles.refresh(eye, 1.0)
        assert {name.level for name in shown} == {level}
        for tile in shown.values():
            assert np.abs(tile.origin + tile.vertices - place).max() < 20.0
    tiles.close()


def test_a_mesh_is_cut_and_joined(tmp_path: Path) -> None:
    path = write_checkpoint(tmp_path, 7, box_at(3.0, 3.0))
    source = FileSource(path, "here")
    follower = source.follow(0)
    while not follower.complete:
        follower.next(0.0)
    tiles, side_m = list(follower.tiles.values()), source.sizes.tile_side_m
    whole = source.queries.mesh(cell_m=source.sizes.cell_m)
    mesh = joined_tiles(tiles, side_m)
    assert mesh.epoch == 7
    assert len(mesh.vertices) == pytest.approx(len(whole.vertices), rel=1e-3), "without seams"
    assert mesh.vertices[:, 2].max() > 1.4
    cut = joined_tiles([cut_tile(tile, 0.8) for tile in tiles], side_m)
    assert 0.1 < cut.vertices[:, 2].max() <= 0.8
    below = (whole.vertices[whole.faces][..., 2] <= 0.8).all(axis=1)
    assert len(cut.faces) == pytest.approx(below.sum(), rel=1e-3)
    assert not len(joined_tiles([], side_m).faces)


def test_what_lies_near_a_flat_ground_has_most_of_the_colours() -> None:
    rng = np.random.default_rng(0)
    walls = rng.uniform(0.0, 8.0, 3000)
    street = np.concatenate([rng.normal(0.0, 0.02, 3000), walls])
    even, stretched = height_colours(walls), height_colours(street)
    assert "4" in even.scale.html
    for colours, least in (even, 0.0), (stretched, 2.0 * 1.5 / 8.5):
        scale, tile = colours.scale, MeshTile(
            (0, 0, 0), 1, np.zeros(3), np.float32([[0, 0, 0], [0, 0, 1.5], [0, 0, 8]]),
            np.int32([[0, 1, 2]]),
        )  # fmt: skip
        places = (colours.values(tile) - scale.low) / (scale.high - scale.low)
        assert (np.diff(places) > 0).all()
        assert places[1] - places[0] > least, "a car is not as the road"
        np.testing.assert_allclose(scale.told(colours.values(tile)), [0, 1.5, 8], atol=1e-5)


def test_the_browser_shows_the_colours_of_the_legend() -> None:
    """Its tone mapping, as three.js has it, takes colours back to what they were."""
    wanted = np.vstack([np.random.default_rng(0).uniform(0.0, 0.9, (50, 3)), np.ones(3)])
    into = [[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566], [0.0284, 0.13383, 0.83777]]
    out = [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605]]
    out.append([-0.00327, -0.07276, 1.07602])
    light = before_tone_mapping(wanted) / 0.6 @ np.transpose(into)
    fitted = (light * (light + 0.0245786) - 0.000090537) / (
        light * (0.983729 * light + 0.4329510) + 0.238081
    )
    shown = np.clip(fitted @ np.transpose(out), 0.0, 1.0)
    np.testing.assert_allclose(shown[:-1], wanted[:-1], atol=1e-4)
    assert shown[-1].min() > 0.95
