"""Questions of any size, answered in parts from one epoch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.wire.messages import MapReply

from triquad_client.net.call import Ask, Call, ask, ask_each, retried

_ORIGIN_SAMPLE = 1000

NEWEST = 0
"""Asks for the newest epoch, a published state of the map; another number pins that epoch."""

ReplyT = TypeVar("ReplyT", bound=MapReply)

Request = Callable[[slice, int], Ask[ReplyT]]
"""What is asked about some of the items, of the epoch of some number."""


@dataclass(frozen=True)
class RelativePoints:
    """Points as they travel."""

    origin: NDArray[np.float64]  # [3] metres, map frame
    offsets: NDArray[np.float32]  # [N, 3] from there


def relative(points: NDArray[np.float64]) -> RelativePoints:
    """Points [N, 3] of the map frame, from an origin among them."""
    # The median, so that a few far points do not cost the others their precision; of a sample,
    # as it takes longer than all the rest.
    some = points[:: max(1, len(points) // _ORIGIN_SAMPLE)]
    origin = np.median(some, axis=0) if len(points) else np.zeros(3)
    return RelativePoints(origin, (points - origin).astype(np.float32))


def in_parts(
    count: int, most: int, request: Request[ReplyT], at_epoch: int | None
) -> Call[Sequence[ReplyT]]:
    """The replies about ``count`` items, ``most`` at a time, all from one epoch.

    ``at_epoch`` is the number of the epoch, already checked; ``None``: the newest.
    """
    if at_epoch is not None:
        return (yield from _in_parts(count, most, request, at_epoch))
    # The map may go on while the parts are under way: then all of it is asked again.
    return (yield from retried("epoch_gone", lambda: _in_parts(count, most, request, NEWEST)))


def _in_parts(
    count: int, most: int, request: Request[ReplyT], epoch: int
) -> Call[Sequence[ReplyT]]:
    first = yield from ask(request(slice(0, most), epoch))
    if count <= most:
        return [first]
    rest = yield from ask_each(
        range(most, count, most), lambda start: request(slice(start, start + most), first.epoch)
    )
    return [first, *rest]
