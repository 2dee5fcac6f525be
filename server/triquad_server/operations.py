"""Which part of the server answers which operation, in groups that share a queue and workers.

No group waits for a slower one.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from triquad_format.wire import keys
from triquad_format.wire.messages import (
    CheckpointRequest,
    FlushRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
    SdfRequest,
    StatusRequest,
    TileListRequest,
    TileRequest,
    TileUpdatesRequest,
)
from triquad_format.wire.query_messages import (
    AlignRequest,
    DistanceRequest,
    GridRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)
from triquad_map.questions.answers import Answers

from triquad_server.health import Health
from triquad_server.intake.flush import FlushHandler
from triquad_server.mapping.resets import Resets
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.mesh.tile_queries import TileQueries
from triquad_server.net.handlers import Handler, answering
from triquad_server.store.checkpoints import Checkpoints
from triquad_server.store.download import MapDownloads

_TILE_WORKERS = 2  # one computes while another packs


@dataclass(frozen=True)
class Operations:
    """A group of operations."""

    handlers: Mapping[str, Handler]  # by operation of triquad_format.wire.keys
    workers: int = 1


def query_operations(answers: Answers, workers: int) -> list[Operations]:
    """Queries of the map; ``workers`` answer each group."""
    return [
        Operations({keys.SDF: answering(SdfRequest, answers.sdf)}, workers),
        Operations(
            {
                keys.DISTANCE: answering(DistanceRequest, answers.distance),
                keys.SPHERES: answering(SpheresRequest, answers.spheres),
            },
            workers,
        ),
        Operations(
            {
                keys.SEGMENTS: answering(SegmentsRequest, answers.segments),
                keys.RAYS: answering(RaysRequest, answers.rays),
                keys.GRID: answering(GridRequest, answers.grid),
            },
            workers,
        ),
        Operations({keys.ALIGN: answering(AlignRequest, answers.align)}),
    ]


def mesh_operations(tiles: TileQueries, feed: TileFeed) -> list[Operations]:
    """Queries of mesh tiles, and following them."""
    return [
        Operations(
            {
                keys.TILE_LIST: answering(TileListRequest, tiles.tiles),
                keys.TILE: answering(TileRequest, tiles.tile),
            },
            _TILE_WORKERS,
        ),
        Operations(
            {keys.TILE_UPDATES: lambda request: feed.add(request, request.read(TileUpdatesRequest))}
        ),
    ]


def status_operations(health: Health, flush: FlushHandler) -> Operations:
    """How the server is doing, and whether scans are in the map."""
    return Operations(
        {
            keys.STATUS: answering(StatusRequest, health.answer),
            keys.FLUSH: lambda request: flush.add(request, request.read(FlushRequest)),
        }
    )


def download_operations(downloads: MapDownloads) -> Operations:
    """Fetching the map as a file."""
    return Operations(
        {
            keys.MAP_INFO: answering(MapInfoRequest, downloads.info),
            keys.MAP_CHUNK: answering(MapChunkRequest, downloads.chunk),
        }
    )


def admin_operations(checkpoints: Checkpoints, resets: Resets) -> Operations:
    """What changes the map or the store."""
    return Operations(
        {
            keys.CHECKPOINT: answering(CheckpointRequest, checkpoints.answer),
            keys.RESET: answering(ResetRequest, resets.answer),
        }
    )
