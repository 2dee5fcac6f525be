"""The evidence of a region, found with numpy alone."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import (
    BLOCK_BYTES,
    MARGIN_BITS,
    Evidence,
    seen_voxels,
    surface_counts,
)
from triquad_format.records.status import Status

from triquad_map.reference.coded_rows import ONE_CELL, CodedRows
from triquad_map.surface import MARGIN_STEP

_BLOCKS_AT_ONCE = 2048

_VOXEL_BITS = 3 * (BLOCK_VOXELS.bit_length() - 1)
"""The bits that the code of a voxel is longer than that of its block."""


class SeenBlocks:
    """The evidence of a region, in leaf coordinates."""

    def __init__(self, settings: FieldSettings, shift: int = ONE_CELL) -> None:
        """Take the ``shift`` of the cells in which evidence is added, see :class:`CodedRows`."""
        self._side = 1 << settings.depth
        self._surface = CodedRows(BLOCK_BYTES, np.uint8, shift)
        self._free = CodedRows(BLOCK_BYTES, np.uint8, shift)
        self._margins = CodedRows(len(MARGIN_BITS), np.uint8, min(shift + _VOXEL_BITS, ONE_CELL))
        self.newest_s = 0  # when a ray last ended anywhere, seconds since 1970

    def add(self, evidence: Evidence) -> None:
        """Add the evidence of some cells."""
        self._surface.add(evidence.codes, evidence.surface)
        self._free.add(evidence.codes, evidence.free)
        voxels = seen_voxels(evidence, evidence.surface) % BLOCK_VOXELS
        blocks = evidence.codes.repeat(surface_counts(evidence.surface))
        self._margins.add(_voxel_codes(blocks, voxels), evidence.margins)
        self.newest_s = max(self.newest_s, int(evidence.seen_s.max(initial=0)))

    def status(self, voxels: Doubles, reach: float) -> Bytes:
        """Return status values [N]; see :class:`triquad_map.composition.region.SeenSpace`."""
        free = self._holds(self._free, np.floor(voxels).astype(np.int64))
        status = np.where(free, Status.FREE, Status.UNKNOWN).astype(np.uint8)
        low = np.floor(voxels - reach).astype(np.int64)
        high = np.floor(voxels + reach).astype(np.int64)
        steps = range(int((high - low).max(initial=0)) + 1)
        for step in itertools.product(steps, repeat=3):
            status[self.ended_in(np.minimum(low + step, high))] = Status.SURFACE
        return status

    def surface_in_grid(self, axes: Sequence[Doubles], reach: float) -> Bools:
        """Find surface in a grid; see :class:`triquad_map.composition.region.SeenSpace`."""
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        surface = self.status(places.reshape(-1, 3), reach) == Status.SURFACE
        return np.asarray(surface.reshape(places.shape[:-1]))

    def ended_in(self, voxels: Longs) -> Bools:
        """Return whether rays ended in ``voxels`` [N, 3]."""
        return self._holds(self._surface, voxels)

    def near_ends(self, voxels: Doubles, reach: float) -> Bools:
        """Return where rays ended; see :class:`triquad_map.composition.region.SeenSpace`."""
        near = np.zeros(len(voxels), np.bool_)
        low = np.floor(voxels - reach).astype(np.int64)
        high = np.floor(voxels + reach).astype(np.int64)
        steps = range(int((high - low).max(initial=0)) + 1)
        for step in itertools.product(steps, repeat=3):
            places = np.minimum(low + step, high)
            rows = np.flatnonzero(~near & self.ended_in(places))
            inside, margins = voxels[rows] - places[rows], self._margins_of(places[rows])
            depths = np.hstack([inside, 1 - inside])
            near[rows] = ~((margins > 0) & (depths < MARGIN_STEP * margins)).any(axis=1)
        return near

    def _margins_of(self, voxels: Longs) -> Bytes:
        """Return the margins [N, 6] of voxels [N, 3]; 0 where none are known."""
        blocks, inner = np.divmod(voxels, BLOCK_VOXELS)
        codes = _voxel_codes(morton.encode(blocks), inner)
        return np.asarray(self._margins.find(codes).rows, np.uint8)

    def find_unknown(
        self, voxels: Doubles, blocks: range, distances: Doubles, nearest: Doubles
    ) -> None:
        """Find unknown voxels; see :class:`triquad_map.composition.region.SeenSpace`."""
        squares = distances**2
        homes = np.floor(voxels / BLOCK_VOXELS).astype(np.int64)
        for shell in itertools.count():
            closest = max(0, shell - 1) * BLOCK_VOXELS
            going = np.flatnonzero(squares > closest**2)
            if not len(going):
                break
            for step in _steps(shell):
                cells = homes[going] + step
                mine = ((cells >= blocks.start) & (cells < blocks.stop)).all(axis=1)
                self._search_blocks(
                    voxels, cells[mine], going[mine], squares=squares, nearest=nearest
                )
        found = squares < distances**2
        distances[found] = np.sqrt(squares[found])

    def _search_blocks(
        self,
        voxels: Doubles,
        cells: Longs,
        going: NDArray[np.intp],
        squares: Doubles,
        nearest: Doubles,
    ) -> None:
        """Search one block [G, 3] for each of the points ``going`` [G]."""
        low = (cells * BLOCK_VOXELS).astype(np.float64)
        places = np.clip(voxels[going], low, low + BLOCK_VOXELS)
        gaps = ((voxels[going] - places) ** 2).sum(axis=1)
        worth = np.flatnonzero(gaps < squares[going])
        codes = morton.encode(cells[worth])
        surface, free = self._surface.find(codes), self._free.find(codes)
        there, absent = worth[surface.there], worth[~surface.there]
        squares[going[absent]] = gaps[absent]
        nearest[going[absent]] = places[absent]
        masks = (surface.rows | free.rows)[surface.there]
        for first in range(0, len(there), _BLOCKS_AT_ONCE):
            some = there[first : first + _BLOCKS_AT_ONCE]
            bits = np.unpackbits(masks[first : first + _BLOCKS_AT_ONCE], axis=1, bitorder="little")
            seen = bits.astype(np.bool_)
            _search_inside(
                voxels, low[some], going[some], seen=seen, squares=squares, nearest=nearest
            )

    def _holds(self, masks: CodedRows, voxels: Longs) -> Bools:
        """Return whether the bits of voxels [N, 3] are set."""
        inside = np.all((voxels >= 0) & (voxels < self._side), axis=1)
        blocks, inner = np.divmod(np.where(inside[:, None], voxels, 0), BLOCK_VOXELS)
        found = masks.find(morton.encode(blocks))
        octets = found.rows[np.arange(len(voxels)), inner[:, 0] * BLOCK_VOXELS + inner[:, 1]]
        return np.asarray(inside & (octets >> inner[:, 2] & 1 == 1), np.bool_)


def _search_inside(
    voxels: Doubles,
    low: Doubles,
    going: NDArray[np.intp],
    seen: Bools,
    squares: Doubles,
    nearest: Doubles,
) -> None:
    """Search the voxels of blocks from ``low`` [G, 3] on that were not ``seen`` [G, 512]."""
    inner = np.stack(np.unravel_index(np.arange(seen.shape[1]), (BLOCK_VOXELS,) * 3), axis=1)
    corners = low[:, None] + inner  # [G, 512, 3]
    places = np.clip(voxels[going][:, None], corners, corners + 1.0)
    gaps = ((voxels[going][:, None] - places) ** 2).sum(axis=2)
    gaps[seen] = np.inf
    best = gaps.argmin(axis=1)
    each = np.arange(len(going))
    nearer = gaps[each, best] < squares[going]
    rows = going[nearer]
    squares[rows] = gaps[each, best][nearer]
    nearest[rows] = places[each, best][nearer]


def _voxel_codes(blocks: Longs, inner: Longs) -> Longs:
    """Return codes [N] of voxels, by codes of their blocks [N] and places in these [N, 3]."""
    codes: Longs = (blocks << _VOXEL_BITS) + inner @ (BLOCK_VOXELS**2, BLOCK_VOXELS, 1)
    return codes


def _steps(shell: int) -> Iterator[Longs]:
    """Yield steps [3] to the blocks of one shell around a block."""
    for step in itertools.product(range(-shell, shell + 1), repeat=3):
        if max(map(abs, step)) == shell:
            yield np.array(step, np.int64)
