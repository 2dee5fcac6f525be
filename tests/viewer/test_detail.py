"""How finely what is drawn, from where, and in which colours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.maps.exact_maps import exact_map, flat
from support.servers import SMALL, learn, running_service
from triquad_client import connect
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_tools.viewer.mesh.tile_colours import before_tone_mapping
from triquad_tools.viewer.mesh.tiles_in_view import NearTiles, TilesInView
from triquad_tools.viewer.sources import COARSEST, LiveSource, MapSource, StoredMap


def test_near_tiles_are_those_of_the_server() -> None:
    with running_service(SMALL) as endpoint, connect(endpoint) as client:
        learn(client)
        client.settle()
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
    assert_detail_near(StoredMap(path, "here"), np.array(far))


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
