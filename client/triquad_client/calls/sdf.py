"""Distance queries of any size, answered from one epoch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.wire import keys
from triquad_format.wire.messages import SdfReply, SdfRequest

from triquad_client import checks
from triquad_client.net.call import Ask, Call, ask, offload, retried
from triquad_client.net.parts import NEWEST, in_parts, relative

PART_POINTS = 100_000
"""Points of one request; a message of this size takes some milliseconds."""


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
        checked = yield from offload(lambda _: checks.query_points(points))
    else:
        checked = checks.query_points(points)
    epoch = checks.chosen_epoch(at_epoch)

    def request(part: slice, number: int) -> Ask[SdfReply]:
        return _ask(checked[part], gradient, number)

    parts = yield from in_parts(len(checked), PART_POINTS, request, epoch)
    return _joined(parts) if len(parts) == 1 else (yield from offload(lambda _: _joined(parts)))


def pin_newest() -> Call[int]:
    """The newest epoch, once the server keeps it for us: it was asked for by number."""
    nowhere = np.zeros((0, 3))

    def pin() -> Call[int]:
        newest = yield from ask(_ask(nowhere, False, NEWEST))
        return (yield from ask(_ask(nowhere, False, newest.epoch))).epoch

    return (yield from retried("epoch_gone", pin))


def _ask(points: NDArray[np.float64], gradient: bool, epoch: int) -> Ask[SdfReply]:
    sent = relative(points)
    request = SdfRequest(origin=sent.origin, points=sent.offsets, gradient=gradient, epoch=epoch)
    return Ask(keys.SDF, request, SdfReply)


def _joined(parts: Sequence[SdfReply]) -> SdfResult:
    gradients = [part.gradient for part in parts if part.gradient is not None]
    return SdfResult(
        sdf=np.concatenate([part.sdf for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        gradient=np.concatenate(gradients) if gradients else None,
        epoch=parts[0].epoch,
    )
