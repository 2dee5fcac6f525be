"""Who follows the mesh is told everything, in whatever order tiles were made."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.maps.exact_maps import flat
from support.maps.meshed_ground import EVERYWHERE, MESH, ground, make_all, surfaces
from triquad_format.wire.mesh_messages import TileUpdates, TileUpdatesRequest
from triquad_map.mesh.tile_lattice import TileIndex
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh import update_queries
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.update_queries import UpdateQueries
from triquad_server.process.threads import Teams

TEAM = Teams().meshing


def queries(cache: TileCache, newest: Epoch) -> UpdateQueries:
    epochs: Any = SimpleNamespace(newest=newest, give_way=lambda _: None)
    return UpdateQueries(epochs, cache, "server")


def followed(asked: UpdateQueries, *, names: bool) -> tuple[set[TileIndex], int]:
    """The tiles that a new client gets until all is there, and how many came.

    It names the tiles that it has, or does not.
    """
    versions: dict[TileIndex, int] = {}
    came, reply = 0, None
    while reply is None or not reply.complete:
        reply = asked.updates(request(versions if names else {}, reply))
        came += len(reply.tiles)
        for (x, y, z), version in zip(reply.tiles.tolist(), reply.versions.tolist(), strict=True):
            versions[x, y, z] = version
    return set(versions), came


def request(known: dict[TileIndex, int], reply: TileUpdates | None) -> TileUpdatesRequest:
    return TileUpdatesRequest(
        *EVERYWHERE,
        level=0,
        server="" if reply is None else reply.server,
        revision=0 if reply is None else reply.revision,
        known=np.array(list(known), np.int32).reshape(-1, 3),
        known_versions=np.array(list(known.values()), np.int64),
        max_bytes=4000,
    )


@pytest.mark.parametrize("names", [True, False])
def test_a_tile_that_turns_out_to_be_as_it_was_reaches_who_came_meanwhile(
    names: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(update_queries, "_SLICE_S", 1e-4)  # a tile or two are made at a time
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    make_all(cache)
    whole = surfaces(cache).keys()
    epoch = ground(flat(0.3))
    asked = queries(cache, epoch)
    cache.refresh(epoch)
    for index in list(whole)[:12]:  # of the first that were made
        cache._levels[0].changed[index] = epoch.number
    tiles, came = followed(asked, names=names)
    assert tiles == whole
    assert came == len(whole) or not names, "none comes twice"
