"""What the rays have shown of a region: sparse voxels in which a surface or free space was seen.

Three planes alias: where all three projections of an unobserved point are occupied, the field
answers as if it had been seen. Only a 3-D record can tell such ghosts from surfaces.

All coordinates here are voxel coordinates of the region (see :mod:`triquad_format.region`).
"""

import numba
import numpy as np
from numpy.typing import NDArray
from triquad_format import morton
from triquad_format.region import BLOCK_BYTES, BLOCK_VOXELS
from triquad_format.region import Evidence as EvidenceRecord
from triquad_format.status import Status

from triquad_server.voxel_index import Index, VoxelIndex, find_row, make_row, pack

Masks = NDArray[np.uint8]

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_LOW = BLOCK_VOXELS - 1
_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


@numba.njit(cache=True, nogil=True)
def _mark(
    voxels: NDArray[np.float64],
    start: int,
    side: int,
    index: Index,
    masks: Masks,
    count: int,
) -> tuple[int, int]:
    """Set the bits of the voxels holding points; returns (points done, blocks in use)."""
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        if min(x, y, z) < 0 or max(x, y, z) >= side:
            continue
        row = make_row(index, count, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
        if row < 0:
            return i, count
        count = max(count, row + 1)
        masks[row, ((x & _LOW) << _SHIFT) | (y & _LOW)] |= np.uint8(1 << (z & _LOW))
    return len(voxels), count


@numba.njit(cache=True, nogil=True)
def _carve(
    origin: NDArray[np.float64],
    ends: NDArray[np.float64],
    start: int,
    stop_short: float,
    side: int,
    index: Index,
    masks: Masks,
    count: int,
) -> tuple[int, int]:
    """Set the bits of the voxels that rays cross (Amanatides and Woo 1987).

    Each ray ends ``stop_short`` voxels before its end point. Returns (rays done, blocks in use).
    """
    for i in range(start, len(ends)):
        direction = ends[i] - origin
        length = np.sqrt((direction * direction).sum())
        if length <= stop_short:
            continue
        direction /= length
        reach = length - stop_short
        x, y, z = int(np.floor(origin[0])), int(np.floor(origin[1])), int(np.floor(origin[2]))
        step = np.empty(3, np.int64)
        delta = np.empty(3)
        crossing = np.empty(3)
        for axis in range(3):
            step[axis] = 1 if direction[axis] > 0 else -1
            delta[axis] = np.inf if direction[axis] == 0 else 1 / abs(direction[axis])
            fraction = origin[axis] - np.floor(origin[axis])
            if direction[axis] > 0:
                fraction = 1 - fraction
            crossing[axis] = np.inf if direction[axis] == 0 else fraction * delta[axis]
        last_key = np.int64(-2)
        row = 0
        travelled = 0.0
        while travelled <= reach:
            if min(x, y, z) >= 0 and max(x, y, z) < side:
                key = pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT)
                if key != last_key:
                    row = make_row(index, count, key)
                    if row < 0:
                        return i, count
                    count = max(count, row + 1)
                    last_key = key
                masks[row, ((x & _LOW) << _SHIFT) | (y & _LOW)] |= np.uint8(1 << (z & _LOW))
            if crossing[0] <= crossing[1] and crossing[0] <= crossing[2]:
                travelled = crossing[0]
                crossing[0] += delta[0]
                x += step[0]
            elif crossing[1] <= crossing[2]:
                travelled = crossing[1]
                crossing[1] += delta[1]
                y += step[1]
            else:
                travelled = crossing[2]
                crossing[2] += delta[2]
                z += step[2]
    return len(ends), count


