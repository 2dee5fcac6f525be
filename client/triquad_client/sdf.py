"""Distance queries of any size, answered from one epoch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format import keys
from triquad_format.messages import SdfReply, SdfRequest

from triquad_client.connection import Connection, Pending, in_flight, retried

PART_POINTS = 100_000
"""Points of one request; a message of this size takes some milliseconds."""


@dataclass(frozen=True)
class SdfResult:
    """What the map says of N points, all of it from one epoch."""

    sdf: NDArray[np.float32]  # [N] metres, positive in free space; NaN where the map has nothing
    status: NDArray[np.uint8]  # [N] Status values
    gradient: NDArray[np.float32] | None  # [N, 3] d(sdf)/dx, map frame, pointing to free space
    epoch: int


class SdfQueries:
    """Splits queries, keeps several parts under way, and joins the answers."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def query(self, points: NDArray[np.float64], gradient: bool) -> SdfResult:
        """The answer for ``points`` [N, 3] of the map frame."""
        # The map may go on while the parts are under way: then all of it is asked again.
        return retried("epoch_gone", lambda: self._query(points, gradient))

    def _query(self, points: NDArray[np.float64], gradient: bool) -> SdfResult:
        first = self._send(points[:PART_POINTS], gradient, 0).result()
        starts = range(PART_POINTS, len(points), PART_POINTS)
        rest = in_flight(
            lambda start: self._send(points[start : start + PART_POINTS], gradient, first.epoch),
            starts,
        )
        return _joined([first, *rest])

    def _send(
        self,
        points: NDArray[np.float64],
        gradient: bool,
        epoch: int,
    ) -> Pending[SdfReply]:
        # The median, so that a few far points do not cost the others their precision.
        origin = np.median(points, axis=0) if len(points) else np.zeros(3)
        offsets = (points - origin).astype(np.float32)
        request = SdfRequest(origin, offsets, gradient, epoch)
        return self._connection.send(keys.SDF, request, SdfReply)


def _joined(parts: list[SdfReply]) -> SdfResult:
    gradients = [part.gradient for part in parts if part.gradient is not None]
    return SdfResult(
        np.concatenate([part.sdf for part in parts]),
        np.concatenate([part.status for part in parts]),
        np.concatenate(gradients) if gradients else None,
        parts[0].epoch,
    )
