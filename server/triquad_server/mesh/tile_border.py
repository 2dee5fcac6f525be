"""What a mesh tile was made of on its faces, so that others can meet it there."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TileBorder:
    """Signed distances at lattice points of a tile's faces."""

    points: NDArray[np.int16]  # [P, 3] lattice points of the tile
    values: NDArray[np.float32]  # [P] metres

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return self.points.nbytes + self.values.nbytes

    @classmethod
    def of_tile(cls, points: NDArray[np.int64], volume: NDArray[np.float32]) -> "TileBorder":
        """Those of a tile's lattice points [P, 3] that lie on its faces."""
        last = len(volume) - 1
        outer = points[((points == 0) | (points == last)).any(axis=1)]
        return cls(outer.astype(np.int16), volume[tuple(outer.T)])

    @classmethod
    def joined(cls, borders: Iterable["TileBorder"]) -> "TileBorder":
        """All points of several borders; where one occurs twice, both say the same."""
        parts = list(borders)
        return cls(
            np.concatenate([np.zeros((0, 3), np.int16), *(part.points for part in parts)]),
            np.concatenate([np.zeros(0, np.float32), *(part.values for part in parts)]),
        )

    def seen_from(self, offset: tuple[int, int, int], cells: int) -> "TileBorder":
        """The points that a neighbour shares, in its own lattice.

        Args:
            offset: how many tiles this one lies from the neighbour, each -1, 0 or 1.
            cells: along the side of a tile.
        """
        points = self.points + (np.array(offset) * cells).astype(np.int16)
        shared = ((points >= 0) & (points <= cells)).all(axis=1)
        return TileBorder(points[shared], self.values[shared])

    def put(self, volume: NDArray[np.float32]) -> None:
        """Enter the values where ``volume`` [S, S, S] waits for one (NaN)."""
        places = tuple(self.points.T)
        waits = np.isnan(volume[places])
        volume[tuple(self.points[waits].T)] = self.values[waits]
