"""Replies of the right form to every question, by a server that knows nothing of the world."""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    FlushReply,
    FlushRequest,
    MapChunk,
    MapChunkRequest,
    MapInfo,
    MapInfoRequest,
    MeshReply,
    MeshRequest,
    ResetReply,
    ResetRequest,
    SdfReply,
    SdfRequest,
    ServerStatus,
    StatusRequest,
    TileList,
    TileListRequest,
    TileUpdates,
    TileUpdatesRequest,
)
from triquad_format.wire.metrics_messages import (
    CheckpointMetrics,
    MetricsRequest,
    OperationMetrics,
    ServerMetrics,
    TimeHistogram,
)
from triquad_format.wire.query_messages import (
    AlignReply,
    AlignRequest,
    ChangesReply,
    ChangesRequest,
    DistanceReply,
    DistanceRequest,
    GridReply,
    GridRequest,
    GroundReply,
    GroundRequest,
    RaysReply,
    RaysRequest,
    SegmentsReply,
    SegmentsRequest,
    SpheresReply,
    SpheresRequest,
)
from triquad_format.wire.source_messages import (
    ScanSample,
    SourcesReply,
    SourcesRequest,
    SourceState,
)
from triquad_format.wire.tile_codec import TileSurface, encode_tile

EPOCH = 7
SERVER = "x"
FILE = bytes(range(256)) * 40
CHUNK_BYTES = 4096
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
FACE = np.array([(0, 1, 2)], np.int32)
SURFACE = TileSurface(
    CORNERS.astype(np.uint16), np.zeros(3, np.uint8), np.zeros(3, np.uint8), faces=FACE
)
TILE = encode_tile(SURFACE)


def honest_reply(request: Message) -> Message:
    """The reply to a request of any operation."""
    return _REPLIES[type(request)](request)


def _values(count: int) -> Any:
    return np.full(count, 0.5, np.float32)


def _codes(count: int) -> Any:
    return np.ones(count, np.uint8)


def _ups(count: int) -> Any:
    return np.tile(np.array([0, 0, 1], np.float32), (count, 1))


def _epoch(request: Any) -> int:
    return request.epoch or EPOCH


def _sdf(request: SdfRequest) -> SdfReply:
    count = len(request.points)
    gradient = _ups(count) if request.gradient else None
    return SdfReply(_epoch(request), _values(count), _codes(count), gradient)


def _distance(request: DistanceRequest) -> DistanceReply:
    count, unknown = len(request.points), request.unknown_distance
    return DistanceReply(
        _epoch(request),
        distance_m=_values(count),
        gradient=_ups(count),
        found=_codes(count),
        status=_codes(count),
        confidence=_values(count),
        surface_point=request.points if request.surface_point else None,
        unknown_distance_m=_values(count) if unknown else None,
        unknown_point=request.points if unknown else None,
    )


def _segments(request: SegmentsRequest) -> SegmentsReply:
    count = len(request.starts)
    half, flags = _values(count), np.zeros(count, np.uint8)
    return SegmentsReply(
        _epoch(request),
        length_m=half,
        blocked=flags,
        contact_m=half,
        clearance_m=half,
        clearance_at_m=half,
        meets_unknown=flags,
        unknown_contact_m=half,
    )


def _ground(request: GroundRequest) -> GroundReply:
    count = len(request.points)
    return GroundReply(
        _epoch(request),
        _codes(count),
        _values(count),
        normal=_ups(count),
        confidence=_values(count),
    )


def _grid(request: GridRequest) -> GridReply:
    shape = tuple(request.counts.tolist())
    return GridReply(
        _epoch(request), np.full(shape, 0.5, np.float32), status=np.ones(shape, np.uint8)
    )


def _align(request: AlignRequest) -> AlignReply:
    return AlignReply(
        _epoch(request),
        request.world_from_sensor,
        covariance=np.eye(6),
        inlier_share=0.5,
        rms_m=0.1,
        converged=True,
        iterations=3,
        points=len(request.points),
    )


def _changes(request: ChangesRequest) -> ChangesReply:
    return ChangesReply(
        EPOCH + 2,
        SERVER,
        since=request.since or EPOCH + 2,
        minimum=np.zeros((2, 3)),
        maximum=np.ones((2, 3)),
        appeared=np.array([0, 1], np.uint8),
        epochs=np.array([8, 9]),
        voxels=np.array([3, 4]),
    )


