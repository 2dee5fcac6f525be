"""True distances to the nearest surface."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.wire import keys
from triquad_format.wire.query_messages import DistanceReply, DistanceRequest
from triquad_map.questions.distance import DistanceOptions, Distances, with_unknown
from triquad_map.unknown import Unknown

from triquad_client import checks
from triquad_client.net.call import Ask, Call
from triquad_client.net.parts import in_parts, relative

PART_POINTS = 20_000
"""Points of one request: it takes the server some tens of milliseconds, and others wait as long."""


def query(
    points: ArrayLike,
    options: DistanceOptions,
    unknown: Unknown | str,
    at_epoch: int | None,
) -> Call[Distances]:
    """Distances at ``points`` [N, 3] of the map frame, metres."""
    checked = checks.query_points(points)
    policy = checks.unknown_policy(unknown)
    reach_m = checks.within("max_distance_m", options.max_distance_m)
    with_unknown_space = options.unknown_distance or policy is not Unknown.FREE

    def request(part: slice, number: int) -> Ask[DistanceReply]:
        sent = relative(checked[part])
        message = DistanceRequest(
            origin=sent.origin,
            points=sent.offsets,
            max_distance_m=reach_m,
            surface_point=options.surface_point,
            unknown_distance=with_unknown_space,
            epoch=number,
        )
        return Ask(keys.DISTANCE, message, DistanceReply)

    epoch = checks.chosen_epoch(at_epoch)
    parts = yield from in_parts(len(checked), PART_POINTS, request, epoch)
    return with_unknown(_joined(parts, checked), checked, policy)


def _joined(parts: Sequence[DistanceReply], points: NDArray[np.float64]) -> Distances:
    origins = [
        relative(points[start : start + PART_POINTS]).origin
        for start in range(0, max(1, len(points)), PART_POINTS)
    ]

    def positions(
        of: Callable[[DistanceReply], NDArray[np.float32] | None],
    ) -> NDArray[np.float64] | None:
        offsets = [of(part) for part in parts]
        given = [
            origin + offset
            for origin, offset in zip(origins, offsets, strict=True)
            if offset is not None
        ]
        return np.concatenate(given) if given else None

    unknown = [part.unknown_distance_m for part in parts if part.unknown_distance_m is not None]
    return Distances(
        distance_m=np.concatenate([part.distance_m for part in parts]),
        gradient=np.concatenate([part.gradient for part in parts]),
        found=np.concatenate([part.found for part in parts]).astype(np.bool_),
        status=np.concatenate([part.status for part in parts]),
        confidence=np.concatenate([part.confidence for part in parts]),
        surface_point=positions(lambda part: part.surface_point),
        unknown_distance_m=np.concatenate(unknown) if unknown else None,
        unknown_point=positions(lambda part: part.unknown_point),
        epoch=parts[0].epoch,
    )
