"""Distance queries of any size, answered from one epoch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format import keys
from triquad_format.messages import SdfReply, SdfRequest

from triquad_client import checks
from triquad_client.call import Ask, Call, ask, ask_each, retried, worked

PART_POINTS = 100_000
"""Points of one request; a message of this size takes some milliseconds."""

_ORIGIN_SAMPLE = 1000

NEWEST = 0
"""Asks for the newest epoch; another number pins the epoch of that number."""


@dataclass(frozen=True)
class SdfResult:
    """What the map says of N points, all of it from one epoch."""

    sdf: NDArray[np.float32]  # [N] metres, positive in free space; NaN where the map has nothing
    status: NDArray[np.uint8]  # [N] Status values
    gradient: NDArray[np.float32] | None  # [N, 3] d(sdf)/dx, map frame, pointing to free space
    epoch: int


def query(points: ArrayLike, gradient: bool, at_epoch: int | None) -> Call[SdfResult]:
    """Distances at ``points`` [N, 3] of the map frame, metres; ``None`` is the newest epoch."""
    if isinstance(points, np.ndarray) and points.size > 3 * PART_POINTS:
        checked = yield from worked(lambda _: checks.query_points(points))
    else:
        checked = checks.query_points(points)
    if at_epoch is not None:
        return (yield from _query(checked, gradient, checks.epoch(at_epoch)))
    # The map may go on while the parts are under way: then all of it is asked again.
    return (yield from retried("epoch_gone", lambda: _query(checked, gradient, NEWEST)))


def pin_newest() -> Call[int]:
    """The newest epoch, once the server keeps it for us: it was asked for by number."""
    nowhere = np.zeros((0, 3))

    def pin() -> Call[int]:
        newest = yield from _query(nowhere, False, NEWEST)
        return (yield from _query(nowhere, False, newest.epoch)).epoch

    return (yield from retried("epoch_gone", pin))


def _query(points: NDArray[np.float64], gradient: bool, epoch: int) -> Call[SdfResult]:
    first = yield from ask(_part(points[:PART_POINTS], gradient, epoch))
    if len(points) <= PART_POINTS:
        return _joined([first])
    rest = yield from ask_each(
        range(PART_POINTS, len(points), PART_POINTS),
        lambda start: _part(points[start : start + PART_POINTS], gradient, first.epoch),
    )
    return (yield from worked(lambda _: _joined([first, *rest])))


def _part(points: NDArray[np.float64], gradient: bool, epoch: int) -> Ask[SdfReply]:
    # The median, so that a few far points do not cost the others their precision; of a sample,
    # as it takes longer than all the rest.
    some = points[:: max(1, len(points) // _ORIGIN_SAMPLE)]
    origin = np.median(some, axis=0) if len(points) else np.zeros(3)
    offsets = (points - origin).astype(np.float32)
    return Ask(keys.SDF, SdfRequest(origin, offsets, gradient, epoch), SdfReply)


def _joined(parts: Sequence[SdfReply]) -> SdfResult:
    gradients = [part.gradient for part in parts if part.gradient is not None]
    return SdfResult(
        np.concatenate([part.sdf for part in parts]),
        np.concatenate([part.status for part in parts]),
        np.concatenate(gradients) if gradients else None,
        parts[0].epoch,
    )
