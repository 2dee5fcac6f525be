"""Surfels, small discs that stand for the seen surface, and how well each is supported.

The field is right within the band where it is trained and saturates beyond it. So distances over
any range are measured to surfels, one in each voxel in which rays ended: where the field crosses
zero there, and which way it faces. A surfel depends on the field around one voxel alone, which
makes it cheap to keep up to date. Surface that has just appeared the field has still to learn:
until then the rays themselves show where it lies. Surfels are in voxel units: one is the side of a
leaf, and the voxel at integer coordinates ``v`` is the cube ``[v, v + 1)`` of leaf coordinates (see
:mod:`triquad_format.records.region`).

The support of a surface is a level that fits a file, and a confidence for planners. Each ray that
ends in a voxel adds to its strength, the more the nearer the sensor was; rays from several
directions count for more than as many from one. The level is the strength on a logarithmic scale.
``docs/queries.md`` shows how far measured errors fall as the confidence rises.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Longs
from triquad_format.records.region import MAX_LEVEL

DISC_RADIUS = 0.45
"""The radius of a disc, in voxels: discs of neighbours overlap where a surface goes on, and jut out
little where it ends."""

MARGIN_STEP = 0.25
"""Margins of voxels, beyond which no ray ended, are given in steps of as many voxels."""

SMOOTHING = 0.3
"""Surfels that are farther than the nearest by less than this, in voxels, count in the direction:
on a wall many are nearly as near, and each is a little off. On a street, directions are off by 1.2
degrees (median), and by 2.2 without."""

_STEPS = 3
"""Steps of Newton's method from a voxel's middle to where the field is zero: two to five give the
same distances to a hundredth of a voxel."""

_LONGEST_STEP = 0.5
"""The longest of them on each axis, in voxels. Where the field saturates, longer ones miss the
surface: on a sparsely seen street distances are off by a sixth more."""

ON_SURFACE = 0.1
"""The most, in voxels, that the field may be off on a surface. Where the steps lead there is none
if it is more: where it is flat in the free space of a corner, it comes near zero without crossing
it. And it has learnt the surface in a voxel if it is no more at the mean of the ends there. With
0.15, the mesh of a room is half a point of F-score worse after 0.3 million samples."""

FLATTEST = 0.3
"""A field that is flatter than this, as a slope, was not trained there, and shows no surface. With
less, more voxels have discs, and distances are off by more at most."""

LEVELS = MAX_LEVEL + 1

Rows = NDArray[np.intp]

NEAR_M = 10.0
"""The range at which a ray counts half as much as at the sensor."""

LEAST_STRENGTH = 0.25
"""The strength of level 1; each further level is twice as strong."""

HALF_LIFE_S = 86_400.0
"""While the rest of the map was seen again, confidence in what was not halves in this time."""


class SurfelKind(IntEnum):
    """The kinds of surfels for the surface that was seen in a voxel."""

    NONE = 0  # nothing: the surface lies in the next voxel, which has its own
    DISC = 1
    POINT = 2  # the field shows no surface to lay a disc on
    RAY_DISC = 3  # where rays ended on a plane that the field has not learnt
    RAY_POINT = 4  # where they ended, but not on a plane


@dataclass(frozen=True)
class Surfels:
    """The surfels of N voxels."""

    offsets: Floats  # [N, 3] from the voxel's middle, voxels
    normals: Floats  # [N, 3] unit vectors to free space; of points they mean little
    kinds: Bytes  # [N] SurfelKind

    @classmethod
    def none(cls, count: int) -> "Surfels":
        """Return surfels of the kind ``NONE``."""
        offsets, normals = np.zeros((2, count, 3), np.float32)
        return cls(offsets, normals, np.full(count, SurfelKind.NONE, np.uint8))

    @property
    def are_unlearnt(self) -> Bools:
        """[N] Whether rays alone show each: the field has still to learn it."""
        unlearnt: Bools = self.kinds >= SurfelKind.RAY_DISC
        return unlearnt

    def take(self, rows: Rows, others: "Surfels") -> None:
        """Put ``others`` [R] into ``rows`` [R]."""
        self.offsets[rows] = others.offsets
        self.normals[rows] = others.normals
        self.kinds[rows] = others.kinds

    def chosen(self, rows: Rows) -> "Surfels":
        """Return copies of some surfels."""
        offsets, normals = self.offsets.take(rows, axis=0), self.normals.take(rows, axis=0)
        return Surfels(offsets, normals, self.kinds.take(rows))


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: Floats
    gradient: Floats


SampleField = Callable[[Doubles], FieldValues]
"""The field, in voxels, and its gradient at leaf coordinates [N, 3]."""

Seen = Callable[[Longs], Bools]
"""A function that returns whether rays ended in voxels [N, 3]."""

ShownByRays = Callable[[Longs, int], Surfels]
"""The surfels of voxels [N, 3] by what rays alone have shown; NONE where that is not known, or no
ray ended there since the scan of that number."""


def nothing_shown(voxels: Longs, _since: int = 0) -> Surfels:
    """Return no surfels, as of a map from a file: where in voxels rays ended is not known."""
    return Surfels.none(len(voxels))


def fit_surfels(
    voxels: Longs, field: SampleField, seen: Seen, by_rays: ShownByRays = nothing_shown
) -> Surfels:
    """Return surfels of ``voxels`` [N, 3]: the field's, or where it shows no surface, the rays'."""
    surfels = _surfels_of_field(voxels, field, seen)
    shown = by_rays(voxels, 0)
    rows = np.flatnonzero(shown.kinds != SurfelKind.NONE)
    places = (voxels[rows] + 0.5 + shown.offsets[rows]).astype(np.float64)
    off, kinds = field(places).sdf, surfels.kinds[rows]
    # Next to a surface in the next voxel, noisy rays end on both sides of the border.
    is_noise = (kinds == SurfelKind.NONE) & (off < 0)
    is_off = (kinds == SurfelKind.POINT) | (np.abs(off) > ON_SURFACE)
    unlearnt = rows[is_off & ~is_noise]
    surfels.take(unlearnt, shown.chosen(unlearnt))
    return surfels


def _surfels_of_field(voxels: Longs, field: SampleField, seen: Seen) -> Surfels:
    """Return the surfels of ``voxels`` [N, 3]: where steps from their middles lead.

    The field's surface lies in the voxel or one next to it; of those that have surfels of their
    own, it is theirs.
    """
    middles = (voxels + 0.5).astype(np.float64)
    points: Doubles = middles
    for _ in range(_STEPS):
        sample = field(points)
        squares = np.maximum((sample.gradient**2).sum(axis=1), FLATTEST**2)
        steps = -(sample.sdf / squares)[:, None] * sample.gradient
        points = points + np.clip(steps, -_LONGEST_STEP, _LONGEST_STEP)
    at_end = field(points)
    steepness = np.linalg.norm(at_end.gradient, axis=1)
    on_surface = (np.abs(at_end.sdf) < ON_SURFACE) & (steepness > FLATTEST)
    there = np.floor(points).astype(np.int64)
    away = np.abs(there - voxels).max(axis=1, initial=0)
    is_shown = on_surface & (away <= 1)
    next_door = np.flatnonzero(is_shown & (away == 1))
    kinds = np.where(is_shown, SurfelKind.DISC, SurfelKind.POINT).astype(np.uint8)
    kinds[next_door[seen(there[next_door])]] = SurfelKind.NONE
    offsets = np.where(is_shown[:, None], points - middles, 0.0)
    normals = at_end.gradient / np.maximum(steepness, 1e-6)[:, None]
    return Surfels(offsets.astype(np.float32), normals.astype(np.float32), kinds)


def support_confidence(levels: Bytes, kinds: Bytes) -> Floats:
    """Return the confidence [N] of surfels of a :class:`SurfelKind` at these levels, just seen.

    Where the field shows no surface it is that of level 0: what stands for it is off by half a
    voxel (median) on a street; a disc of the field by a fiftieth.
    """
    return level_confidence()[np.where(kinds == SurfelKind.DISC, levels, 0)]


def level_confidence() -> Floats:
    """Return the confidence [LEVELS] of each level, just seen."""
    strength = LEAST_STRENGTH * 2.0 ** (np.arange(LEVELS) - 0.5)
    return np.asarray(strength / (strength + 1.0), np.float32)