def _sources(request: SourcesRequest) -> SourcesReply:
    points = np.zeros((min(10, request.max_points), 3), np.float32)
    sample = ScanSample(1, np.eye(4), points, points_used=10)
    state = SourceState(1, True, np.zeros((2, 3)), pieces=np.zeros(2, np.int64), newest=sample)
    return SourcesReply(SERVER, 5, {"lidar": state})


def _tiles(request: TileListRequest) -> TileList:
    index = np.zeros((1, 3), np.int32)
    return TileList(_epoch(request), 6.4, index, changed=np.array([EPOCH]))


def _mesh(request: MeshRequest) -> MeshReply:
    filled = np.zeros(len(FACE) * len(request.tiles), np.uint8) if request.fill_m > 0 else None
    sizes = np.full(len(request.tiles), len(TILE))
    return MeshReply(_epoch(request), 6.4, 0.1, sizes, TILE * len(sizes), filled)


def _updates(request: TileUpdatesRequest) -> TileUpdates:
    del request
    return TileUpdates(
        server=SERVER,
        revision=3,
        epoch=EPOCH,
        complete=True,
        restart=False,
        tile_side_m=6.4,
        cell_m=0.1,
        tiles=np.zeros((1, 3), np.int32),
        versions=np.array([EPOCH]),
        sizes=np.array([len(TILE)]),
        data=TILE,
        removed=np.zeros((0, 3), np.int32),
    )


def _status(_: StatusRequest) -> ServerStatus:
    return ServerStatus(
        map_name="default",
        server=SERVER,
        version="1",
        device="cpu",
        epoch=EPOCH,
        settled=True,
        scans_taken=1,
        scans_dropped={"bad_pose": 1},
        scans_lost={"lidar": 0},
        scans_waiting=0,
        points_dropped={},
        requests_refused={},
        samples_trained=1,
        rays_kept=1,
        loss=0.1,
        regions=1,
        vertices=1,
        parameters=1,
        memory_bytes=1,
        uptime_s=1.0,
        last_checkpoint=None,
        store_error=None,
    )


def _metrics(_: MetricsRequest) -> ServerMetrics:
    times = TimeHistogram(np.array([1, 2, 0]), 0.1)
    asked = OperationMetrics(times, times, {}, pending=0, received_bytes=1, sent_bytes=1)
    return ServerMetrics(
        server=SERVER,
        uptime_s=1.0,
        problem=None,
        epoch=EPOCH,
        epoch_age_s=0.1,
        epochs_kept=1,
        epochs_pinned=0,
        bounds_s=np.array([0.1, 1.0]),
        operations={"query/sdf": asked},
        queues={},
        sources={},
        scan_bytes_received=1,
        memory_bytes={},
        resident_bytes=1,
        mapper_s={},
        checkpoints=CheckpointMetrics(0, 0, None, None),
        sessions={},
    )


def _chunk(request: MapChunkRequest) -> MapChunk:
    data = FILE[request.offset : request.offset + request.length]
    return MapChunk(request.offset, data.ljust(request.length, b"\0"))  # as if it went on


_REPLIES: dict[type[Message], Callable[[Any], Message]] = {
    SdfRequest: _sdf,
    DistanceRequest: _distance,
    SpheresRequest: lambda asked: SpheresReply(_epoch(asked), _codes(len(asked.centres))),
    SegmentsRequest: _segments,
    RaysRequest: lambda asked: RaysReply(
        _epoch(asked), _values(len(asked.starts)), _codes(len(asked.starts))
    ),
    GroundRequest: _ground,
    GridRequest: _grid,
    AlignRequest: _align,
    ChangesRequest: _changes,
    SourcesRequest: _sources,
    TileListRequest: _tiles,
    MeshRequest: _mesh,
    TileUpdatesRequest: _updates,
    StatusRequest: _status,
    MetricsRequest: _metrics,
    FlushRequest: lambda _: FlushReply(taken=1, refused=0, lost=0, last_refusal=None),
    MapInfoRequest: lambda _: MapInfo(
        EPOCH, len(FILE), hashlib.sha256(FILE).hexdigest(), chunk_bytes=CHUNK_BYTES
    ),
    MapChunkRequest: _chunk,
    CheckpointRequest: lambda _: CheckpointInfo("map.triquad", 1, EPOCH, "0" * 64, stamp_ns=1),
    ResetRequest: lambda _: ResetReply(EPOCH),
}
