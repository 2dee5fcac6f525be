"""What the rays have shown of a region: sparse voxels in which a surface or free space was seen.

Three planes alias: where all three projections of an unobserved point are occupied, the field
answers as if it had been seen. Only a 3-D record can tell such ghosts from surfaces.

All coordinates here are voxel coordinates of the region (see :mod:`triquad_format.records.region`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.evidence_voxels import surface_counts
from triquad_format.records.region import BLOCK_BYTES, BLOCK_VOXELS
from triquad_format.records.region import Evidence as EvidenceRecord
from triquad_format.records.status import Status

from triquad_map.compiled.evidence.observations import Observations, Sighting
from triquad_map.compiled.evidence.unknown_search import SeenSpace, find_unknown
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.rows import with_room
from triquad_map.compiled.sparse.voxel_index import Index, VoxelIndex, find_row, make_row, pack

Masks = NDArray[np.uint8]

_SHIFT = BLOCK_VOXELS.bit_length() - 1
_LOW = BLOCK_VOXELS - 1
_SEEN_STEP_S = 60
_SURFACE = np.uint8(Status.SURFACE)
_FREE = np.uint8(Status.FREE)
_UNKNOWN = np.uint8(Status.UNKNOWN)


@kernel()
def _mark(
    voxels: NDArray[np.float64],
    start: int,
    side: int,
    index: Index,
    masks: Masks,
    count: int,
    new: NDArray[np.int64],
    found: int,
) -> tuple[int, int, int]:
    """Set the bits of the voxels holding points, and collect those that were not set before.

    Returns (points done, blocks in use, voxels collected).
    """
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        if min(x, y, z) < 0 or max(x, y, z) >= side:
            continue
        row = make_row(index, count, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
        if row < 0:
            return i, count, found
        count = max(count, row + 1)
        byte = ((x & _LOW) << _SHIFT) | (y & _LOW)
        bit = np.uint8(1 << (z & _LOW))
        if not masks[row, byte] & bit:
            masks[row, byte] |= bit
            new[found, 0], new[found, 1], new[found, 2] = x, y, z
            found += 1
    return len(voxels), count, found


@kernel(inline="always")
def _crossing(origin: float, direction: float) -> tuple[int, float, float]:
    """Which way a ray steps on an axis, how far apart its crossings are, and how far the first."""
    if direction == 0:
        return 1, np.inf, np.inf
    fraction = origin - np.floor(origin)
    if direction > 0:
        return 1, 1 / direction, (1 - fraction) / direction
    return -1, -1 / direction, -fraction / direction


@kernel(inline="always")
def _inside(origin: float, direction: float, side: int) -> tuple[float, float]:
    """How far along a ray it enters and leaves the region on an axis."""
    if direction == 0:
        return (-np.inf, np.inf) if 0 <= origin <= side else (np.inf, -np.inf)
    a, b = -origin / direction, (side - origin) / direction
    return min(a, b), max(a, b)


@kernel()
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
        dx, dy, dz = ends[i, 0] - origin[0], ends[i, 1] - origin[1], ends[i, 2] - origin[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= stop_short:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        # Only the part of the ray that lies in the region.
        enters_x, leaves_x = _inside(origin[0], dx, side)
        enters_y, leaves_y = _inside(origin[1], dy, side)
        enters_z, leaves_z = _inside(origin[2], dz, side)
        first = max(0.0, enters_x, enters_y, enters_z)
        reach = min(length - stop_short, leaves_x, leaves_y, leaves_z)
        start_x, start_y, start_z = (
            origin[0] + first * dx,
            origin[1] + first * dy,
            origin[2] + first * dz,
        )
        x, y, z = int(np.floor(start_x)), int(np.floor(start_y)), int(np.floor(start_z))
        step_x, apart_x, next_x = _crossing(start_x, dx)
        step_y, apart_y, next_y = _crossing(start_y, dy)
        step_z, apart_z, next_z = _crossing(start_z, dz)
        next_x, next_y, next_z = next_x + first, next_y + first, next_z + first
        row = -1
        entered = True  # another block
        travelled = first
        while travelled <= reach:
            if entered:
                row = -1
                if min(x, y, z) >= 0 and max(x, y, z) < side:
                    row = make_row(index, count, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))
                    if row < 0:
                        return i, count
                    count = max(count, row + 1)
            if row >= 0:
                masks[row, ((x & _LOW) << _SHIFT) | (y & _LOW)] |= np.uint8(1 << (z & _LOW))
            if next_x <= next_y and next_x <= next_z:
                travelled = next_x
                next_x += apart_x
                x += step_x
                entered = (x & _LOW) == (0 if step_x > 0 else _LOW)
            elif next_y <= next_z:
                travelled = next_y
                next_y += apart_y
                y += step_y
                entered = (y & _LOW) == (0 if step_y > 0 else _LOW)
            else:
                travelled = next_z
                next_z += apart_z
                z += step_z
                entered = (z & _LOW) == (0 if step_z > 0 else _LOW)
    return len(ends), count


@kernel(inline="always")
def _block_of(index: Index, x: int, y: int, z: int, side: int) -> int:
    """Row of the block that holds a voxel, -1 where there is none."""
    if min(x, y, z) < 0 or max(x, y, z) >= side:
        return -1
    return find_row(index, pack(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT))


@kernel(inline="always")
def _bit(masks: Masks, row: int, x: int, y: int, z: int) -> int:
    """Whether the bit of a voxel is set in the block ``row``: 0 or 1."""
    byte = masks[row, ((x & _LOW) << _SHIFT) | (y & _LOW)]
    bit: int = (byte >> (z & _LOW)) & 1
    return bit


@kernel()
def _status(
    voxels: NDArray[np.float64],
    reach: float,
    side: int,
    index: Index,
    surface: Masks,
    free: Masks,
    status: NDArray[np.uint8],
) -> None:
    for i in range(len(voxels)):
        x0, x1 = int(np.floor(voxels[i, 0] - reach)), int(np.floor(voxels[i, 0] + reach))
        y0, y1 = int(np.floor(voxels[i, 1] - reach)), int(np.floor(voxels[i, 1] + reach))
        z0, z1 = int(np.floor(voxels[i, 2] - reach)), int(np.floor(voxels[i, 2] + reach))
        found = 0
        row = _block_of(index, x0, y0, z0, side)
        block = (x0 >> _SHIFT, y0 >> _SHIFT, z0 >> _SHIFT)
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    here = (x >> _SHIFT, y >> _SHIFT, z >> _SHIFT)
                    if here != block:
                        row = _block_of(index, x, y, z, side)
                        block = here
                    if row >= 0:
                        found |= _bit(surface, row, x, y, z)
            if found:
                break
        status[i] = _UNKNOWN
        if found:
            status[i] = _SURFACE
            continue
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        row = _block_of(index, x, y, z, side)
        if row >= 0 and _bit(free, row, x, y, z):
            status[i] = _FREE


@kernel()
def _ended_in(
    voxels: NDArray[np.int64], side: int, index: Index, surface: Masks, ended: NDArray[np.bool_]
) -> None:
    for i in range(len(voxels)):
        x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
        row = _block_of(index, x, y, z, side)
        ended[i] = row >= 0 and _bit(surface, row, x, y, z) == 1


@dataclass(frozen=True)
class _Noted:
    """What observations come down to."""

    levels: NDArray[np.uint8]
    seen_s: NDArray[np.int64]


class Evidence:
    """Two bit masks over the voxels of a region, in sparse blocks of 8 x 8 x 8."""

    def __init__(self, side: int) -> None:
        self._side = side
        self._twin: Evidence | None = None  # a copy for reading, until anything is recorded
        self._blocks = VoxelIndex(256)
        self._surface = np.zeros((256, BLOCK_BYTES), np.uint8)
        self._free = np.zeros((256, BLOCK_BYTES), np.uint8)
        self._observations = Observations(256)
        self._noted: _Noted | None = None  # of a copy for reading, instead of observations

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return self._blocks.count

    def mark_surface(
        self, voxels: NDArray[np.float64], sighting: Sighting | None = None
    ) -> NDArray[np.int64]:
        """Record that rays ended at ``voxels`` [N, 3]; those outside the region are left out.

        ``sighting`` tells from where and when; without it they support the surface no better.

        Returns:
            The voxels [M, 3] in which no ray had ended before.
        """
        self._twin = None
        new = np.empty((len(voxels), 3), np.int64)
        done = found = 0
        while done < len(voxels):
            done, self._blocks.count, found = _mark(
                voxels,
                done,
                self._side,
                self._blocks.arrays,
                self._surface,
                self._blocks.count,
                new,
                found,
            )
            if done < len(voxels):
                self._grow()
        if sighting is not None:
            self._observations.note(voxels, self._side, self._blocks.arrays, sighting)
        return new[:found]

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
        self._twin = None
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
        status = np.empty(len(voxels), np.uint8)
        index = self._blocks.arrays
        _status(voxels, reach, self._side, index, self._surface, self._free, status)
        return status

    @property
    def index(self) -> Index:
        """The blocks, by place."""
        return self._blocks.arrays

    @property
    def cells(self) -> NDArray[np.int64]:
        """The blocks [B, 3], by row, in units of blocks."""
        return self._blocks.cells()

    @property
    def surface(self) -> Masks:
        """The voxels in which rays ended [B, BLOCK_BYTES]; not to be changed."""
        return self._surface[: self.blocks]

    def levels(self) -> NDArray[np.uint8]:
        """How well each voxel in :attr:`surface` is supported, in their order."""
        return self._noted.levels if self._noted else self._observations.levels(self.surface)

    def seen_s(self) -> NDArray[np.int64]:
        """When a ray last ended in each block [B], seconds since 1970; 0: never."""
        return self._noted.seen_s if self._noted else self._observations.seen_s(self.blocks)

    def ended_in(self, voxels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether rays ended in ``voxels`` [N, 3]."""
        ended = np.empty(len(voxels), np.bool_)
        _ended_in(voxels, self._side, self._blocks.arrays, self._surface, ended)
        return ended

    def find_unknown(
        self,
        voxels: NDArray[np.float64],
        cells: tuple[int, int],
        distances: NDArray[np.float64],
        nearest: NDArray[np.float64],
    ) -> None:
        """Find unknown voxels near ``voxels`` [N, 3]; see :func:`unknown_search.find_unknown`."""
        seen = SeenSpace(self._blocks.arrays, self._surface, self._free)
        find_unknown(voxels, seen, cells, distances, nearest)

    def surface_cells(self) -> NDArray[np.int64]:
        """Blocks [B, 3], in units of blocks, that hold any seen surface."""
        return self._blocks.cells()[self._surface[: self.blocks].any(axis=1)]

    def clear(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Forget the voxels whose centres lie between the corners ``low`` and ``high`` [3]."""
        self._twin = None
        corners = self._blocks.cells() * BLOCK_VOXELS
        near = ((corners < high) & (corners + BLOCK_VOXELS > low)).all(axis=1)
        offsets = np.stack(np.meshgrid(*[np.arange(BLOCK_VOXELS)] * 3, indexing="ij"), -1)
        for row in np.flatnonzero(near):
            centres = corners[row] + offsets + 0.5
            kept = ~((centres > low) & (centres < high)).all(axis=-1)
            keep = np.packbits(kept, axis=-1, bitorder="little").reshape(BLOCK_BYTES)
            self._surface[row] &= keep
            self._free[row] &= keep
        self._observations.forget(np.flatnonzero(near), self.surface)

    def copy(self) -> "Evidence":
        """A copy for reading, which later marks do not change."""
        if self._twin is None:
            twin = Evidence(self._side)
            twin._blocks = self._blocks.copy()
            twin._surface = self._surface[: self.blocks].copy()
            twin._free = self._free[: self.blocks].copy()
            twin._noted = _Noted(self.levels(), self.seen_s())
            self._twin = twin
        return self._twin

    def record(self) -> EvidenceRecord:
        """The evidence as the map file holds it; empty blocks are left out."""
        surface, free = self._surface[: self.blocks], self._free[: self.blocks]
        used = np.flatnonzero((surface | free).any(axis=1))
        codes = morton.encode(self._blocks.cells()[used])
        order = np.argsort(codes)
        used = used[order]
        counts = surface_counts(surface)
        firsts = np.cumsum(counts) - counts
        # The levels block by block, in the order of the record.
        runs = np.repeat(firsts[used] - (np.cumsum(counts[used]) - counts[used]), counts[used])
        levels = self.levels()[runs + np.arange(len(runs))]
        # In whole minutes: else each scan would change every part that it sees.
        seen_s = np.where(counts > 0, self.seen_s() // _SEEN_STEP_S * _SEEN_STEP_S, 0)
        return EvidenceRecord(codes[order], surface[used], free[used], levels, seen_s[used])

    @classmethod
    def recorded(cls, side: int, record: EvidenceRecord) -> "Evidence":
        """Evidence from its record, for reading."""
        evidence = cls(side)
        evidence._blocks = VoxelIndex.of_cells(morton.decode(record.codes, 3))
        evidence._surface = with_room(record.surface, evidence._blocks.capacity)
        evidence._free = with_room(record.free, evidence._blocks.capacity)
        levels, seen_s = record.levels, record.seen_s
        if levels is None:
            levels = np.zeros(int(surface_counts(record.surface).sum()), np.uint8)
        if seen_s is None:
            seen_s = np.zeros(len(record.codes), np.int64)
        evidence._noted = _Noted(levels, seen_s)
        return evidence

    @classmethod
    def restore(cls, side: int, record: EvidenceRecord) -> "Evidence":
        """Evidence from its record, for going on."""
        evidence = cls.recorded(side, record)
        assert evidence._noted is not None
        if record.levels is not None:
            evidence._observations = Observations.restore(
                record.surface, record.levels, evidence._noted.seen_s
            )
        evidence._noted = None
        return evidence

    def _grow(self) -> None:
        self._blocks.grow()
        self._surface = with_room(self._surface, self._blocks.capacity)
        self._free = with_room(self._free, self._blocks.capacity)
