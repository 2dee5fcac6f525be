"""Rays that training draws from again, as a record has them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings

STEPS = 128
"""Steps of a leaf in which the ends of rays are given: 1.6 mm at the default leaf."""

SLOPE_SCALE = 255

HELD_OUT = 32
"""One ray of this many is held out: it is never trained on, and shows how good the field is."""

_AT_ONCE = 1 << 16

AXIS_BITS = 21
AXIS_MASK = (1 << AXIS_BITS) - 1
MIXED = np.uint64(0x9E3779B97F4A7C15)  # 2**64 over the golden section
MIXED_SHIFT = 59
"""The five upper bits depend on all of an end; rays are held out where they are zero."""


def ray_keys(ends: NDArray[np.integer]) -> Longs:
    """Return a number for each ray that ends at ``ends`` [N, 3], in steps from the lower corner of
    a cube with twice the region's side around its centre.
    """
    x, y, z = (ends.astype(np.int64) & AXIS_MASK).T
    keys: Longs = x << 2 * AXIS_BITS | y << AXIS_BITS | z
    return keys


def are_held_out(ends: NDArray[np.integer]) -> Bools:
    """Return which rays that end at ``ends`` [N, 3], in steps as there, are held out.

    It depends on their ends alone: rays that are read back are held out as before.
    """
    mixed = ray_keys(ends).astype(np.uint64) * MIXED
    chosen: Bools = mixed >> np.uint64(MIXED_SHIFT) == 0
    return chosen


@dataclass(frozen=True)
class ReplayRays:
    """Rays of a region, in the order of the leaves in which they end."""

    ends: Ints
    """[R, 3] in steps, from the lower corner of a cube with twice the region's side around its
    centre: a ray may end outside of the region."""

    origin_of: Ints  # [R] row of each ray's origin
    slopes: Bytes
    """[R] by how much the signed distance falls for each metre of the ray, ``1 / SLOPE_SCALE``:
    the cosine of its angle to the surface's normal, or to the field's gradient where no normal is
    known; SLOPE_SCALE also where neither is, and where the ends around give the normal."""

    origins: Floats  # [K, 3] where the sensor was, metres from the region's centre

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def leaf_codes(self) -> Longs:
        """Morton codes [R] of the leaves in which they end, from the corner of the same cube."""
        codes = np.empty(len(self), np.int64)
        for first in range(0, len(self), _AT_ONCE):  # maps have millions of rays
            part = slice(first, first + _AT_ONCE)
            codes[part] = morton.encode(self.ends[part] // STEPS)
        return codes

    def ends_m(self, settings: FieldSettings) -> Doubles:
        """Return the ends [R, 3], metres from the region's centre: the middles of the steps."""
        step_m, middle = settings.leaf_m / STEPS, 0.5 - STEPS * (1 << settings.depth)
        ends_m: Doubles = self.ends.astype(np.float64)
        ends_m += middle
        ends_m *= step_m
        return ends_m

    def chosen(self, rows: NDArray[np.intp]) -> "ReplayRays":
        """Return some of the rays, with the origins that they have."""
        some = replace(
            self, ends=self.ends[rows], origin_of=self.origin_of[rows], slopes=self.slopes[rows]
        )
        return some.with_own_origins()

    def with_own_origins(self) -> "ReplayRays":
        """Return the rays without origins of which none comes."""
        used = np.bincount(self.origin_of, minlength=len(self.origins)) > 0
        numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return replace(self, origin_of=numbers[self.origin_of], origins=self.origins[used])


def no_rays() -> ReplayRays:
    """No rays at all."""
    return ReplayRays(
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.int32),
        np.zeros(0, np.uint8),
        origins=np.zeros((0, 3), np.float32),
    )
