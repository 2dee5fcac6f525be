"""Which servers of a shared map are asked about places."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire.shares import Shares

_MOST_CELLS = 1000  # that are looked at; of more, all servers are asked


@dataclass(frozen=True)
class SharedPlaces:
    """Finds the servers for points, by the regions in which they lie."""

    shares: Shares
    pitch_m: float  # from the middle of a region to that of the next
    known: Mapping[int, int] = field(default_factory=dict)
    """The epochs of servers that are asked for; they are numbered by time."""

    def owners(self, points: Doubles) -> Longs:
        """Return the servers [N] that answer for points [N, 3].

        Raises:
            RefusedError: ``epoch_gone``: one has taken a region from another since.
        """
        cells = np.floor(points / self.pitch_m + 0.5).astype(np.int64)
        found, back = np.unique(cells, axis=0, return_inverse=True)
        owners = [self._owner((x, y, z)) for x, y, z in found.tolist()]
        return np.array(owners, np.int64)[back.reshape(-1)]

    def near(self, points: Doubles, reach_m: float) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Yield servers, and which points [N, 3] have a region of theirs within reach.

        Of points that have one region alone within reach, none is yielded.
        """
        low, high = (
            np.floor((points + off_m) / self.pitch_m + 0.5).astype(np.int64)
            for off_m in (-reach_m, reach_m)
        )
        border = np.flatnonzero((low != high).any(axis=1))
        boxes = np.concatenate([low[border], high[border]], axis=1)
        found, back = np.unique(boxes, axis=0, return_inverse=True)
        for number, corners in enumerate(found.tolist()):
            ranges = [range(corners[axis], corners[axis + 3] + 1) for axis in range(3)]
            rows = border[back.reshape(-1) == number]
            yield from ((holder, rows) for holder in self._holders(ranges))

    def _holders(self, ranges: list[range]) -> frozenset[int]:
        """Return who has a region of some, by their ranges along each axis."""
        if math.prod(map(len, ranges)) > _MOST_CELLS:
            return self.shares.numbers
        cells = itertools.product(*ranges)
        return frozenset(one for x, y, z in cells for one in self.shares.holders((x, y, z)))

    def _owner(self, index: RegionIndex) -> int:
        number = self.shares.answering(index)
        if number is None:
            return 1  # none is there, and that one does not answer
        asked_ms = self.known.get(number, max(self.known.values(), default=math.inf))
        if self.shares.taken_ms(index) > asked_ms:
            raise RefusedError(
                "epoch_gone", f"region {index} is another server's by now: ask the newest"
            )
        return number
