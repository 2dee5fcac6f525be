"""Questions in parts that are asked of one epoch, and the replies joined."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire.codec import Request
from triquad_format.wire.messages import MapReply

from triquad_client import checks
from triquad_client.errors import BadReplyError
from triquad_client.net.connection import NEWEST, Answering, retried

_ORIGIN_SAMPLE = 1000  # points

MapReplyT = TypeVar("MapReplyT", bound=MapReply)


@dataclass(frozen=True)
class Part:
    """What one request asks about: some of the items of a question, of one epoch."""

    rows: slice
    epoch: int
    origin: Doubles  # [3] metres, map frame: positions travel relative to it, in single precision

    def offsets(self, points: Doubles) -> Floats:
        """Return this part of the points [N, 3] of the question, as they travel."""
        return (points[self.rows] - self.origin).astype(np.float32)


@dataclass(frozen=True)
class Answered(Generic[MapReplyT]):
    """The parts of a question, and the reply to each, all from one epoch."""

    parts: Sequence[Part]
    replies: Sequence[MapReplyT]

    def joined(
        self,
        *,
        flags: Sequence[str] = (),
        flat: Sequence[str] = (),
        placed: Sequence[str] = (),
        asked_for: Mapping[str, bool] | None = None,
    ) -> dict[str, Any]:
        """Return the fields of the replies as one, arrays end to end, as a result takes them.

        Args:
            flags: fields that become truth values.
            flat: fields of several axes that become one, as parts of a grid differ in all of them.
            placed: fields of positions relative to the origin of the part, or ``None``.
            asked_for: fields that are there on request, and whether they were; results have them
                under the same name with an underscore before it, and ``None`` where they were not.

        Raises:
            BadReplyError: the replies do not fit together, or lack what was asked for.
        """
        try:
            fields = {
                name: self._end_to_end(name, flat=name in flat)
                if isinstance(value, np.ndarray)
                else value
                for name, value in vars(self.replies[0]).items()
            }
        except ValueError as error:
            raise BadReplyError(f"the replies about parts do not fit together: {error}") from error
        for name in placed:
            if fields[name] is not None:
                counts = [len(getattr(reply, name)) for reply in self.replies]
                origins = np.repeat([part.origin for part in self.parts], counts, axis=0)
                fields[name] = fields[name] + origins
        for name, wanted in (asked_for or {}).items():
            part = fields.pop(name)
            if wanted and part is None:
                raise BadReplyError(f"the reply lacks {name}, which was asked for")
            fields[f"_{name}"] = part if wanted else None
        return fields | {flag: fields[flag].astype(np.bool_) for flag in flags}

    def _end_to_end(self, name: str, *, flat: bool) -> NDArray[Any]:
        arrays = [getattr(reply, name) for reply in self.replies]
        return np.concatenate([array.reshape(-1) for array in arrays] if flat else arrays)


class Asking:
    """Asks about a map: of its newest epoch, or always of the same one."""

    _server: Answering
    """What answers all of one question."""

    _epoch: int | None = None
    """The epoch that is asked where a question names none; ``None``: the newest."""

    def _in_parts(
        self,
        request: Callable[[Part], Request[MapReplyT]],
        places: Doubles,
        *,
        most: int,
        at_epoch: int | None,
    ) -> Answered[MapReplyT]:
        """Return the replies about items at ``places`` [N, 3], ``most`` at a time.

        Raises:
            InvalidInputError: ``at_epoch`` is neither the number of an epoch nor ``None``.
        """
        epoch, server = self._chosen(at_epoch), self._server

        def part(start: int, epoch: int) -> Part:
            rows = slice(start, start + most)
            return Part(rows, epoch, _origin_of(places[rows]))

        def answered() -> Answered[MapReplyT]:
            first = part(0, epoch)
            (reply,) = server.replies([request(first)])
            rest = [part(start, reply.epoch) for start in range(most, len(places), most)]
            replies = server.replies(request(each) for each in rest)
            return Answered([first, *rest], [reply, *replies])

        # The map may go on while the parts are under way: then all of it is asked again.
        return retried("epoch_gone", answered) if epoch == NEWEST else answered()

    def _chosen(self, at_epoch: int | None) -> int:
        """Return the number of the epoch to ask."""
        return checks.chosen_epoch(self._epoch if at_epoch is None else at_epoch)


def _origin_of(points: Doubles) -> Doubles:
    """Return an origin [3] among points [N, 3], from which they travel in single precision."""
    if not len(points):
        return np.zeros(3)
    # The median, so that a few far points do not cost the others their precision; of a sample,
    # as it takes longer than all the rest.
    some = points[:: max(1, len(points) // _ORIGIN_SAMPLE)]
    middle = len(some) // 2
    return np.asarray(np.partition(some, middle, axis=0)[middle])
