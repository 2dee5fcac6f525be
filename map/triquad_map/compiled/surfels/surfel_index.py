"""The surfels of a region by place.

Surfels stand in the order of the evidence: block by block, and within a block voxel by voxel.
Blocks that hold any are found by groups, cubes of 4 x 4 x 4 blocks, so that empty space costs
nothing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Floats, Ints, Longs
from triquad_format.records.region import BLOCK_BYTES, BLOCK_VOXELS, surface_counts

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_bits import LOW, SHIFT
from triquad_map.compiled.sparse.voxel_index import Index, VoxelIndex
from triquad_map.surface.surfels import SurfelKind, Surfels

_FAR = 1e6  # voxels
GROUP_SHIFT = 2
GROUP_VOXELS = float(BLOCK_VOXELS << GROUP_SHIFT)


class BlockGroups(NamedTuple):
    """The blocks that hold seen surface, in groups, with the boxes around that.

    A box is its least and its greatest corner, in voxels; surfels reach ``OUTSIDE`` of it.
    """

    places: Index  # of groups
    boxes: Ints  # [groups, 6]
    starts: Ints  # [groups + 1] first member of each
    members: Ints  # [M] rows of blocks
    member_boxes: Floats  # [6, M]


class SurfelIndex(NamedTuple):
    """Surfels as kernels take them."""

    groups: BlockGroups
    starts: Ints  # [blocks + 1] first surfel of each block
    positions: Floats  # [3, surfels] from the block's corner, voxels; far away where there is none
    normals: Floats  # [surfels, 3]
    kinds: Bytes  # [surfels] SurfelKind


@dataclass(frozen=True)
class SurfelPlaces:
    """Where the surfels of the voxels in which rays ended stand."""

    surface: Bytes  # [blocks, BLOCK_BYTES] these voxels
    starts: Ints  # [blocks + 1] first surfel of each block
    voxels: Longs  # [S, 3] voxel of each surfel
    groups: BlockGroups


def surfel_places(cells: Longs, surface: Bytes) -> SurfelPlaces:
    """Places for the voxels in ``surface`` [blocks, BLOCK_BYTES] of blocks at ``cells`` [, 3]."""
    starts = surfel_starts(surface)
    voxels = surfel_voxels(cells, surface, int(starts[-1]))
    return SurfelPlaces(surface, starts, voxels, block_groups(cells, surface))


def surfel_index(places: SurfelPlaces, surfels: Surfels) -> SurfelIndex:
    """The ``surfels`` [S] that stand in some places."""
    positions = (places.voxels % BLOCK_VOXELS).astype(np.float32)
    positions += surfels.offsets + np.float32(0.5)
    positions[surfels.kinds == SurfelKind.NONE] = _FAR
    return SurfelIndex(
        places.groups,
        places.starts,
        np.ascontiguousarray(positions.T),
        surfels.normals,
        surfels.kinds,
    )


def surfel_starts(surface: Bytes) -> Ints:
    """The first surfel [blocks + 1] of the voxels in ``surface`` [blocks, BLOCK_BYTES]."""
    return np.concatenate([[0], np.cumsum(surface_counts(surface))]).astype(np.int32)


@kernel()
def surfel_voxels(cells: Longs, surface: Bytes, count: int) -> Longs:
    """The voxels [count, 3] of surfels, given the blocks' ``cells`` [blocks, 3]."""
    voxels = np.empty((count, 3), np.int64)
    at = 0
    for row in range(len(surface)):
        for byte in range(BLOCK_BYTES):
            bits = int(surface[row, byte])
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxels[at, 0] = (cells[row, 0] << SHIFT) + (byte >> SHIFT)
                    voxels[at, 1] = (cells[row, 1] << SHIFT) + (byte & LOW)
                    voxels[at, 2] = (cells[row, 2] << SHIFT) + z
                    at += 1
    return voxels


@kernel()
def moved_rows(before: Bytes, before_starts: Ints, now: Bytes, count: int) -> Ints:
    """For each surfel [count] of ``now``, its number in ``before``; -1 where it is new.

    Blocks are those of ``before`` and more.
    """
    rows = np.full(count, -1, np.int32)
    at = 0
    for row in range(len(now)):
        known = row < len(before)
        old = before_starts[row] if known else 0
        for byte in range(BLOCK_BYTES):
            bits = int(now[row, byte])
            old_bits = int(before[row, byte]) if known else 0
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    if old_bits >> z & 1:
                        rows[at] = old
                    at += 1
                old += old_bits >> z & 1
    return rows


@kernel()
def _block_boxes(cells: Longs, surface: Bytes, rows: Longs) -> Ints:
    """The boxes [M, 6] around the seen surface of some blocks."""
    boxes = np.empty((len(rows), 6), np.int32)
    for i, row in enumerate(rows):
        for axis in range(3):
            boxes[i, axis], boxes[i, axis + 3] = BLOCK_VOXELS, 0
        for byte in range(BLOCK_BYTES):
            for z in range(BLOCK_VOXELS):
                if surface[row, byte] >> z & 1:
                    for axis, place in enumerate((byte >> SHIFT, byte & LOW, z)):
                        boxes[i, axis] = min(boxes[i, axis], place)
                        boxes[i, axis + 3] = max(boxes[i, axis + 3], place + 1)
        for side in range(6):
            boxes[i, side] += cells[row, side % 3] << SHIFT
    return boxes


def block_groups(cells: Longs, surface: Bytes) -> BlockGroups:
    """The blocks at ``cells`` [blocks, 3] that hold any of ``surface``, in groups."""
    used = np.flatnonzero(surface.any(axis=1))
    codes, owners = np.unique(morton.encode(cells[used] >> GROUP_SHIFT), return_inverse=True)
    order = np.argsort(owners, kind="stable")
    starts = np.searchsorted(owners[order], np.arange(len(codes) + 1))
    boxes = _block_boxes(cells, surface, used[order])
    around = np.zeros((len(codes), 6), np.int32)
    if len(codes):
        around[:, :3] = np.minimum.reduceat(boxes[:, :3], starts[:-1])
        around[:, 3:] = np.maximum.reduceat(boxes[:, 3:], starts[:-1])
    return BlockGroups(
        VoxelIndex.of_cells(morton.decode(codes, 3)).arrays,
        around,
        starts.astype(np.int32),
        used[order].astype(np.int32),
        np.ascontiguousarray(boxes.T, np.float32),
    )
