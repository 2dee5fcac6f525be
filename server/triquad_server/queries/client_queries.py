"""Answers the queries of clients about the map, its changes, and the sources of its scans."""

from triquad_format.wire import keys
from triquad_format.wire.codec import Message
from triquad_format.wire.limits import MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.messages import SdfRequest
from triquad_format.wire.query_messages import (
    AlignRequest,
    ChangesRequest,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SourcesRequest,
    SpheresRequest,
)
from triquad_map.questions.answers import Answers, QuestionLimits

from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import SurfaceHistory
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.queries.change_queries import ChangeQueries
from triquad_server.queries.source_queries import SourceQueries
from triquad_server.serving.operations import Operations

_REQUESTS: dict[str, type[Message]] = {
    keys.SDF: SdfRequest,
    keys.DISTANCE: DistanceRequest,
    keys.SPHERES: SpheresRequest,
    keys.SEGMENTS: SegmentsRequest,
    keys.RAYS: RaysRequest,
    keys.GROUND: GroundRequest,
    keys.GRID: GridRequest,
    keys.ALIGN: AlignRequest,
}
_MAX_BYTES = payload_limit(MAX_QUERY_POINTS)


def serve_queries(
    operations: Operations,
    epochs: EpochHistory,
    surface: SurfaceHistory,
    trails: SourceTrails,
    server: str,
) -> None:
    """Answer queries from now on, each from one epoch; ``server`` is the name in replies."""
    answers = Answers(epochs.view, QuestionLimits())
    for name, kind in _REQUESTS.items():
        operations.serve(name, kind, answers.answer, max_bytes=_MAX_BYTES)
    changes, sources = ChangeQueries(epochs, surface, server), SourceQueries(trails, server)
    operations.serve(keys.CHANGES, ChangesRequest, changes.changes)
    operations.serve(keys.SOURCES, SourcesRequest, sources.sources)
