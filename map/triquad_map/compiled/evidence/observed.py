"""What is known of each voxel in which rays ended, as kernels take it: a row for each."""

from typing import NamedTuple

from triquad_format.records.arrays import Floats, Ints, Longs

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, byte_of, find_block

MEAN = 0  # and the two columns after it: middle of the ends, voxels, in the voxel
NORMAL = 3  # and the two after it: of the surface; 0 where it is not known or not flat
SPREAD = 6  # mean squared distance of the ends from their middle, voxels
ENDS = 7  # rays that ended there, up to _COUNTED_ENDS
WEIGHT = 8  # rays, the near ones counting more
TOWARDS = 9  # and the two after it: from the last end to the sensor, voxels
SHAPE_COLUMNS = 12

HIT_SCAN = 0  # the last scan of which a ray ended there
HITS = 1  # scans of which rays ended there
PASSED_SCAN = 2  # the last scan of which a ray passed, and none ended there
PASS_SCANS = 3  # such scans in a row
PASSES = 4  # rays of theirs that passed
MISSES = 5  # rays of theirs that crossed the surface
EARLIER_PASSES = 6  # rays that passed before the last hit
EARLIER_MISSES = 7
SECTORS = 8  # a bit for each eighth of the horizon looked from
FIRST_SCAN = 9  # of which a ray ended on the surface that is there now
COUNT_COLUMNS = 10


class Observed(NamedTuple):
    """The arrays of the observations, as kernels take them.

    A row is what is known of one voxel in which rays ended; row 0 is of none.
    """

    places: Ints  # [blocks] where in the next two a block of evidence stands; 0: nothing is known
    rows: Ints  # [places, voxels] the row of each voxel; 0: no ray ended in it
    seen_s: Longs  # [places] when the last ray ended in the block
    owners: Longs  # [rows] the block's row in the evidence, and the voxel in the block
    shapes: Floats  # [rows, SHAPE_COLUMNS]
    counts: Ints  # [rows, COUNT_COLUMNS]


Vector = tuple[float, float, float]


@kernel(inline="always")
def row_of(seen: SeenVoxels, observed: Observed, x: int, y: int, z: int) -> int:
    """The row of a voxel; 0 where no ray ended in it."""
    block = find_block(seen.blocks, x, y, z, seen.side)
    if block < 0:
        return 0
    return int(observed.rows[observed.places[block], byte_of(x, y) << SHIFT | (z & LOW)])