@numba.njit(cache=True, nogil=True, inline="always")
def _bit(index: Index, masks: Masks, side: int, x: int, y: int, z: int) -> bool:
    if min(x, y, z) < 0 or max(x, y, z) >= side:
        return False
    row = find_row(index, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
    if row < 0:
        return False
    byte = masks[row, ((x & _LOW) << _SHIFT) | (y & _LOW)]
    return bool((byte >> (z & _LOW)) & 1)


@numba.njit(cache=True, nogil=True)
def _status(
    voxels: NDArray[np.float64],
    reach: float,
    side: int,
    index: Index,
    surface: Masks,
    free: Masks,
) -> NDArray[np.uint8]:
    status = np.empty(len(voxels), np.uint8)
    for i in range(len(voxels)):
        low = np.floor(voxels[i] - reach)
        high = np.floor(voxels[i] + reach)
        found = False
        for x in range(int(low[0]), int(high[0]) + 1):
            for y in range(int(low[1]), int(high[1]) + 1):
                for z in range(int(low[2]), int(high[2]) + 1):
                    found = found or _bit(index, surface, side, x, y, z)
                if found:
                    break
            if found:
                break
        if found:
            status[i] = _SURFACE
            continue
        x, y, z = (
            int(np.floor(voxels[i, 0])),
            int(np.floor(voxels[i, 1])),
            int(np.floor(voxels[i, 2])),
        )
        status[i] = _FREE if _bit(index, free, side, x, y, z) else _UNKNOWN
    return status


class Evidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8."""

    def __init__(self, side: int) -> None:
        self._side = side
        self._blocks = VoxelIndex(256)
        self._surface = np.zeros((256, BLOCK_BYTES), np.uint8)
        self._free = np.zeros((256, BLOCK_BYTES), np.uint8)

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return self._blocks.count

    def mark_surface(self, voxels: NDArray[np.float64]) -> None:
        """Record that rays ended at ``voxels`` [N, 3]; those outside the region are left out."""
        done = 0
        while done < len(voxels):
            index, count = self._blocks.arrays, self._blocks.count
            done, self._blocks.count = _mark(voxels, done, self._side, index, self._surface, count)
            if done < len(voxels):
                self._grow()

    def carve(
        self,
        origin: NDArray[np.float64],
        ends: NDArray[np.float64],
        stop_short: float,
    ) -> None:
        """Record the free space between ``origin`` [3] and ``ends`` [N, 3].

        Args:
            origin: sensor position, may lie outside the region.
            ends: end points of the rays.
            stop_short: voxels before its end point where a ray stops to prove free space.
        """
        done = 0
        while done < len(ends):
            index, count = self._blocks.arrays, self._blocks.count
            done, self._blocks.count = _carve(
                origin,
                ends,
                done,
                stop_short,
                self._side,
                index,
                self._free,
                count,
            )
            if done < len(ends):
                self._grow()

    def status(self, voxels: NDArray[np.float64], reach: float = 0.5) -> NDArray[np.uint8]:
        """:class:`Status` values [N] at ``voxels`` [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """
        index = self._blocks.arrays
        return np.asarray(_status(voxels, reach, self._side, index, self._surface, self._free))

    def surface_cells(self) -> NDArray[np.int64]:
        """Blocks [B, 3], in units of blocks, that hold any seen surface."""
        return self._blocks.cells()[self._surface[: self.blocks].any(axis=1)]

    def clear(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Forget the voxels whose centres lie between the corners ``low`` and ``high`` [3]."""
        corners = self._blocks.cells() * BLOCK_VOXELS
        near = ((corners < high) & (corners + BLOCK_VOXELS > low)).all(axis=1)
        offsets = np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), -1)
        for row in np.flatnonzero(near):
            centres = corners[row] + offsets + 0.5
            kept = ~((centres > low) & (centres < high)).all(axis=-1)
            keep = np.packbits(kept, axis=-1, bitorder="little").reshape(BLOCK_BYTES)
            self._surface[row] &= keep
            self._free[row] &= keep

    def copy(self) -> "Evidence":
        """A copy for reading, which later marks do not change."""
        twin = Evidence.__new__(Evidence)
        twin._side, twin._blocks = self._side, self._blocks.copy()
        twin._surface = self._surface[: self.blocks].copy()
        twin._free = self._free[: self.blocks].copy()
        return twin

    def record(self) -> EvidenceRecord:
        """The evidence as the map file holds it; empty blocks are left out."""
        surface, free = self._surface[: self.blocks], self._free[: self.blocks]
        used = np.flatnonzero((surface | free).any(axis=1))
        codes = morton.encode(self._blocks.cells()[used])
        order = np.argsort(codes)
        used = used[order]
        return EvidenceRecord(codes[order], surface[used], free[used])

    @classmethod
    def restore(cls, side: int, record: EvidenceRecord) -> "Evidence":
        """Evidence from its record."""
        evidence = cls(side)
        evidence._blocks = VoxelIndex.of_cells(morton.decode(record.codes, 3))
        shape = (evidence._blocks.capacity, BLOCK_BYTES)
        evidence._surface, evidence._free = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        evidence._surface[: evidence.blocks] = record.surface
        evidence._free[: evidence.blocks] = record.free
        return evidence

    def _grow(self) -> None:
        self._blocks.grow()
        more = np.zeros((self._blocks.capacity - len(self._surface), BLOCK_BYTES), np.uint8)
        self._surface = np.concatenate([self._surface, more])
        self._free = np.concatenate([self._free, more])
