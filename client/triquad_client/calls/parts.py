"""A question in parts that are asked of one epoch, and the replies joined."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire.messages import MapReply

from triquad_client import checks
from triquad_client.errors import BadReplyError
from triquad_client.net.call import NEWEST, Ask, Call, ask, ask_each, retried

_ORIGIN_SAMPLE = 1000  # points

MapReplyT = TypeVar("MapReplyT", bound=MapReply)


def in_parts(
    request: Callable[[slice, int], Ask[MapReplyT]], count: int, *, most: int, at_epoch: int | None
) -> Call[Sequence[MapReplyT]]:
    """Return the replies about ``count`` items, ``most`` at a time, all from one epoch.

    ``request`` makes what is asked about some of the items, of the epoch of some number.

    Raises:
        InvalidInputError: ``at_epoch`` is neither the number of an epoch nor ``None``, the newest.
    """

    # Its annotation is quoted: it would be evaluated again with each call.
    def parts(epoch: int) -> "Call[Sequence[MapReplyT]]":
        first = yield from ask(request(slice(0, most), epoch))
        if count <= most:
            return [first]
        rest = yield from ask_each(
            range(most, count, most), lambda start: request(slice(start, start + most), first.epoch)
        )
        return [first, *rest]

    epoch = checks.chosen_epoch(at_epoch)
    if epoch != NEWEST:
        return (yield from parts(epoch))
    # The map may go on while the parts are under way: then all of it is asked again.
    return (yield from retried("epoch_gone", lambda: parts(NEWEST)))


def joined(
    replies: Sequence[MapReply],
    *,
    flags: Sequence[str] = (),
    asked_for: Mapping[str, bool] | None = None,
) -> dict[str, Any]:
    """Return the fields of replies about parts as one, arrays end to end, as a result takes them.

    Args:
        replies: one or more.
        flags: fields that become truth values.
        asked_for: fields that are there on request, and whether they were; results have them under
            the same name with an underscore before it, and ``None`` where they were not.

    Raises:
        BadReplyError: the replies do not fit together, or lack what was asked for.
    """
    try:
        fields = {
            name: np.concatenate([getattr(reply, name) for reply in replies])
            if isinstance(value, np.ndarray)
            else value
            for name, value in vars(replies[0]).items()
        }
    except ValueError as error:
        raise BadReplyError(f"the replies about parts do not fit together: {error}") from error
    for name, wanted in (asked_for or {}).items():
        part = fields.pop(name)
        if wanted and part is None:
            raise BadReplyError(f"the reply lacks {name}, which was asked for")
        fields[f"_{name}"] = part if wanted else None
    return fields | {flag: fields[flag].astype(np.bool_) for flag in flags}


def origin_of(points: Doubles) -> Doubles:
    """Return an origin [3] among points [N, 3], from which they travel in single precision."""
    if not len(points):
        return np.zeros(3)
    # The median, so that a few far points do not cost the others their precision; of a sample,
    # as it takes longer than all the rest.
    some = points[:: max(1, len(points) // _ORIGIN_SAMPLE)]
    middle = len(some) // 2
    return np.asarray(np.partition(some, middle, axis=0)[middle])


def offsets_from(points: Doubles, origin: Doubles) -> Floats:
    """Return points [N, 3] as they travel: relative to an origin [3]."""
    return (points - origin).astype(np.float32)
