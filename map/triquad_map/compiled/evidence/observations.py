"""What is known of each voxel in which rays ended: how often, from where, and what became of it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import surface_counts, used_blocks

from triquad_map.compiled.evidence.levels import fill_levels
from triquad_map.compiled.evidence.observed import (
    COUNT_COLUMNS,
    EARLIER_MISSES,
    EARLIER_PASSES,
    ENDS,
    FIRST_SCAN,
    HIT_SCAN,
    HITS,
    MEAN,
    MISSES,
    NORMAL,
    PASS_SCANS,
    PASSES,
    SECTORS,
    SHAPE_COLUMNS,
    SPREAD,
    TOWARDS,
    WEIGHT,
    Observed,
    Vector,
    row_of,
)
from triquad_map.compiled.evidence.outcomes import outcome_codes, outcome_counts
from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import (
    LOW,
    SHIFT,
    byte_of,
    find_block,
    with_room,
)
from triquad_map.surface import (
    LEAST_STRENGTH,
    NEAR_M,
    SurfelKind,
    Surfels,
)

_VOXELS = BLOCK_VOXELS**3
_MIN_CAPACITY = 64
_MIN_ROWS = 1024
_DISC = int(SurfelKind.DISC)
_DISC_ENDS, _DISC_SPREAD = 16.0, 0.15  # that a disc of the field stands for

_RECORD = [HITS, EARLIER_PASSES, EARLIER_MISSES]
"""What files keep of a voxel's record."""

_COUNTED_ENDS = 64
"""Of a voxel; the shape that further ones give counts as that of so many."""


class Sighting(NamedTuple):
    """From where and when a scan looked."""

    origin: Doubles  # [3] the sensor, voxels
    leaf_m: float
    stamp_s: int  # seconds since 1970
    scan: int  # its number, from 1 on; that of the next is greater


@kernel(inline="always")
def _sector(x: float, y: float) -> int:
    """Which eighth of the horizon a direction lies in."""
    eighth = 0 if y >= 0 else 4
    if (x >= 0) != (y >= 0):
        eighth += 2
    return eighth + (1 if abs(y) > abs(x) else 0)


@kernel(inline="always")
def _add_ray(row: int, end: Vector, sighting: Sighting, observed: Observed) -> None:
    """Count a ray that ended at ``end``, voxels, by how far and where the sensor was."""
    origin = sighting.origin
    dx, dy, dz = origin[0] - end[0], origin[1] - end[1], origin[2] - end[2]
    square = (dx * dx + dy * dy + dz * dz) * (sighting.leaf_m / NEAR_M) ** 2
    observed.shapes[row, WEIGHT] += np.float32(1 / (1 + square))
    for axis, towards in enumerate((dx, dy, dz)):
        observed.shapes[row, TOWARDS + axis] = towards
    observed.counts[row, SECTORS] |= 1 << _sector(dx, dy)


@kernel(inline="always")
def _add_end(row: int, end: Vector, observed: Observed) -> None:
    """Move the shape of the surface in a voxel by a ray that ended at a place in it."""
    shapes = observed.shapes
    count = min(shapes[row, ENDS] + np.float32(1), np.float32(_COUNTED_ENDS))
    if count == 1:
        for axis in range(3):
            shapes[row, MEAN + axis], shapes[row, NORMAL + axis] = end[axis], 0
        shapes[row, SPREAD] = 0
    shapes[row, ENDS] = count
    squared = np.float32(0)
    for axis in range(3):
        off = np.float32(end[axis]) - shapes[row, MEAN + axis]
        step = off / count
        shapes[row, MEAN + axis] += step
        squared += off * (off - step)
    shapes[row, SPREAD] += (squared - shapes[row, SPREAD]) / count


@kernel(inline="always")
def _begin_hit(row: int, scan: int, observed: Observed) -> None:
    """Count a scan of which a ray ended in a voxel: what passed before goes to its record."""
    counts = observed.counts
    if counts[row, HIT_SCAN] == scan:
        return
    counts[row, HIT_SCAN] = scan
    counts[row, HITS] += 1
    if observed.shapes[row, ENDS] > 0:  # else they passed while nothing was there
        counts[row, EARLIER_PASSES] += counts[row, PASSES]
        counts[row, EARLIER_MISSES] += counts[row, MISSES]
    else:
        counts[row, FIRST_SCAN] = scan
    counts[row, PASS_SCANS] = counts[row, PASSES] = counts[row, MISSES] = 0


