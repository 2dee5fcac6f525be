"""Who follows the mesh is told everything, in whatever order tiles were made."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from support.maps.exact_maps import flat
from support.maps.meshed_ground import EVERYWHERE, MESH, ground, make_all, surfaces
from triquad_format.wire.mesh_messages import TileUpdates, TileUpdatesRequest
from triquad_map.mesh.tile_lattice import TileIndex
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.update_queries import UpdateQueries
from triquad_server.process.threads import Teams

TEAM = Teams().meshing


def queries(cache: TileCache, newest: Epoch) -> UpdateQueries:
    epochs: Any = SimpleNamespace(newest=newest, give_way=lambda _: None)
    return UpdateQueries(epochs, cache, "server")


def followed(asked: UpdateQueries, max_bytes: int) -> tuple[dict[TileIndex, int], int]:
    """The versions of all tiles that a new client gets until all is there, and how many came."""
    versions: dict[TileIndex, int] = {}
    came, reply = 0, None
    while reply is None or not reply.complete:
        reply = asked.updates(request(versions, reply, max_bytes))
        came += len(reply.tiles)
        for (x, y, z), version in zip(reply.tiles.tolist(), reply.versions.tolist(), strict=True):
            versions[x, y, z] = version
    return versions, came


def request(
    versions: dict[TileIndex, int], reply: TileUpdates | None, max_bytes: int
) -> TileUpdatesRequest:
    return TileUpdatesRequest(
        *EVERYWHERE,
        level=0,
        server="" if reply is None else reply.server,
        revision=0 if reply is None else reply.revision,
        known=np.array(list(versions), np.int32).reshape(-1, 3),
        known_versions=np.array(list(versions.values()), np.int64),
        max_bytes=max_bytes,
    )


def test_a_tile_that_turns_out_to_be_as_it_was_reaches_who_came_meanwhile() -> None:
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    make_all(cache)
    whole = surfaces(cache).keys()
    epoch = ground(flat(0.3))
    asked = queries(cache, epoch)
    cache.refresh(epoch)
    for index in list(whole)[:5]:  # of the first that were made
        cache._levels[0].changed[index] = epoch.number
    versions, came = followed(asked, max_bytes=4000)
    assert versions.keys() == whole
    assert came == len(whole), "and none comes twice"
