"""The values that neighbouring tiles share: distances at the lattice points of their faces."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Floats, Longs

from triquad_map.compiled.kernel import kernel


@dataclass(frozen=True)
class TileBorder:
    """Signed distances at lattice points of a tile's faces, of which the tile was made."""

    points: NDArray[np.int16]  # [P, 3] lattice points of the tile
    values: Floats  # [P] metres

    @classmethod
    def of_tile(cls, points: Longs, volume: Floats) -> "TileBorder":
        """Return the lattice points [P, 3] of a tile that lie on its faces."""
        return cls(*_on_faces(points, volume))

    @classmethod
    def joined(cls, borders: Iterable["TileBorder"]) -> "TileBorder":
        """Return all points of several borders; where one occurs twice, both say the same."""
        parts = list(borders)
        return cls(
            np.concatenate([np.zeros((0, 3), np.int16), *(part.points for part in parts)]),
            np.concatenate([np.zeros(0, np.float32), *(part.values for part in parts)]),
        )

    def seen_from(self, offset: tuple[int, int, int], cells: int) -> "TileBorder":
        """Return the points that a neighbour shares, in its own lattice.

        Args:
            offset: how many tiles this one lies from the neighbour, each -1, 0 or 1.
            cells: along the side of a tile.
        """
        points = self.points + (np.array(offset) * cells).astype(np.int16)
        shared = ((points >= 0) & (points <= cells)).all(axis=1)
        return TileBorder(points[shared], self.values[shared])

    def put(self, volume: Floats) -> None:
        """Enter the values where ``volume`` [S, S, S] waits for one (NaN)."""
        places = tuple(self.points.T)
        waits = np.isnan(volume[places])
        volume[tuple(self.points[waits].T)] = self.values[waits]


@kernel()
def _on_faces(points: Longs, volume: Floats) -> tuple[NDArray[np.int16], Floats]:
    """Return the lattice points [P, 3] of a tile that lie on its faces, and their values."""
    last = len(volume) - 1
    outer = np.empty((len(points), 3), np.int16)
    values = np.empty(len(points), np.float32)
    count = 0
    for point in points:
        x, y, z = point
        if min(x, y, z) == 0 or max(x, y, z) == last:
            outer[count, 0], outer[count, 1], outer[count, 2] = x, y, z
            values[count] = volume[x, y, z]
            count += 1
    return outer[:count].copy(), values[:count].copy()
