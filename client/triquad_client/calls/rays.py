"""How far rays reach."""

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_RANGE_M
from triquad_format.wire.query_messages import RaysReply, RaysRequest
from triquad_map.questions.rays import RayOptions, RayRanges

from triquad_client import checks
from triquad_client.errors import InvalidInputError
from triquad_client.net.call import Ask, Call
from triquad_client.net.parts import in_parts, relative

PART_RAYS = 2_000
"""RayRanges of one request."""


def query(
    origins: ArrayLike, directions: ArrayLike, options: RayOptions, at_epoch: int | None
) -> Call[RayRanges]:
    """How far rays reach from ``origins`` [3] or [N, 3] along ``directions`` [N, 3]."""
    ways = checks.directions(directions)
    places = checks.place_or_places(origins)
    if len(places) not in (1, len(ways)):
        raise InvalidInputError(
            f"{len(places)} origins for {len(ways)} directions: one, or as many"
        )
    starts = np.broadcast_to(places, ways.shape)
    reach_m = checks.within("max_range_m", options.max_range_m, MAX_RANGE_M)

    def request(part: slice, number: int) -> Ask[RaysReply]:
        sent = relative(starts[part])
        message = RaysRequest(
            origin=sent.origin,
            starts=sent.offsets,
            directions=ways[part].astype(np.float32),
            max_range_m=reach_m,
            through_unknown=options.through_unknown,
            epoch=number,
        )
        return Ask(keys.RAYS, message, RaysReply)

    epoch = checks.chosen_epoch(at_epoch)
    parts = yield from in_parts(len(ways), PART_RAYS, request, epoch)
    return RayRanges(
        np.concatenate([part.range_m for part in parts]),
        np.concatenate([part.status for part in parts]),
        parts[0].epoch,
    )