@kernel()
def _record(
    voxels: Doubles,
    start: int,
    seen: SeenVoxels,
    sighting: Sighting,
    observed: Observed,
    places: int,
    rows: int,
    found: Ints,
) -> tuple[int, int, int]:
    """Count rays that ended at ``voxels`` [N, 3]; returns (points done, places, rows in use).

    The row of each ray's voxel goes to ``found`` [N]; 0 outside the region.
    """
    for i in range(start, len(voxels)):
        x = int(np.floor(voxels[i, 0]))
        y = int(np.floor(voxels[i, 1]))
        z = int(np.floor(voxels[i, 2]))
        block = find_block(seen.blocks, x, y, z, seen.side)
        found[i] = 0
        if block < 0:  # outside the region
            continue
        place = observed.places[block]
        if place == 0:
            if places == len(observed.seen_s):
                return i, places, rows
            place = places
            observed.places[block] = place
            places += 1
        voxel = byte_of(x, y) << SHIFT | (z & LOW)
        row = observed.rows[place, voxel]
        if row == 0:
            if rows == len(observed.owners):
                return i, places, rows
            row = rows
            observed.rows[place, voxel] = row
            observed.owners[row] = block << (3 * SHIFT) | voxel
            rows += 1
        found[i] = row
        observed.seen_s[place] = max(observed.seen_s[place], sighting.stamp_s)
        end = (voxels[i, 0], voxels[i, 1], voxels[i, 2])
        _add_ray(row, end, sighting, observed)
        _begin_hit(row, sighting.scan, observed)
        _add_end(row, (end[0] - x, end[1] - y, end[2] - z), observed)
    return len(voxels), places, rows


@kernel()
def _set_normals(rows: Ints, normals: Doubles, observed: Observed) -> None:
    for i, row in enumerate(rows):
        if row != 0 and not np.isnan(normals[i, 0]):
            for axis in range(3):
                observed.shapes[row, NORMAL + axis] = normals[i, axis]


@kernel()
def _set_discs(
    voxels: Longs,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
    seen: SeenVoxels,
    observed: Observed,
) -> None:
    for i in range(len(voxels)):
        shape = observed.shapes[row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])]
        if shape[ENDS] != 0:  # rays have told since
            continue
        is_disc = kinds[i] == _DISC
        for axis in range(3):
            shape[MEAN + axis] = offsets[i, axis] + 0.5 if is_disc else np.nan
            shape[NORMAL + axis] = normals[i, axis] if is_disc else 0.0
        shape[SPREAD] = _DISC_SPREAD
        shape[ENDS] = _DISC_ENDS if is_disc else 0


