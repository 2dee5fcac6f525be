"""The requests of clients: which part of the server answers each kind, and in which lane."""

from functools import partial

from triquad_format.wire.limits import MAX_KEYFRAMES, MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.mesh_messages import MeshRequest, TileChangesRequest, TileListRequest
from triquad_format.wire.messages import (
    CheckpointRequest,
    FlushRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest
from triquad_format.wire.query_messages import ChangesRequest, GridRequest
from triquad_format.wire.source_messages import CorrectPosesRequest, SourcesRequest
from triquad_format.wire.status_messages import StatusRequest
from triquad_map.questions.answers import QUESTIONS, Answers

from triquad_server.epochs.surface_history import SurfaceHistory, changes_reply
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_queries import TileQueries
from triquad_server.server_status import Health
from triquad_server.serving.operations import Lane
from triquad_server.store.download import MapDownloads
from triquad_server.store.pose_corrector import PoseCorrector
from triquad_server.store.resets import Resets

_KEYFRAME_BYTES = 80  # of a time, a position and a quaternion, with room


def answer_requests(
    parts: Health,
    tiles: TileCache,
    surface: SurfaceHistory,
    trails: SourceTrails,
    *,
    is_shared: bool = False,
) -> None:
    """Answer the requests of clients from now on, by the parts of the server.

    Of a map that ``is_shared``, poses cannot be corrected: other servers have some of its regions.
    """
    serve = parts.operations.serve
    answers, max_bytes = Answers(parts.epochs.view), payload_limit(MAX_QUERY_POINTS)
    for question in QUESTIONS:
        lane = Lane.LONG_QUESTIONS if question is GridRequest else Lane.QUESTIONS
        serve(question, answers.answer, lane, max_bytes)
    serve(
        ChangesRequest,
        lambda request: changes_reply(request, surface, parts.epochs.newest, parts.server),
    )
    serve(SourcesRequest, trails.answer)

    mesh = TileQueries(parts.epochs, tiles, parts.server)
    serve(TileListRequest, mesh.tiles, Lane.MESH)
    serve(TileChangesRequest, mesh.changes, Lane.MESH)
    serve(MeshRequest, mesh.mesh, Lane.MESH)

    lane = Lane.ADMINISTRATION
    flushed = partial(
        parts.scans.ledger.answer,
        publish_soon=parts.mapper.publish_soon,
        warnings=parts.warnings.of,
    )
    serve(StatusRequest, lambda _: parts.status(), lane)
    serve(MetricsRequest, lambda _: parts.metrics(), lane)
    serve(FlushRequest, flushed, lane)

    checkpoints = parts.checkpoints
    downloads = MapDownloads(parts.mapper, parts.epochs, parts.memory, parts.server)
    serve(CheckpointRequest, checkpoints.answer, Lane.FILES)
    serve(ResetRequest, Resets(parts.mapper, checkpoints, trails).answer, Lane.FILES)
    corrector = PoseCorrector(
        parts.mapper,
        checkpoints,
        trails,
        is_stopping=lambda: parts.operations.is_stopping,
    )
    if not is_shared:
        serve(CorrectPosesRequest, corrector.answer, Lane.FILES, _KEYFRAME_BYTES * MAX_KEYFRAMES)
    serve(MapInfoRequest, downloads.info, Lane.FILES)
    serve(MapChunkRequest, downloads.chunk, Lane.LONG_QUESTIONS)
