"""How often, from how near, from where and when last rays ended in each voxel."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES, surface_counts

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, byte_of, find_block, with_room
from triquad_map.surface import LEAST_STRENGTH, LEVELS, NEAR_M, SECTORS_COUNTED

_VOXELS = BLOCK_VOXELS**3
_MIN_CAPACITY = 64


class Observed(NamedTuple):
    """The arrays of the observations, as kernels take them."""

    places: Ints  # [blocks] where in the others a block of evidence stands; 0: nothing is known
    weights: Floats  # [places, voxels] rays, the near ones counting more
    sectors: Bytes  # [places, voxels] a bit for each eighth of the horizon looked from
    seen_s: Longs  # [places] when the last ray ended in the block


class Sighting(NamedTuple):
    """From where and when a scan looked."""

    origin: Doubles  # [3] the sensor, voxels
    leaf_m: float
    stamp_s: int  # seconds since 1970


@kernel(inline="always")
def _sector(x: float, y: float) -> int:
    """Which eighth of the horizon a direction lies in."""
    eighth = 0 if y >= 0 else 4
    if (x >= 0) != (y >= 0):
        eighth += 2
    return eighth + (1 if abs(y) > abs(x) else 0)


@kernel()
def _record(
    voxels: Doubles,
    start: int,
    seen: SeenVoxels,
    sighting: Sighting,
    observed: Observed,
    count: int,
) -> tuple[int, int]:
    """Count rays that ended at ``voxels`` [N, 3]; returns (points done, places in use)."""
    origin, leaf_m = sighting.origin, sighting.leaf_m
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        row = find_block(seen.blocks, x, y, z, seen.side)
        if row < 0:  # outside the region
            continue
        place = observed.places[row]
        if place == 0:
            if count == len(observed.seen_s):
                return i, count
            place = count
            observed.places[row] = place
            count += 1
        voxel = byte_of(x, y) << SHIFT | (z & LOW)
        dx, dy, dz = origin[0] - voxels[i, 0], origin[1] - voxels[i, 1], origin[2] - voxels[i, 2]
        square = (dx * dx + dy * dy + dz * dz) * (leaf_m / NEAR_M) ** 2
        observed.weights[place, voxel] += np.float32(1 / (1 + square))
        observed.sectors[place, voxel] |= np.uint8(1 << _sector(dx, dy))
        observed.seen_s[place] = max(observed.seen_s[place], sighting.stamp_s)
    return len(voxels), count


@kernel(inline="always")
def _level(weight: float, sectors: int) -> int:
    """The level of a voxel that was looked at from some ``sectors``, a bit for each."""
    count = 0
    for sector in range(8):
        count += sectors >> sector & 1
    strength = weight * (0.5 + 0.5 * min(SECTORS_COUNTED, max(1, count)))
    level = 0
    while level < LEVELS - 1 and strength >= LEAST_STRENGTH * (1 << level):
        level += 1
    return level


@kernel()
def _levels(surface: Bytes, observed: Observed, levels: Bytes) -> None:
    """Fill in the ``levels`` of the voxels of ``surface``."""
    at = 0
    for row in range(len(surface)):
        place = observed.places[row]
        for byte in range(BLOCK_BYTES):
            bits = int(surface[row, byte])
            if bits == 0:
                continue
            for z in range(BLOCK_VOXELS):
                if bits >> z & 1:
                    voxel = byte << SHIFT | z
                    weight = observed.weights[place, voxel]
                    levels[at] = _level(weight, observed.sectors[place, voxel])
                    at += 1


class Observations:
    """The observations of the blocks of some evidence, by their rows."""

    def __init__(self, blocks: int) -> None:
        """``blocks`` is how many rows there is room for."""
        self._count = 1  # places in use
        self._observed = _arrays(blocks, _MIN_CAPACITY)

    def make_room(self, blocks: int) -> None:
        """Make room for so many rows."""
        places = with_room(self._observed.places, blocks)
        self._observed = self._observed._replace(places=places)

    def record(self, voxels: Doubles, seen: SeenVoxels, sighting: Sighting) -> None:
        """Count rays that ended at ``voxels`` [N, 3], whose blocks are all in ``seen``."""
        done = 0
        while done < len(voxels):
            done, self._count = _record(voxels, done, seen, sighting, self._observed, self._count)
            if done < len(voxels):
                self._grow()

    def levels(self, surface: Bytes) -> Bytes:
        """The level of each voxel set in ``surface`` [blocks, BLOCK_BYTES], in their order."""
        # Most blocks are open air.
        used = np.flatnonzero(surface.view(np.uint64).any(axis=1))
        surface, places = surface[used], self._observed.places[used]
        levels = np.empty(int(surface_counts(surface).sum()), np.uint8)
        _levels(surface, self._observed._replace(places=places), levels)
        return levels

    def seen_s(self, blocks: int) -> Longs:
        """When a ray last ended in each of the first ``blocks``, seconds since 1970; 0: never."""
        return self._observed.seen_s[self._observed.places[:blocks]]

    def forget(self, blocks: NDArray[np.intp], surface: Bytes) -> None:
        """Forget, in the rows ``blocks`` [N], voxels that are not set in ``surface`` any more."""
        places = self._observed.places[blocks]
        kept = np.unpackbits(surface[blocks], axis=1, bitorder="little")
        self._observed.weights[places] *= kept
        self._observed.sectors[places] *= kept

    @classmethod
    def restore(cls, surface: Bytes, levels: Bytes, seen_s: Longs) -> "Observations":
        """Observations of the blocks ``surface`` [blocks, BLOCK_BYTES] that give these levels."""
        used = np.flatnonzero(surface.any(axis=1))
        places = slice(1, 1 + len(used))
        observed = _arrays(len(surface), max(_MIN_CAPACITY, 2 * len(used)))
        observed.places[used] = np.arange(1, 1 + len(used))
        observed.seen_s[places] = seen_s[used]
        # The least strength of each level, seen from one sector.
        ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
        known = levels > 0
        observed.weights[places][ended] = known * LEAST_STRENGTH * 2.0 ** (levels - 1.0)
        observed.sectors[places][ended] = known
        observations = cls(len(surface))
        observations._count, observations._observed = 1 + len(used), observed
        return observations

    def _grow(self) -> None:
        old, capacity = self._observed, 2 * len(self._observed.seen_s)
        self._observed = old._replace(
            weights=with_room(old.weights, capacity),
            sectors=with_room(old.sectors, capacity),
            seen_s=with_room(old.seen_s, capacity),
        )


def _arrays(blocks: int, capacity: int) -> Observed:
    return Observed(
        np.zeros(blocks, np.int32),
        np.zeros((capacity, _VOXELS), np.float32),
        np.zeros((capacity, _VOXELS), np.uint8),
        np.zeros(capacity, np.int64),
    )
