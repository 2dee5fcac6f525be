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

from triquad_server.voxel_index import (
    EMPTY,
    Keys,
    Rows,
    find_slot,
    new_index,
    pack,
    reindex,
    unpack,
)

Masks = NDArray[np.uint8]

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_LOW = BLOCK_VOXELS - 1
_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


@numba.njit(cache=True, nogil=True, inline="always")
def _block_row(keys: Keys, rows: Rows, block_keys: Keys, count: int, key: int) -> int:
    """Row of a block, made at ``count`` where it is new; -1 where there is no more room."""
    slot = find_slot(keys, key)
    if keys[slot] == EMPTY:
        if count == len(block_keys):
            return -1
        keys[slot] = key
        rows[slot] = count
        block_keys[count] = key
    return int(rows[slot])


@numba.njit(cache=True, nogil=True)
def _mark(
    voxels: NDArray[np.float64],
    start: int,
    side: int,
    keys: Keys,
    rows: Rows,
    block_keys: Keys,
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
        row = _block_row(keys, rows, block_keys, count, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
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
    keys: Keys,
    rows: Rows,
    block_keys: Keys,
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
                    row = _block_row(keys, rows, block_keys, count, key)
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
def _bit(keys: Keys, rows: Rows, masks: Masks, side: int, x: int, y: int, z: int) -> bool:
    if min(x, y, z) < 0 or max(x, y, z) >= side:
        return False
    slot = find_slot(keys, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
    if keys[slot] == EMPTY:
        return False
    byte = masks[rows[slot], ((x & _LOW) << _SHIFT) | (y & _LOW)]
    return bool((byte >> (z & _LOW)) & 1)


@numba.njit(cache=True, nogil=True)
def _status(
    voxels: NDArray[np.float64],
    reach: float,
    side: int,
    keys: Keys,
    rows: Rows,
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
                    found = found or _bit(keys, rows, surface, side, x, y, z)
        if found:
            status[i] = _SURFACE
            continue
        x, y, z = (
            int(np.floor(voxels[i, 0])),
            int(np.floor(voxels[i, 1])),
            int(np.floor(voxels[i, 2])),
        )
        status[i] = _FREE if _bit(keys, rows, free, side, x, y, z) else _UNKNOWN
    return status


@numba.njit(cache=True, nogil=True)
def _cells(keys: Keys) -> NDArray[np.int64]:
    cells = np.empty((len(keys), 3), np.int64)
    for i in range(len(keys)):
        cells[i, 0], cells[i, 1], cells[i, 2] = unpack(keys[i])
    return cells


class Evidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8."""

    def __init__(self, side: int) -> None:
        self._side = side
        self._count = 0
        self._allocate(256)

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return self._count

    def mark_surface(self, voxels: NDArray[np.float64]) -> None:
        """Record that rays ended at ``voxels`` [N, 3]; those outside the region are left out."""
        done = 0
        while done < len(voxels):
            done, self._count = _mark(
                voxels,
                done,
                self._side,
                self._keys,
                self._rows,
                self._block_keys,
                self._surface,
                self._count,
            )
            self._reserve(done < len(voxels))

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
            done, self._count = _carve(
                origin,
                ends,
                done,
                stop_short,
                self._side,
                self._keys,
                self._rows,
                self._block_keys,
                self._free,
                self._count,
            )
            self._reserve(done < len(ends))

    def status(
        self,
        voxels: NDArray[np.float64],
        reach: float = 0.5,
    ) -> NDArray[np.uint8]:
        """:class:`Status` values [N] at ``voxels`` [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """
        return np.asarray(
            _status(voxels, reach, self._side, self._keys, self._rows, self._surface, self._free),
        )

    def surface_cells(self) -> NDArray[np.int64]:
        """Blocks [B, 3], in units of blocks, that hold any seen surface."""
        seen = self._surface[: self._count].any(axis=1)
        return np.asarray(_cells(self._block_keys[: self._count][seen]))

    def clear(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Forget the voxels whose centres lie between the corners ``low`` and ``high`` [3]."""
        corners = _cells(self._block_keys[: self._count]) * BLOCK_VOXELS
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
        twin._side, twin._count = self._side, self._count
        twin._keys, twin._rows = self._keys.copy(), self._rows.copy()
        twin._block_keys = self._block_keys[: self._count].copy()
        twin._surface = self._surface[: self._count].copy()
        twin._free = self._free[: self._count].copy()
        return twin

    def record(self) -> EvidenceRecord:
        """The evidence as the map file holds it; empty blocks are left out."""
        used = np.flatnonzero(
            (self._surface[: self._count] | self._free[: self._count]).any(axis=1),
        )
        codes = morton.encode(np.asarray(_cells(self._block_keys[used])))
        order = np.argsort(codes)
        used = used[order]
        return EvidenceRecord(codes[order], self._surface[used], self._free[used])

    @classmethod
    def restore(cls, side: int, record: EvidenceRecord) -> "Evidence":
        """Evidence from its record."""
        evidence = cls(side)
        cells = morton.decode(record.codes, 3)
        evidence._allocate(max(256, 2 * len(cells)))
        for row, (x, y, z) in enumerate(cells):
            evidence._block_keys[row] = pack(x, y, z)
        evidence._count = len(cells)
        evidence._surface[: len(cells)] = record.surface
        evidence._free[: len(cells)] = record.free
        reindex(evidence._block_keys[: len(cells)], evidence._keys, evidence._rows)
        return evidence

    def _allocate(self, capacity: int) -> None:
        self._keys, self._rows = new_index(capacity)
        self._block_keys = np.zeros(capacity, np.int64)
        self._surface = np.zeros((capacity, BLOCK_BYTES), np.uint8)
        self._free = np.zeros((capacity, BLOCK_BYTES), np.uint8)

    def _reserve(self, full: bool) -> None:
        """Double the room where a kernel stopped because it was ``full``."""
        if not full:
            return
        count = self._count
        old = self._block_keys[:count], self._surface[:count], self._free[:count]
        self._allocate(2 * count)
        self._block_keys[:count], self._surface[:count], self._free[:count] = old
        reindex(self._block_keys[:count], self._keys, self._rows)
