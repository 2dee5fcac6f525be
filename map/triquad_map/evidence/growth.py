"""The growth of evidence by the rays of a scan, counted before any is recorded."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import (
    Index,
    block_key,
    empty_keys,
    enter,
    find_block,
    find_row,
    find_slot,
    is_inside,
    is_set,
    thin,
)
from triquad_map.evidence.carving import part_inside
from triquad_map.evidence.seen_voxels import SeenVoxels

_APART, _STEP = 4.0, 2.0
"""The distances between the ends of checked ways, and between their checked places, voxels."""

_MOST_BLOCKS = 1 << 18
"""New blocks of one scan that are counted; what more there are is taken to be in proportion."""


class EvidenceSize(NamedTuple):
    """The size of evidence, or what would be added to it."""

    blocks: int  # of 8 x 8 x 8 voxels, of which anything is known
    surface_blocks: int  # those of them in which rays ended
    voxels: int  # in which rays ended


class NewEnds(NamedTuple):
    """The voxels in which rays would end for the first time."""

    voxels: Longs  # [N, 3] in which no surface is known
    blocks: int  # of them, in which none is


@kernel()
def _new_ends(
    voxels: Doubles, seen: SeenVoxels, keys: Longs, block_keys: Longs, new: Longs
) -> tuple[int, int]:
    """Return how many voxels of points [N, 3] have no surface yet, in how many new blocks.

    They go to ``new`` [N, 3].
    """
    count = blocks = 0
    for i in range(len(voxels)):
        at = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        x, y, z = int(np.floor(at[0])), int(np.floor(at[1])), int(np.floor(at[2]))
        if not is_inside(x, y, z, seen.side):
            continue
        row = find_block(seen.blocks, x, y, z, seen.side)
        if row >= 0 and is_set(seen.surface, row, x, y, z):
            continue
        if enter(keys, at[0], at[1], at[2], 1.0):
            new[count, 0], new[count, 1], new[count, 2] = x, y, z
            count += 1
            if row < 0 or not seen.surface[row].any():
                blocks += enter(block_keys, at[0], at[1], at[2], float(BLOCK_VOXELS))
    return count, blocks


@kernel()
def _new_blocks(
    origin: Doubles, ends: Doubles, side: int, index: Index, keys: Longs
) -> tuple[int, int]:
    """Return (rays done, blocks): new blocks on the ways to ``ends`` [N, 3], not in the index.

    It stops where ``keys``, the set of those that were found, is half full. Ways are checked
    every few voxels: of what they touch at a corner alone, some is left out.
    """
    at = (origin[0], origin[1], origin[2])
    found = 0
    for i in range(len(ends)):
        if 2 * found >= len(keys):
            return i, found
        dx, dy, dz = ends[i, 0] - at[0], ends[i, 1] - at[1], ends[i, 2] - at[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0:
            continue
        way = (dx / length, dy / length, dz / length)
        first, last = part_inside(at, way, length, side)
        along, before = first, np.int64(-1)
        while along <= last:
            x = int(np.floor(at[0] + along * way[0]))
            y = int(np.floor(at[1] + along * way[1]))
            z = int(np.floor(at[2] + along * way[2]))
            along += _STEP
            if not is_inside(x, y, z, side):
                continue
            key = block_key(x, y, z)
            if key == before:
                continue
            before = key
            slot = find_slot(keys, key)
            if keys[slot] != key and find_row(index, key) < 0:
                keys[slot] = key
                found += 1
    return len(ends), found


def new_ends(ends: Doubles, seen: SeenVoxels) -> NewEnds:
    """Return the voxels of ``ends`` [N, 3], voxels, that add surface to what was ``seen``."""
    new = np.empty((len(ends), 3), np.int64)
    sets = empty_keys(len(ends)), empty_keys(len(ends))
    voxels, blocks = _new_ends(ends, seen, *sets, new)
    return NewEnds(new[:voxels], blocks)


def new_blocks(origin: Doubles, ends: Doubles, seen: SeenVoxels) -> int:
    """Return about how many blocks the ways from ``origin`` [3] to ``ends`` [N, 3] add, voxels."""
    # Rays that end near each other cross much the same blocks.
    ends = ends[thin(ends, _APART, empty_keys(len(ends)))]
    done, found = _new_blocks(origin, ends, seen.side, seen.blocks, empty_keys(_MOST_BLOCKS))
    return int(found * len(ends) // done) if done < len(ends) else int(found)
