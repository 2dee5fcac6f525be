"""What a ball meets on segments, and on a polyline."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.wire import keys
from triquad_format.wire.query_messages import SegmentsReply, SegmentsRequest
from triquad_map.questions.polyline import Polyline, along_polyline
from triquad_map.questions.segments import SegmentOptions, Segments

from triquad_client import checks
from triquad_client.errors import InvalidInputError
from triquad_client.net.call import Ask, Call
from triquad_client.net.parts import in_parts, relative

PART_SEGMENTS = 2_000
"""Segments of one request."""


def query(
    starts: ArrayLike, ends: ArrayLike, options: SegmentOptions, at_epoch: int | None
) -> Call[Segments]:
    """What a ball meets that moves from ``starts`` to ``ends`` [N, 3], metres, map frame."""
    first, last = checks.query_points(starts), checks.query_points(ends)
    if len(first) != len(last):
        raise InvalidInputError(f"{len(first)} starts and {len(last)} ends: give as many")
    return (yield from _query(first, last, options, at_epoch))


def query_polyline(
    points: ArrayLike, options: SegmentOptions, at_epoch: int | None
) -> Call[Polyline]:
    """What a ball meets that moves along ``points`` [N, 3], metres, map frame."""
    checked = checks.query_points(points)
    if len(checked) < 2:
        raise InvalidInputError(f"a polyline of {len(checked)} points: give two or more")
    return along_polyline((yield from _query(checked[:-1], checked[1:], options, at_epoch)))


def _query(
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    options: SegmentOptions,
    at_epoch: int | None,
) -> Call[Segments]:
    radius_m = checks.within("radius_m", options.radius_m, least=0.0)
    reach_m = checks.within("max_distance_m", options.max_distance_m)

    def request(part: slice, number: int) -> Ask[SegmentsReply]:
        sent = relative(starts[part])
        offsets = (ends[part] - sent.origin).astype(np.float32)
        message = SegmentsRequest(
            origin=sent.origin,
            starts=sent.offsets,
            ends=offsets,
            radius_m=radius_m,
            max_distance_m=reach_m,
            epoch=number,
        )
        return Ask(keys.SEGMENTS, message, SegmentsReply)

    epoch = checks.chosen_epoch(at_epoch)
    parts = yield from in_parts(len(starts), PART_SEGMENTS, request, epoch)
    return Segments(
        length_m=np.concatenate([part.length_m for part in parts]),
        blocked=np.concatenate([part.blocked for part in parts]).astype(np.bool_),
        contact_m=np.concatenate([part.contact_m for part in parts]),
        clearance_m=np.concatenate([part.clearance_m for part in parts]),
        clearance_at_m=np.concatenate([part.clearance_at_m for part in parts]),
        meets_unknown=np.concatenate([part.meets_unknown for part in parts]).astype(np.bool_),
        unknown_contact_m=np.concatenate([part.unknown_contact_m for part in parts]),
        epoch=parts[0].epoch,
    )
