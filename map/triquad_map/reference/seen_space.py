"""The nearest unknown voxel of a map: the reference for compiled code."""

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.field_settings import OVERLAP_LEAVES, FieldSettings
from triquad_format.records.region import BLOCK_BYTES, BLOCK_VOXELS, MapRecord, Region, owned_blocks

from triquad_map.nearest import NearestUnknown
from triquad_map.reference.voxel_blocks import VoxelBlocks

_BLOCKS_AT_ONCE = 2048

Doubles = NDArray[np.float64]


class SeenSpace:
    """What rays have shown of a map. The blocks of all regions are cells of one lattice."""

    def __init__(self, record: MapRecord) -> None:
        self._leaf_m = record.settings.leaf_m
        cells = [np.zeros((0, 3), np.int64)]
        masks = [np.zeros((0, BLOCK_BYTES), np.uint8)]
        mine = owned_blocks(record.settings)
        for region in record.regions:
            blocks = morton.decode(region.evidence.codes, 3)
            owned = ((blocks >= mine.start) & (blocks < mine.stop)).all(axis=1)
            cells.append(blocks[owned] + _first_block(record.settings, region))
            masks.append((region.evidence.surface | region.evidence.free)[owned])
        self._blocks = VoxelBlocks(np.concatenate(cells), np.concatenate(masks))

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """The unknown space nearest to ``points`` [N, 3], looked for as far as that."""
        voxels = points / self._leaf_m
        nearest = voxels.copy()
        squares = np.full(len(points), (max_distance_m / self._leaf_m) ** 2)
        homes = np.floor(voxels / BLOCK_VOXELS).astype(np.int64)
        for shell in itertools.count():
            closest = max(0, shell - 1) * BLOCK_VOXELS
            going = np.flatnonzero(squares > closest**2)
            if not len(going):
                break
            for step in _steps(shell):
                self._look(voxels, homes[going] + step, going, squares, nearest)
        return NearestUnknown(np.sqrt(squares) * self._leaf_m, nearest * self._leaf_m)

    def _look(
        self,
        voxels: Doubles,
        cells: NDArray[np.int64],
        going: NDArray[np.intp],
        squares: Doubles,
        nearest: Doubles,
    ) -> None:
        """Look at one block [G, 3] for each of the points ``going`` [G]."""
        low = (cells * BLOCK_VOXELS).astype(np.float64)
        places = np.clip(voxels[going], low, low + BLOCK_VOXELS)
        gaps = ((voxels[going] - places) ** 2).sum(axis=1)
        worth = np.flatnonzero(gaps < squares[going])
        rows = self._blocks.rows(cells[worth])
        absent = worth[rows < 0]
        squares[going[absent]] = gaps[absent]
        nearest[going[absent]] = places[absent]
        there, rows = worth[rows >= 0], rows[rows >= 0]
        for first in range(0, len(there), _BLOCKS_AT_ONCE):
            some = there[first : first + _BLOCKS_AT_ONCE]
            seen = self._blocks.bits(rows[first : first + _BLOCKS_AT_ONCE])
            _look_inside(voxels, low[some], going[some], seen, squares, nearest)


def _look_inside(
    voxels: Doubles,
    low: Doubles,
    going: NDArray[np.intp],
    seen: NDArray[np.bool_],
    squares: Doubles,
    nearest: Doubles,
) -> None:
    """Look at the voxels of blocks from ``low`` [G, 3] on that were not ``seen`` [G, 512]."""
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


def _first_block(settings: FieldSettings, region: Region) -> NDArray[np.int64]:
    """The region's first block [3] in the lattice of the map."""
    pitch = (1 << settings.depth) - OVERLAP_LEAVES
    leaves = np.asarray(region.index, np.int64) * pitch - (1 << (settings.depth - 1))
    return np.asarray(leaves // BLOCK_VOXELS, np.int64)


def _steps(shell: int) -> Iterator[NDArray[np.int64]]:
    """Steps [3] to the blocks of one shell around a block."""
    for step in itertools.product(range(-shell, shell + 1), repeat=3):
        if max(map(abs, step)) == shell:
            yield np.array(step, np.int64)
