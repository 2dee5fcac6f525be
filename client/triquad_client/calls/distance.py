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
            sent.origin,
            sent.offsets,
            reach_m,
            options.surface_point,
            with_unknown_space,
            number,
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
        np.concatenate([part.distance_m for part in parts]),
        np.concatenate([part.gradient for part in parts]),
        np.concatenate([part.found for part in parts]).astype(np.bool_),
        np.concatenate([part.status for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        positions(lambda part: part.surface_point),
        np.concatenate(unknown) if unknown else None,
        positions(lambda part: part.unknown_point),
        parts[0].epoch,
    )
