"""The questions about the map that clients may ask, each answered from one epoch."""

from triquad_format.wire import keys
from triquad_format.wire.codec import Message
from triquad_format.wire.limits import MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.messages import SdfRequest
from triquad_format.wire.query_messages import (
    AlignRequest,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)

QUESTIONS: dict[str, type[Message]] = {
    keys.SDF: SdfRequest,
    keys.DISTANCE: DistanceRequest,
    keys.SPHERES: SpheresRequest,
    keys.SEGMENTS: SegmentsRequest,
    keys.RAYS: RaysRequest,
    keys.GROUND: GroundRequest,
    keys.GRID: GridRequest,
    keys.ALIGN: AlignRequest,
}
"""The request of each operation."""

MAX_QUESTION_BYTES = payload_limit(MAX_QUERY_POINTS)