class Observations:
    """The observations of the blocks of some evidence, by their rows."""

    def __init__(self, blocks: int) -> None:
        """``blocks`` is how many there is room for."""
        self._places = 1  # in use
        self._rows = 1
        self.arrays = _arrays(blocks, _MIN_CAPACITY, _MIN_ROWS)

    def make_room(self, blocks: int) -> None:
        """Make room for so many blocks."""
        places = with_room(self.arrays.places, blocks)
        self.arrays = self.arrays._replace(places=places)

    def record(self, voxels: Doubles, seen: SeenVoxels, sighting: Sighting) -> Ints:
        """Count rays that ended at ``voxels`` [N, 3], whose blocks are all in ``seen``.

        Returns:
            The row of each ray's voxel [N]; 0 outside the region.
        """
        found = np.empty(len(voxels), np.int32)
        done = 0
        while done < len(voxels):
            done, self._places, self._rows = _record(
                voxels, done, seen, sighting, self.arrays, self._places, self._rows, found
            )
            if done < len(voxels):
                self._grow()
        return found

    def set_normals(self, rows: Ints, normals: Doubles) -> None:
        """Keep the ``normals`` [N, 3] of the surface in ``rows`` [N]; NaN: as they were."""
        _set_normals(rows, normals, self.arrays)

    def set_discs(self, voxels: Longs, surfels: Surfels, seen: SeenVoxels) -> None:
        """Take the middles and normals of ``voxels`` [N, 3] from their ``surfels``.

        Where there is no disc, the next ray that ends there tells where the surface is.
        """
        _set_discs(voxels, surfels.offsets, surfels.normals, surfels.kinds, seen, self.arrays)

    def levels(self, surface: Bytes) -> Bytes:
        """The level of each voxel set in ``surface`` [blocks, BLOCK_BYTES], in their order."""
        used = used_blocks(surface)
        surface, places = surface[used], self.arrays.places[used]
        levels = np.empty(int(surface_counts(surface).sum()), np.uint8)
        fill_levels(surface, self.arrays._replace(places=places), levels)
        return levels

    def outcomes(self, surface: Bytes) -> Bytes:
        """Codes [S, 3] of what became of rays at each voxel set in ``surface``, in their order."""
        used = used_blocks(surface)
        ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
        rows = self.arrays.rows[self.arrays.places[used]][ended]
        return outcome_codes(self.arrays.counts[rows][:, _RECORD])

    def seen_s(self, blocks: int) -> Longs:
        """When a ray last ended in each of the first ``blocks``, seconds since 1970; 0: never."""
        return self.arrays.seen_s[self.arrays.places[:blocks]]

    def forget(self, blocks: NDArray[np.intp], surface: Bytes) -> None:
        """Forget, in the rows ``blocks`` [N], voxels that are not set in ``surface`` any more."""
        places = self.arrays.places[blocks]
        kept = np.unpackbits(surface[blocks], axis=1, bitorder="little")
        self.arrays.rows[places] *= kept

    @classmethod
    def restore(
        cls, surface: Bytes, levels: Bytes, seen_s: Longs, *, outcomes: Bytes | None
    ) -> "Observations":
        """Observations of the blocks ``surface`` [blocks, BLOCK_BYTES] that give these levels.

        ``outcomes`` are the codes [S, 3] of what became of rays; ``None``: not known.
        """
        used = used_blocks(surface)
        places = slice(1, 1 + len(used))
        ended = np.unpackbits(surface[used], axis=1, bitorder="little").astype(np.bool_)
        rows = slice(1, 1 + len(levels))
        arrays = _arrays(
            len(surface),
            max(_MIN_CAPACITY, 2 * len(used)),
            max(_MIN_ROWS, 2 * len(levels)),
        )
        arrays.places[used] = np.arange(1, 1 + len(used))
        arrays.seen_s[places] = seen_s[used]
        arrays.rows[places][ended] = np.arange(1, 1 + len(levels))
        block, voxel = np.nonzero(ended)
        arrays.owners[rows] = used[block] << (3 * SHIFT) | voxel
        # The least strength of each level, seen from one sector.
        known = levels > 0
        arrays.shapes[rows, WEIGHT] = known * LEAST_STRENGTH * 2.0 ** (levels - 1.0)
        arrays.counts[rows, SECTORS] = known
        if outcomes is None:
            outcomes = np.zeros((len(levels), len(_RECORD)), np.uint8)
        arrays.counts[rows, _RECORD] = outcome_counts(outcomes)
        observations = cls(len(surface))
        observations._places, observations._rows = 1 + len(used), 1 + len(levels)
        observations.arrays = arrays
        return observations

    def _grow(self) -> None:
        """Double what is full."""
        arrays = self.arrays._asdict()
        for names, count in ((_BY_PLACE, self._places), (_BY_ROW, self._rows)):
            if count == len(arrays[names[-1]]):
                arrays |= {name: with_room(arrays[name], 2 * count) for name in names}
        self.arrays = Observed(**arrays)


_BY_PLACE = ("rows", "seen_s")
_BY_ROW = ("owners", "shapes", "counts")


def _arrays(blocks: int, places: int, rows: int) -> Observed:
    return Observed(
        places=np.zeros(blocks, np.int32),
        rows=np.zeros((places, _VOXELS), np.int32),
        seen_s=np.zeros(places, np.int64),
        owners=np.zeros(rows, np.int64),
        shapes=np.zeros((rows, SHAPE_COLUMNS), np.float32),
        counts=np.zeros((rows, COUNT_COLUMNS), np.int32),
    )
